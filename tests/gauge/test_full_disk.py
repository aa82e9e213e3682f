"""Disks that are full or read-only, and folders whose names are no text: an evaluation ends in one sentence, and goes on later."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from gaitgauge.gauge.episodes import RecordError
from gaitgauge.gauge.report.page import write_report
from gaitgauge.gauge.store import StoreError
from tiny_runs import evaluate, tiny_request, without_provenance


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A request, the folder of its run on a disk with room, and the names of what was written, in order."""
    folder = tmp_path_factory.mktemp("whole")
    request = tiny_request(folder)
    with pytest.MonkeyPatch.context() as patch:
        written = failing(patch, 99, errno.ENOSPC)
        evaluate(request, folder / "run")
    assert written[0] == "request.json" and written[-2:] == ["episodes.csv", "results.json"] and len(written) > 10
    return request, folder / "run", written


def failing(monkeypatch, at: int, number: int) -> list[str]:
    """Lets the write of this number, and all after it, fail; gives the names of what was written."""
    replace, done = os.replace, []

    def fail(source, target):
        if len(done) >= at:
            raise OSError(number, os.strerror(number))
        done.append(Path(target).name)
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail)
    return done


@pytest.mark.parametrize(
    ("at", "number"),
    [
        (0, errno.EROFS),
        pytest.param(1, errno.ENOSPC, marks=pytest.mark.slow),
        pytest.param(5, errno.EIO, marks=pytest.mark.slow),
        pytest.param(-2, errno.ENOSPC, marks=pytest.mark.slow),
        (-1, errno.EDQUOT),
    ],
)
def test_a_disk_that_takes_no_more_costs_nothing_that_was_written(whole, tmp_path, monkeypatch, at, number):
    request, reference, all_of_them = whole
    folder, at = tmp_path / "run", at % len(all_of_them)
    with monkeypatch.context() as patch:
        written = failing(patch, at, number)
        with pytest.raises((StoreError, RecordError), match=r"^cannot write '") as caught:
            evaluate(request, folder)
    sentence = str(caught.value)
    assert sentence.isprintable() and os.strerror(number).lower() in sentence
    assert ("free some space" in sentence) is (number in (errno.ENOSPC, errno.EDQUOT))
    assert len(written) == at and not (folder / "results.json").exists()
    assert not [p for p in folder.rglob("*") if ".partial" in p.name], "half a file was left behind"
    evaluate(request, folder, resume=True)
    assert without_provenance(folder) == without_provenance(reference)


def test_the_system_refuses_the_write_itself(whole, tmp_path):
    """For real: a limit on the size of files makes the kernel refuse half-way, as a full disk does."""
    request, reference, _ = whole
    folder = tmp_path / "run"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(
            resource.RLIMIT_FSIZE,
            (min((reference / name).stat().st_size for name in ("episodes.csv", "results.json")) - 1, limits[1]),
        )
        with pytest.raises(
            StoreError, match=r"(episodes.csv|results.json)': file too large; free some space and run again"
        ):
            evaluate(request, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    kept = {p.name: p.read_bytes() for p in (folder / "episodes").iterdir()}
    assert kept.items() >= {p.name: p.read_bytes() for p in (reference / "episodes").iterdir()}.items()
    evaluate(request, folder, resume=True)
    assert without_provenance(folder) == without_provenance(reference)


def test_results_stay_where_a_page_cannot_be_written(whole, monkeypatch):
    _, folder, _ = whole
    before = (folder / "results.json").read_bytes()
    failing(monkeypatch, 0, errno.ENOSPC)
    with pytest.raises(StoreError, match=r"report.html': no space left on device"):
        write_report(folder)
    assert (folder / "results.json").read_bytes() == before


@pytest.mark.skipif(not Path("/sys/kernel").exists(), reason="needs a file system that nobody writes to")
def test_a_file_system_that_nobody_writes_to(whole):
    for place in ("/sys/run", "/proc/run", "/dev/full", "/dev/null/run"):
        with pytest.raises(StoreError) as caught:
            evaluate(whole[0], Path(place))
        assert place in str(caught.value) and str(caught.value).isprintable()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_an_output_path_that_is_no_text(whole, tmp_path):
    """Of bytes that are no UTF-8, as old disks and foreign archives have them."""
    request, reference, _ = whole
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    evaluate(request, folder, command=["gaitgauge", "--out", str(folder)])
    page = write_report(folder)
    assert page.is_file() and page.read_text()
    assert without_provenance(folder) == without_provenance(reference)
    written = json.loads((folder / "results.json").read_text())
    assert written["provenance"]["command"].endswith("caf\\udce9'")
    evaluate(request, folder, resume=True)


ON_A_DISK = """
import sys
sys.path.insert(0, {tests!r})
import tiny_runs as runs
from gaitgauge.gauge.evaluate import Request
from pathlib import Path
try:
    runs.evaluate(Request(policy={policy!r}, suite={suite!r}, backend="fake"), Path({folder!r}), resume=True)
except (ValueError, RuntimeError) as error:
    print(type(error).__module__, error)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("options", "named"), [("size=24k", "no space left"), ("ro", "ead-only file system")])
def test_a_real_disk_that_is_full_or_read_only(whole, tmp_path, options, named):
    request, reference, _ = whole
    disk = tmp_path / "disk"
    disk.mkdir()
    if not shutil.which("unshare"):
        pytest.skip("needs unshare")
    mount = f"mount -t tmpfs -o {options} tmpfs {disk}"
    if subprocess.run(["unshare", "-rm", "sh", "-c", mount], capture_output=True).returncode:
        pytest.skip("file systems cannot be mounted here")
    child = ON_A_DISK.format(
        tests=str(Path(__file__).parent), policy=request.policy, suite=request.suite, folder=str(disk / "run")
    )
    keep = f"cp -r {disk}/run {tmp_path}/kept 2>/dev/null; true"
    script = f'{mount} && "$0" -c "$1" && {keep}'
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script, sys.executable, textwrap.dedent(child)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("gaitgauge.") and named in done.stdout and len(done.stdout.splitlines()) == 1
    if (tmp_path / "kept").exists():
        assert list((tmp_path / "kept" / "episodes").glob("*.npz")), "what was finished is gone"
        evaluate(request, tmp_path / "kept", resume=True)
        assert without_provenance(tmp_path / "kept") == without_provenance(reference)
