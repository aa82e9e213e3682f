"""The typed result: its file byte for byte, old files, and nobody who reads it by string key."""

import ast
import gzip
import json
import re
import typing
from dataclasses import is_dataclass
from pathlib import Path

import pytest
from gaitgauge.files.writing import json_text
from gaitgauge.gauge import result as module
from gaitgauge.gauge.result import Result, Table
from gaitgauge.gauge.result_figures import check_figures
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.totals import ONE_SEED
from sample_results import PIPELINES, read, sample

ROOT = Path(__file__).parents[2]
SEED = ROOT / "tests" / "fuzz" / "seeds" / "results" / "results.json"
KEPT = sorted((ROOT / "docs" / "data" / "sweeps").glob("*/runs/*/seed-0/kept/results.json"))[::6]
PACKAGES = ("backends", "benchmarks", "cli", "examples", "files", "gauge", "policy", "studies", "training")
GIVE_RESULTS = {"read_result", "load_result", "load_results", "read_card", "from_data", "evaluate"}
"""Functions that return a result."""


# ---- the file -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [SEED, *KEPT], ids=lambda path: path.parents[3].name)
def test_a_file_is_written_as_it_was_read(path):
    text = path.read_text()
    written = read(json.loads(text)).to_data()
    assert text == (json_text(written) if text.startswith("{\n") else json.dumps(written) + "\n")


def test_a_result_of_one_seed_is_read_without_its_intervals():
    """A sweep, which reads cards without intervals, refused them for the note on why there is none."""
    found = read(json.loads(json_text(sample("stress", "demo").to_data())))
    assert found.chance.note == ONE_SEED
    check_figures(found, "results.json", StoreError, intervals=False)


@pytest.mark.parametrize("suite", ["robogauge-1.1", "gaitgauge-1"])
@pytest.mark.parametrize("pipeline", PIPELINES)
def test_what_was_found_is_what_its_file_says(pipeline, suite):
    found = sample(
        pipeline, suite, **PIPELINES[pipeline] | ({} if pipeline in ("base", "multi") else {"frictions": (0.6,)})
    )
    again = read(json.loads(json_text(found.to_data())))
    assert again == found
    assert json_text(again.to_data()) == json_text(found.to_data())


def test_a_card_keeps_all_that_an_evaluation_wrote():
    """A card adds figures of its own, which no evaluation has, behind those."""
    for name in ("cts-gaitgauge-1", "pretrained-robogauge-1.1"):
        card = json.loads(gzip.decompress((ROOT / "docs" / "data" / "scorecards" / f"{name}.json.gz").read_bytes()))
        assert read(card).to_data() == {k: v for k, v in card.items() if k not in ("tolerance", "repeatability")}


def test_whole_numbers_stay_whole_and_null_and_absent_stay_apart():
    data = sample("base", **PIPELINES["base"]).to_data()
    data["environments"][0] |= {"friction": 1, "self_contact": None}
    data["schema"] = 2
    del data["health"]["self_contact"]
    written = read(data).to_data()
    assert json.dumps(written["environments"][0]["friction"]) == "1"
    assert written["environments"][0]["self_contact"] is None and "self_contact" not in written["health"]


@pytest.mark.parametrize("table", ["coverage", "motors", "health", "training", "feet", "commands"])
def test_files_of_before_lack_tables(table):
    data = sample("base", **PIPELINES["base"]).to_data()
    del data[table]
    with pytest.raises(StoreError, match=f"it lacks '{table}', which schema 3 has"):
        read(data)
    data["schema"] = 2
    found = read(data)
    assert table in found.lacking and found.to_data() == data
    assert not getattr(found, table).entries()


def test_another_schema_is_refused():
    data = sample("base", **PIPELINES["base"]).to_data()
    with pytest.raises(StoreError, match="it has schema 1, this version reads 2 and 3; evaluate the policy again"):
        read(data | {"schema": 1})


# ---- types ----------------------------------------------------------------------------------------------------------


def tables():
    return [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, Table)]


def test_a_result_is_frozen_and_typed_to_its_last_field():
    assert Result in tables() and len(tables()) > 10
    for kind in tables():
        assert is_dataclass(kind) and kind.__dataclass_params__.frozen and not hasattr(kind, "__getitem__")
        for name, hint in typing.get_type_hints(kind).items():
            assert "Any" not in str(hint) and hint not in (dict, list, object), f"{kind.__name__}.{name}"


# ---- readers --------------------------------------------------------------------------------------------------------


def importers():
    """Return every file that imports from ``gauge.result``, or a function that returns results."""
    reads = re.compile(rf"\.result import|import .*({'|'.join(GIVE_RESULTS)})\b|evaluation\.evaluate")
    files = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    own = ROOT / "gauge" / "result.py"
    return [path for path in (ROOT / "api.py", *files) if path != own and reads.search(path.read_text())]


HINTS = [hint for kind in tables() for hint in typing.get_type_hints(kind).items()]
NAMES = {kind.__name__ for kind in tables()} | {"Runs"}
HOLDING = {name for name, hint in HINTS if re.search(rf"\b({'|'.join(NAMES)})\b", str(hint))}
"""Fields that hold tables of the result, or mappings to such tables."""
MAPPINGS = {name for name, hint in HINTS if name in HOLDING and "Mapping" in str(hint)}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


def own_nodes(scope):
    """Return the nodes of a module or function without those of the functions inside, and these functions."""
    own, inner, left = [], [], list(ast.iter_child_nodes(scope))
    while left:
        node = left.pop()
        (inner if isinstance(node, FUNCTIONS) else own).append(node)
        left += [] if isinstance(node, FUNCTIONS) else ast.iter_child_nodes(node)
    return own, inner


def is_table(hint):
    """Return whether an annotation is a table or a sequence of them; a mapping to tables may be asked for a key."""
    words = "" if hint is None else ast.unparse(hint)
    return bool(re.search(rf"\b({'|'.join(NAMES)})\b", words)) and not re.search("Mapping|dict|Callable", words)


def gives(value):
    """Return whether an expression makes or reads a result."""
    called = getattr(value, "func", None)
    return getattr(called, "attr", getattr(called, "id", None)) in GIVE_RESULTS | NAMES


def key_reads(scope, known=frozenset()):
    """Return the reads by string key, in a module or function, on what it annotates as a table or gets from a reader."""
    own, inner = own_nodes(scope)
    names = set(known)
    for node in own:
        match node:
            case ast.arg(arg=name, annotation=hint) | ast.AnnAssign(target=ast.Name(id=name), annotation=hint):
                (names.add if is_table(hint) else names.discard)(name)
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if gives(value):
                names.add(name)

    def of_result(node):
        match node:
            case ast.Name(id=name):
                return name in names
            case ast.Attribute(attr=name, value=inner):
                return name in HOLDING - MAPPINGS and of_result(inner)
            case ast.Subscript(value=ast.Attribute(attr=name, value=inner)) if name in MAPPINGS:
                return of_result(inner)
            case ast.Subscript(value=inner):
                return of_result(inner)
            case ast.Call(func=ast.Attribute(attr="to_data" | "entries", value=inner)):
                return of_result(inner)
        return gives(node)

    found = []
    for node in own:
        match node:
            case ast.Subscript(value=value, slice=ast.Constant(value=str())) if of_result(value):
                found.append(ast.unparse(node))
            case ast.Call(func=ast.Attribute(attr="get" | "pop", value=value), args=[ast.Constant(value=str()), *_]):
                found += [ast.unparse(node)] if of_result(value) else []
    return found + [read for function in inner for read in key_reads(function, frozenset(names))]


def test_nobody_reads_a_result_by_string_key():
    files = importers()
    assert {"page.py", "comparison.py", "verify.py", "board.py", "scoring.py", "keeping.py"} <= {f.name for f in files}
    found = {path.relative_to(ROOT): key_reads(ast.parse(path.read_text())) for path in files}
    assert not {path: reads for path, reads in found.items() if reads}


@pytest.mark.parametrize(
    "text",
    [
        "def f(result: Result):\n    return result['score']",
        "def f(rows: Sequence[EnvironmentRow]):\n    return rows[0]['level']",
        "def f(card: Result | None):\n    return card.get('score')",
        "result = evaluate(request)\nprint(result['score'])",
        "found = read_result(path, StoreError)\nfound.to_data()['provenance']",
        "evaluate(request)['score']",
        "def f(result: Result):\n    return result.chance['seeds'], result.terrains",
        "def f(result: Result):\n    return result.terrains['flat']['score']",
        "def f(result: Result):\n    return result.environments[0]['score']",
        "def f(result: Result):\n    return sorted(rows, key=lambda row: result.coverage.get('kind'))",
    ],
)
def test_a_read_by_string_key_is_seen(text):
    assert key_reads(ast.parse(text))
