"""Describe policies that walk wrongly in ten ways, and print what the doctor finds and how long it takes.

    python benchmarks/doctor_cases.py [--threads N]

Five of the policies are made as no preset says.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import torch
from gaitgauge.policy.base import Policy, PolicySession
from gaitgauge.policy.contract import ObservationTerm, PolicyContract, reordered
from gaitgauge.policy.loading import load_policy
from gaitgauge.robots import load_robot
from gaitgauge.studies.doctor.diagnosis import Diagnosis, diagnose

PLAIN = load_policy("pretrained").contract
JOINTS = PLAIN.joint_names
BY_KIND = tuple(JOINTS[leg * 3 + kind] for kind in range(3) for leg in range(4))
RIGHT_FIRST = tuple(JOINTS[(leg ^ 1) * 3 + kind] for leg in range(4) for kind in range(3))


def with_scales(contract: PolicyContract, **scales: float) -> PolicyContract:
    """Other scales of some terms."""
    terms = (replace(t, scale=(scales[t.name],)) if t.name in scales else t for t in contract.observation)
    return replace(contract, observation=tuple(terms))


def in_order(contract: PolicyContract, *names: str) -> PolicyContract:
    """Terms in another order."""
    return replace(contract, observation=tuple(next(t for t in contract.observation if t.name == n) for n in names))


class Disguised(Policy):
    """The policy that ships, behind another contract: its observations are put back, its actions turned into those asked for."""

    def __init__(self, contract: PolicyContract) -> None:
        self.contract = self.truth = contract
        self.path = "disguised"
        self.inner = load_policy("pretrained")

    def session(self, num_episodes: int, *, device: str = "cpu") -> PolicySession:
        """Return a session of the policy that ships, behind the contract that is right."""
        return _Session(self.truth, self.inner.session(num_episodes, device=device))


class _Session(PolicySession):
    def __init__(self, truth: PolicyContract, inner: PolicySession) -> None:
        self.inner, self.truth = inner, truth
        self.joint = [truth.joint_names.index(name) for name in JOINTS]
        factor = [o / s for o, s in zip(reordered(truth, JOINTS).action_scale, PLAIN.action_scale, strict=True)]
        self.action = torch.tensor(factor)

    def reset(self, episodes: torch.Tensor | None = None) -> None:
        self.inner.reset(episodes)

    def act(self, observation: torch.Tensor, rows: torch.Tensor | None = None) -> torch.Tensor:
        history = self.truth.history
        frames = observation.view(len(observation), history.length, -1)
        newest = frames[:, 0 if history.order == "frame-major-newest-first" else -1]
        blocks = dict(
            zip((t.name for t in self.truth.observation), newest.split(self.truth.term_widths, 1), strict=True)
        )
        found = [self.restored(term, blocks) for term in PLAIN.observation]
        action = self.inner.act(torch.cat(found, 1), rows) / self.action
        return action[:, [JOINTS.index(name) for name in self.truth.joint_names]]

    def restored(self, plain: ObservationTerm, blocks: dict[str, torch.Tensor]) -> torch.Tensor:
        mine = next(t for t in self.truth.observation if t.name == plain.name)
        value = blocks[plain.name] / torch.tensor(mine.scale) * torch.tensor(plain.scale)
        if plain.name.startswith("joint") or plain.name == "last_action":
            value = value[:, self.joint]
        return value * self.action if plain.name == "last_action" else value


ODD = in_order(
    with_scales(reordered(PLAIN, BY_KIND), base_angular_velocity_b=0.2, joint_velocity=0.1),
    *("projected_gravity_b", "base_angular_velocity_b", "joint_position", "joint_velocity", "last_action", "command"),
)
"""A policy that is made as no preset says."""
STACKED = replace(ODD, history=replace(ODD.history, length=6, order="frame-major-newest-first"))


@dataclass(frozen=True, kw_only=True)
class Case:
    """A policy, how it is described, and the kinds of mistakes in that."""

    name: str
    truth: PolicyContract
    described: PolicyContract
    kinds: frozenset[str]

    def policy(self) -> Policy:
        """Return the policy with its wrong description."""
        policy = Disguised(self.truth)
        policy.contract = self.described
        return policy

    def right(self, found: Diagnosis) -> bool:
        """Return whether a diagnosis names these kinds and ends with a policy that walks."""
        return {each.kind for each in found.mistakes} == self.kinds and found.best.score > _WALKS


_WALKS = 0.8


def _case(name: str, truth: PolicyContract, described: PolicyContract, *kinds: str) -> Case:
    return Case(name=name, truth=truth, described=described, kinds=frozenset(kinds))


_GRAVITY = {"projected_gravity_b": -1.0}
CASES = (
    _case("joint order", PLAIN, replace(PLAIN, joint_names=RIGHT_FIRST), "joint order"),
    _case("sign of gravity", PLAIN, with_scales(PLAIN, **_GRAVITY), "sign of gravity"),
    _case("gains", PLAIN, replace(PLAIN, stiffness=(80.0,) * 12, damping=(2.0,) * 12), "gains"),
    _case("scale of joint velocities", PLAIN, with_scales(PLAIN, joint_velocity=1.0), "observation scale"),
    _case(
        "four at once",
        PLAIN,
        replace(
            with_scales(PLAIN, joint_velocity=1.0),
            joint_names=BY_KIND,
            action_scale=(0.5,) * 12,
            default_joint_position=(0.0,) * 12,
        ),
        *("joint order", "observation scale", "action scale", "default pose"),
    ),
    _case("no preset: joint order", ODD, reordered(ODD, JOINTS), "joint order"),
    _case("no preset: sign of actions", ODD, replace(ODD, action_scale=(-0.25,) * 12), "sign of actions"),
    _case("no preset: scale", ODD, with_scales(ODD, joint_velocity=1.0), "observation scale"),
    _case(
        "no preset: order of history",
        STACKED,
        replace(STACKED, history=replace(STACKED.history, order="frame-major")),
        "order of history",
    ),
    _case(
        "no preset: order and scale",
        ODD,
        replace(with_scales(ODD, joint_velocity=1.0), joint_names=JOINTS),
        *("joint order", "observation scale"),
    ),
)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    threads = parser.parse_args().threads
    print("| what is wrong | found | right | score as described | score found | processor seconds |")
    print("| --- | --- | --- | --- | --- | --- |")
    for case in CASES:
        begin = time.process_time()
        found = diagnose(case.policy(), load_robot("go2"), threads=threads)
        kinds = ", ".join(dict.fromkeys(each.kind for each in found.mistakes)) or "nothing"
        scores = f"{found.described.score:.2f} | {found.best.score:.2f}"
        right = "yes" if case.right(found) else "no"
        print(f"| {case.name} | {kinds} | {right} | {scores} | {time.process_time() - begin:.1f} |", flush=True)


if __name__ == "__main__":
    main()
