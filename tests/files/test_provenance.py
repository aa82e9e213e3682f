"""Where a result comes from: the commit of its source, and the versions of what decided it."""

import subprocess
from importlib.metadata import PackageNotFoundError

import pytest
from gaitgauge import __version__
from gaitgauge.files import provenance


@pytest.fixture(autouse=True)
def _asked_anew():
    """Versions and commit are asked for once in a process."""
    provenance.commit.cache_clear()
    provenance.versions.cache_clear()
    yield
    provenance.commit.cache_clear()
    provenance.versions.cache_clear()


def _git(folder, *arguments):
    who = ("-c", "user.name=n", "-c", "user.email=n@example.org", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_commit_is_that_of_the_source_and_says_where_it_was_changed_since(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    _git(tmp_path, "init", "-q")
    (tmp_path / "a.py").write_text("1\n")
    _git(tmp_path, "add", "a.py")
    _git(tmp_path, "commit", "-q", "-m", "one")
    head = _git(tmp_path, "rev-parse", "HEAD")
    assert provenance.provenance(command=["gaitgauge"])["commit"] == head
    (tmp_path / "a.py").write_text("2\n")
    provenance.commit.cache_clear()
    assert provenance.commit() == f"{head}-dirty"


def test_source_without_a_repository_has_no_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    assert provenance.commit() is None


def test_source_that_is_run_without_being_installed_has_its_version_all_the_same(monkeypatch):
    def version(package):
        raise PackageNotFoundError(package)

    monkeypatch.setattr(provenance, "version", version)
    found = provenance.versions()
    assert found["gaitgauge"] == __version__
    assert found["mujoco"] == "not installed"


def test_source_has_a_digest_that_changes_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    (tmp_path / "gauge").mkdir()
    found = set()
    for text in ("1\n", "2\n"):
        (tmp_path / "gauge" / "a.py").write_text(text)
        provenance.source_digest.cache_clear()
        found.add(provenance.source_digest())
    provenance.source_digest.cache_clear()
    assert len(found) == 2
