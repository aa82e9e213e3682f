"""The remaining time of a sweep: trainings share places, one gauging at a time follows them."""

import os
import time

import pytest
from gaitgauge.training.sweep.schedule import Running, seconds_left, told_left


def left(running, *, to_train=0, to_gauge=0, places=1, trained=(), gauged=()):
    return seconds_left(running, to_train=to_train, to_gauge=to_gauge, places=places, trained=trained, gauged=gauged)


def training(spent, own):
    return Running(gauges=False, spent=spent, left=own)


@pytest.mark.parametrize(
    ("choices", "seconds"),
    [
        ({"running": [training(5.0, None)], "to_train": 3}, None),
        # 100 s each: 60 s of the first, three more, the last one's gauging of 10 s
        ({"running": [training(40.0, 60.0)], "to_train": 3}, 60.0 + 300.0 + 10.0),
        ({"running": [training(40.0, 60.0), training(40.0, 60.0)], "to_train": 3, "places": 2}, 60.0 + 200.0 + 10.0),
        # gaugings take longer than trainings: they queue
        ({"running": [training(90.0, 10.0)], "trained": [100.0], "gauged": [300.0], "to_gauge": 2}, 900.0),
        ({"running": [Running(gauges=True, spent=10.0, left=None)], "gauged": [30.0]}, 20.0),
        ({"running": [Running(gauges=True, spent=10.0, left=5.0)], "gauged": [30.0], "to_gauge": 1}, 5.0 + 22.5),
    ],
)
def test_the_rest_of_a_sweep_by_hand(choices, seconds):
    found = left(**choices)
    assert found is None if seconds is None else found == pytest.approx(seconds)


def test_a_process_tells_its_rest_in_its_log(tmp_path):
    log = tmp_path / "train.log"
    assert told_left(log) is None
    log.write_text("8 s: go2, iteration 1 of 9, estimating time\n")
    assert told_left(log) is None
    log.write_text(
        "1 h 00 min: go2, iteration 3 of 9, 2 h 05 min left, reward 3\n16 s: gauging, about 1 min 30 s left, now: x\n"
    )
    assert told_left(log) == pytest.approx(90.0, abs=2.0)
    os.utime(log, (time.time() - 50.0,) * 2)
    assert told_left(log) == pytest.approx(40.0, abs=2.0)
    log.write_text("2 h 05 min left")
    assert told_left(log) == pytest.approx(7500.0, abs=2.0)
