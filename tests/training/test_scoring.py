import sys
import time
from pathlib import Path

from gaitgauge.training.scoring import ProcessScorer, flat_numbers


def scorer(tmp_path: Path, code: str, **arguments) -> ProcessScorer:
    return ProcessScorer(
        lambda path: [sys.executable, "-c", code, str(path)], suite="s", folder=tmp_path / "g", **arguments
    )


def test_scores_come_back_in_order(tmp_path):
    code = 'import sys; print(\'{"score": %s, "terrain": {"wave": 2}}\' % len(sys.argv[1]))'
    side = scorer(tmp_path, code)
    side.submit(Path("ab"), 1)
    side.submit(Path("abcd"), 2)
    assert side.pending == 2
    reports = side.drain(30.0)
    assert [(r.iteration, dict(r.scores)) for r in reports] == [
        (1, {"score": 2.0, "terrain.wave": 2.0}),
        (2, {"score": 4.0, "terrain.wave": 2.0}),
    ]
    assert side.pending == 0 and not any(r.failure for r in reports)


def test_failures_are_reported(tmp_path):
    side = scorer(tmp_path, "import sys; print('oops', file=sys.stderr); sys.exit(3)")
    side.submit(Path("a"), 7)
    (report,) = side.drain(30.0)
    assert "exit code 3" in report.failure and not report.scores
    assert (tmp_path / "g" / "model_7.log").read_text() == "oops\n"
    side = scorer(tmp_path, "print('no json')")
    side.submit(Path("a"), 8)
    assert "cannot be read" in side.drain(30.0)[0].failure
    missing = ProcessScorer(lambda path: ["/no/such/program"], suite="s", folder=tmp_path)
    missing.submit(Path("a"), 9)
    assert "cannot start /no/such/program" in missing.poll()[0].failure


def test_a_slow_gauge_skips_the_oldest_and_can_be_stopped(tmp_path):
    side = scorer(tmp_path, "import time; time.sleep(60)", max_waiting=2)
    for iteration in range(4):
        side.submit(Path("a"), iteration)
    skipped = side.poll()
    assert [r.iteration for r in skipped] == [1] and "slower than training" in skipped[0].failure
    start = time.monotonic()
    side.close()
    assert time.monotonic() - start < 5.0 and side.pending == 0


def test_flat_numbers():
    assert flat_numbers({"a": 1, "b": {"c": 2.5, "d": "x", "e": True}, "f": [1]}) == {"a": 1.0, "b.c": 2.5}
