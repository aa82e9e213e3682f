"""Evaluations of a moment: a tiny suite on an engine without physics, and what of their results must be the same again."""

import json
from pathlib import Path
from unittest.mock import patch

import torch
from gaitgauge.backends import make_backend
from gaitgauge.gauge import evaluate as evaluation
from gaitgauge.gauge.evaluate import Request
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.native import StoredNetwork, save_policy
from gaitgauge.policy.networks.architectures import MlpNetwork
from gaitgauge_fake_engine import FakeScript
from scripted_gauge import GO2, Puppet

TINY = """
extends = "{base}"
name = "tiny"
version = "1.0.0"
goals = [
  {{ name = "diagonal_velocity", phases = [0.04, 0.02] }},
  {{ name = "max_velocity", phases = [0.04, 0.02] }},
  {{ name = "target_pos_velocity", phases = [] }},
]

[physics]
timestep = 0.01
substeps = 2

[matrix]
terrains = ["flat", "slope_fd"]
frictions = [0.6]
payloads = [0.0]
seeds = [0, 1]
search_seeds = [100, 101, 102]

[commands]
target_radius = 0.5
target_time = {{ slope = 0.3 }}
target_speed = {{ slope = 1.0 }}

[noise]
latency = 1

[settling]
shortest = 0.02
longest = 0.2

[metrics]
interval = 2

[scoring]
levels = 3
pass_rate = 0.6
bootstrap = 20
"""
SMALL = {"frame_width": 45, "num_actions": 12, "hidden": [8]}


def gliding(backend):
    """Robots rush up gentle slopes once they have settled, and never move on level 3."""
    level = torch.tensor([t.level for t in backend.scene.terrains])[backend.terrain_index]
    linear = torch.zeros(backend.num_worlds, 3, dtype=torch.float64)
    linear[:, 0] = 20.0 * (backend.state.time.ge(0.045) & level.ge(1) & level.le(2))
    return linear, torch.zeros_like(linear)


def puppets(name, scene, *, device="cpu", threads=1):
    return Puppet(scene, script=FakeScript(motion=gliding))


def evaluate(request, folder, *, make=None, **options):
    """An evaluation of a request, or of what was prepared from one, on the engine without physics where it names that."""
    asked = getattr(request, "request", request)
    make = make or (puppets if asked.backend == "fake" else make_backend)
    with patch.object(evaluation, "make_backend", make):
        return evaluation.evaluate(request, folder, **options)


def without_provenance(folder: Path) -> str:
    """The results of a run but for when, where and by what they came to be."""
    results = json.loads((folder / "results.json").read_text())
    del results["provenance"]
    return json.dumps(results)


def tiny_request(folder: Path, base: str = "gaitgauge-1", **choices) -> Request:
    """A request for the tiny suite and a small random policy, both written to a folder."""
    torch.manual_seed(0)
    state = MlpNetwork(**SMALL).state_dict()
    policy, suite = folder / "policy.gauge.pt", folder / f"{base}.toml"
    save_policy(policy, standard_contract(GO2), StoredNetwork(architecture="mlp", arguments=SMALL, state_dict=state))
    suite.write_text(TINY.format(base=base))
    return Request(**{"policy": str(policy), "suite": str(suite), "backend": "fake", **choices})
