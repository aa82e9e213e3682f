"""Results as ``evaluate`` writes them, from synthetic records, and a page taken apart."""

import math
import zlib
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
from gaitgauge.backends.base import PhysicsBackend
from gaitgauge.gauge.coverage import coverage
from gaitgauge.gauge.episodes import Record
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.plan import PlanRules, environment_result, plan
from gaitgauge.gauge.result import (
    CommandShares,
    EnvironmentRow,
    Feet,
    Motors,
    PolicyName,
    Provenance,
    Result,
    TrainingPhysics,
)
from gaitgauge.gauge.results import fold
from gaitgauge.gauge.store import StoreError
from gaitgauge.gauge.suite import load_suite
from gaitgauge.gauge.totals import health_of, totals, whole_row

HOSTILE = 'a/<img src="http://evil.example/x.png" onerror=alert(1)></script><script>alert(2)</script>&"\'.pt'


REACH = {"slope_fd": 7, "slope_bd": 6, "stairs_fd": 9, "stairs_bd": 4, "wave": 8, "obstacle": 3}


def ended(suite, episode, generator, reached):
    """A record of random but plausible samples, worse on harder ground and slippery floors; a target met up to a level."""
    if episode.stage == "search":
        return Record(episode=episode, success=episode.level <= reached)
    names = [*suite.metrics.weights, "quality"]
    centre = 0.82 - 0.03 * episode.level - 0.15 * (episode.friction < 0.35)
    by_metric = np.array([0.12 * math.sin(zlib.crc32(n.encode())) for n in names])
    samples = np.clip(centre + by_metric + 0.12 * generator.standard_normal((120, len(names))), 0, 1).astype(np.float32)
    return Record(
        episode=episode,
        falls=int(generator.random() < 0.04),
        columns=tuple(names),
        samples=samples,
        goal_index=np.repeat([0, 1], 60).astype(np.int16),
        part_index=np.tile(np.repeat(np.arange(6), 10), 2).astype(np.int16),
    )


def sample(pipeline="stress", suite="robogauge-1.1", resamples=10, **choices):
    """Return what ``evaluate`` would find, from synthetic records."""
    return _sample(pipeline, suite, resamples, **choices)


def sample_data(*names, **choices):
    """Return the content of the file of a sample, for the test to edit."""
    return sample(*names, **choices).to_data()


def read(data, error=StoreError):
    """Return the result that an edited file describes."""
    return Result.from_data(data, "it", error)


@cache
def _sample(pipeline, suite, resamples, reach=None, seed=0, **choices):
    suite = load_suite(suite)
    suite = replace(suite, scoring=replace(suite.scoring, bootstrap=resamples))
    generator = np.random.default_rng(seed)
    chosen = {"terrains": suite.matrix.terrains, "frictions": None, "payloads": None, "level": None, **choices}
    rules = PlanRules(suite=suite, seeds=suite.matrix.seeds, quality=pipeline != "level")
    environments = []
    for environment in make_environments(suite, **chosen):
        handicap = round(6 * max(0.0, 0.4 - environment.friction) + max(0.0, environment.payload))
        reached = (REACH.get(environment.terrain, 0) if reach is None else reach) - 2 * handicap
        records = {}
        while required := plan(environment, records, rules).required:
            records |= {e: ended(suite, e, generator, reached) for e in required}
        environments.append(environment_result(environment, records, rules))
    scores = fold(suite, environments, (*suite.metrics.weights, "quality"))
    return Result(
        **vars(scores),
        coverage=coverage(suite, make_environments(suite, **chosen), suite.matrix.seeds, pipeline=pipeline),
        policy=PolicyName(
            path="policies/go2_cts.pt",
            contract_hash="ab" * 32,
            file_sha256="cd" * 32,
            observations=("base_angular_velocity_b", "command", "joint_position"),
            kind_of_observations="measurable",
            provenance={"adapter": "TorchScript", "steps": 5},
        ),
        pipeline=pipeline,
        backend="mujoco",
        robot="go2",
        motors=Motors(stiffness=(20.0,) * 12, damping=(0.5,) * 12),
        training=TrainingPhysics(note="unknown"),
        commands=CommandShares(limits=(2.0, 1.0, 2.0)),
        feet=Feet(dimension=(6,), torsion=0.02),
        solver=PhysicsBackend.solver_settings(suite.physics),
        health=health_of(scores.environments),
        provenance=Provenance(
            digests={"policy": "cd" * 32, "robot": "ef" * 32, "suite": suite.digest, "source": "12" * 32},
            versions={"python": "3.11.2", "gaitgauge": "0.1.0", "mujoco": "3.17.0", "torch": "2.13.0"},
            command="gaitgauge evaluate policies/go2_cts.pt --suite robogauge-1.1",
            date="2026-01-02T03:04:05+00:00",
            host="lab",
            machine="x86_64, 2 CPUs, Linux 6.1",
            device="cpu",
            threads=2,
            seconds=152.5,
            physics_steps=1_234_567,
        ),
    )


def made_of(result, rows):
    """Return a result whose figures were all made anew of other rows, as a forger with the program would."""
    scores = totals(
        [whole_row(row, result.chance) for row in rows],
        result.chance,
        suite=result.suite,
        groups=result.group_metrics,
        metrics=list(result.metrics),
        evaluated=result.score is not None,
    )
    return replace(result, **vars(scores) | {"health": health_of(scores.environments), "lacking": frozenset()})


PIPELINES = {
    "base": {"terrains": ("flat",), "frictions": (0.6,), "payloads": (0.0,)},
    "multi": {"terrains": ("slope_fd", "wave"), "frictions": (0.4, 0.6), "payloads": (0.0, 2.0), "level": 5},
    "level": {"terrains": tuple(REACH)},
    "stress": {},
}


class Page(HTMLParser):
    """Collects tags with their attributes, and text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta", "input", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if self.open[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    def count(self, tag):
        return sum(t == tag for t, _ in self.tags)


def row(terrain="wave", friction=0.6, payload=0.0, level=5, **more):
    return EnvironmentRow(terrain=terrain, friction=friction, payload=payload, level=level, **more)
