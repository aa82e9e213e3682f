"""Recorded functions on a GPU."""

import pytest
import torch
from gaitgauge.backends.graphs import WARM_UP, RecordedFunction

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def test_every_call_counts_once_and_sees_its_arguments():
    total, calls = torch.zeros(3, device="cuda"), []

    def add(value):
        calls.append(1)
        total.add_(value)
        return total * 2.0

    recorded = RecordedFunction(add, "cuda")
    for k in range(WARM_UP + 4):
        doubled = recorded(torch.full((3,), float(k), device="cuda"))
        assert total.tolist() == [sum(range(k + 1))] * 3
        assert doubled.tolist() == [2.0 * sum(range(k + 1))] * 3
    assert len(calls) == WARM_UP + 1 and recorded.recordings == 1
    recorded.forget()
    assert recorded.due
    recorded(torch.zeros(3, device="cuda"))
    assert recorded.recordings == 2


def test_what_waits_for_the_device_cannot_be_recorded_and_has_not_run():
    total = torch.zeros(1, device="cuda")

    def wait():
        total.add_(1.0)
        return total.item()

    recorded = RecordedFunction(wait, "cuda", warm_up=1)
    assert recorded() == 1.0
    with pytest.raises(RuntimeError):
        recorded()
    torch.cuda.synchronize()
    assert total.item() == 1.0 and recorded.due


def test_random_numbers_go_on_after_a_recording_that_failed():
    torch.cuda.manual_seed(3)
    wanted = torch.rand(4, device="cuda").tolist(), torch.rand(4, device="cuda").tolist()
    torch.cuda.manual_seed(3)
    first = torch.rand(4, device="cuda").tolist()
    with pytest.raises(RuntimeError):
        RecordedFunction(lambda: torch.zeros(1, device="cuda").item(), "cuda", warm_up=0)()
    torch.cuda.synchronize()
    assert (first, torch.rand(4, device="cuda").tolist()) == wanted


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="no second CUDA device")
def test_any_gpu_records_whichever_is_the_current_one():
    total = torch.zeros(3, device="cuda:1")

    def add():
        return total.add_(1.0) * 2.0

    recorded = RecordedFunction(add, "cuda:1")
    assert torch.cuda.current_device() == 0
    for k in range(WARM_UP + 3):
        assert recorded().tolist() == [2.0 * (k + 1)] * 3
    assert recorded.recordings == 1
