"""``episodes.csv``: a row for each episode, then one for each of its sub-commands."""

import csv

import numpy as np
import pytest
from gaitgauge.gauge.episodes import Episode, Record
from gaitgauge.gauge.results import rows_csv

EPISODE = Episode(
    terrain="flat",
    level=0,
    friction=1.0,
    payload=0.0,
    seed=0,
    stage="eval",
    goals=("diagonal_velocity", "max_velocity"),
)


@pytest.mark.parametrize(
    ("fallen", "told"),
    [((), ["0", "0", "0"]), (((0, 1), (1, 3), (0, 1)), ["0", "2", "1"]), (None, ["", "", ""])],
)
def test_falls_stand_with_the_sub_command_in_which_they_happened(fallen, told):
    record = Record(
        episode=EPISODE,
        falls=3 if fallen is None else len(fallen),
        fallen=fallen,
        columns=("quality",),
        samples=np.full((6, 1), 0.5, np.float32),
        goal_index=np.array([0, 0, 0, 0, 1, 1], np.int16),
        part_index=np.array([0, 0, 1, 1, 3, 3], np.int16),
    )
    whole, *parts = csv.DictReader(rows_csv([record]).splitlines())
    assert whole["command"] == "all" and int(whole["falls"]) == record.falls
    assert [row["goals"] for row in parts] == ["diagonal_velocity", "diagonal_velocity", "max_velocity"]
    assert [row["falls"] for row in parts] == told


@pytest.mark.parametrize(
    ("touching", "told"),
    [(None, ["", "", "", ""]), ([True, False, False, False, True, True], ["0.5", "0.5", "0.0", "1.0"])],
)
def test_self_contact_stands_with_the_sub_command_in_which_it_happened(touching, told):
    record = Record(
        episode=EPISODE,
        columns=("quality",),
        samples=np.full((6, 1), 0.5, np.float32),
        goal_index=np.array([0, 0, 0, 0, 1, 1], np.int16),
        part_index=np.array([0, 0, 1, 1, 3, 3], np.int16),
        touching=None if touching is None else np.array(touching),
    )
    assert [row["self_contact"] for row in csv.DictReader(rows_csv([record]).splitlines())] == told
