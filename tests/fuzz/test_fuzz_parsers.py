"""Every registered parser against changed seeds; ``make fuzz`` runs many more cases, with a new start each time."""

import importlib
import os
from pathlib import Path

import pytest
from fuzzing import PARSERS, TALLIES, Parser, check, contents
from gaitgauge.policy.base import PolicyError
from hypothesis import HealthCheck, given, settings

for module in sorted(Path(__file__).parent.glob("fuzz_*.py")):
    importlib.import_module(module.stem)

CASES = -(-int(os.environ.get("GAITGAUGE_FUZZ_CASES", 150)) // len(PARSERS))
"""Of each parser; the variable says how many of all."""


@pytest.mark.parametrize("name", PARSERS)
def test_seeds_are_taken(name, tmp_path):
    for number, seed in enumerate(PARSERS[name].seeds):
        (folder := tmp_path / str(number)).mkdir()
        PARSERS[name].feed(seed, folder)


@pytest.mark.parametrize("name", PARSERS)
def test_whatever_is_read_ends_well(name, record_property):
    parser = PARSERS[name]
    TALLIES.pop(name, None)

    @settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        derandomize="GAITGAUGE_FUZZ_CASES" not in os.environ,
        suppress_health_check=list(HealthCheck),
    )
    @given(content=contents(parser))
    def case(content: bytes) -> None:
        check(parser, content)

    try:
        case()
    finally:
        record_property("fuzzed", {"parser": name, **vars(TALLIES[name])})


def parser(feed) -> Parser:
    return Parser(name="test", feed=feed, seeds=(b"",), words=(b"",))


def test_the_harness_catches_what_it_is_for(tmp_path):
    def sentence(content, folder):
        (folder / "own").write_text("")
        raise PolicyError("one sentence")

    TALLIES.clear()
    check(parser(sentence), b"")
    with pytest.raises(KeyError):
        check(parser(lambda content, folder: {}["x"]), b"")
    with pytest.raises(MemoryError):
        check(parser(lambda content, folder: bytearray(3 * 10**9)), b"")
    with pytest.raises(AssertionError, match="outside"):
        check(parser(lambda content, folder: (tmp_path / "x").write_text("")), b"")
    with pytest.raises(AssertionError, match="outside"):
        check(parser(lambda content, folder: os.mkdir(tmp_path / "y")), b"")
    tally = TALLIES["test"]
    assert (tally.cases, tally.tracebacks, tally.outside) == (5, 2, 2)
    check(parser(lambda content, folder: bytearray(3 * 10**8)), b"")
    assert 2 * 10**8 < tally.memory < 4 * 10**8 or not Path("/proc/self/clear_refs").exists()
