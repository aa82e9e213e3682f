"""Choices that requests share."""

import os

import pytest
from gaitgauge.files.choices import cores, cpu_threads


def test_a_job_with_two_cores_of_a_large_machine_starts_two_workers(monkeypatch):
    """With os.cpu_count() a cluster's job of 2 cores on 64 started 64."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3, 7}, raising=False)
    assert (cores(), cpu_threads(None), cpu_threads(5)) == (2, 2, 5)


@pytest.mark.parametrize(("count", "expected"), [(8, 8), (None, 1)])
def test_systems_without_affinity_count_their_cores(monkeypatch, count, expected):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr("os.cpu_count", lambda: count)
    assert cores() == expected
