"""Find what a policy was probably made for, where it does not walk as it is described.

The described contract and the presets of training codes and controllers are played first, side by side. Where none of them
walks, likely changes are tried one after the other. What counts is whether the robot stays up, whether it does what it is told,
and how smoothly its motors work. At the end only those differences from the description remain that the walking needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

from ...policy.base import Policy
from ...policy.contract import PolicyContract, check_robot
from ...policy.foreign.presets import find_preset, fitting_presets
from ...robots import Robot
from .alternatives import Alternative, alternatives
from .bench import Bench, DiagnosisError, Outcome
from .differences import Change, changed, differences

__all__ = ["CLEAR", "SOUND", "Diagnosis", "DiagnosisError", "Outcome", "diagnose"]

SOUND = 0.7
"""Score from which a robot walks; one that stands still has about 0.6."""
CLEAR = 0.05
"""How much better another contract must be before anything is said [score]."""
_DOUBT = 0.08
"""The same where the robot walks as described: other gains or a larger action scale alone are worth up to 0.07."""
_GOOD = 0.82
"""Score from which nothing further is looked for; trained policies that are described rightly have 0.78 to 0.91."""
_NEEDED = 0.02
"""Loss of score up to which a difference from the description is left out."""
_MOST = 4
"""Changes at once that are looked for."""
_SHORT = 0.4
"""Share of the time for which all likely changes are played; the best of them are played for the whole time."""
_BEST = 8
"""Changes of each start that are played for the whole time."""
_SEEN = ("observation scale", "order of observations", "sign of gravity", "order of history")
_BEGUN = 2
"""Kinds of changes from which a next one is looked for, of each start: the description and the best preset."""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Outcomes of a policy as described, and with every likely other contract."""

    described: Outcome
    others: tuple[Outcome, ...]
    """Presets, and contracts one change away where they were played, best first."""
    mistakes: tuple[Outcome, ...]
    """Changes that make it clearly better, each on top of those before it; empty where there are none."""
    preset: str | None = None
    """Name of the preset that led to the best contract."""

    @property
    def best(self) -> Outcome:
        """The contract that the policy was most likely made for."""
        return self.mistakes[-1] if self.mistakes else self.described

    @property
    def sound(self) -> bool:
        """Return whether the robot walks as described, and no other contract is clearly better."""
        return not self.mistakes and self.described.score >= SOUND

    @property
    def rivals(self) -> tuple[Outcome, ...]:
        """Changes of another kind that are about as good as the first mistake."""
        if not self.mistakes:
            return ()
        first = self.mistakes[0]
        kinds = (first.kind, _PRESET)
        return tuple(o for o in self.others if o.kind not in kinds and o.score > first.score - CLEAR)

    def verdict(self) -> str:
        """Return one sentence for people."""
        score, best = self.described.score, self.best.score
        if self.sound:
            return f"nothing looks wrong: as described the robot stays up and does what it is told (score {score:.2f} of 1)"
        if not self.mistakes:
            return (
                f"the robot does not walk as described (score {score:.2f} of 1), and none of {len(self.others)} likely changes "
                "helps: the policy was made for something else, or more than one thing is wrong"
            )
        kinds = list(dict.fromkeys(each.kind for each in self.mistakes))
        names = " and ".join(f"the {kind}" for kind in kinds)
        changes = ", then ".join(f"{each.kind} {each.text}" for each in self.mistakes)
        verb = "look" if len(kinds) > 1 else "looks"
        text = f"{names} {verb} wrong: with {changes}, the score rises from {score:.2f} to {best:.2f} of 1"
        if best < SOUND:
            text += ", which is not yet walking, so something else is wrong, too"
        elif len(self.mistakes) == 1 and self.rivals:
            others = ", ".join(dict.fromkeys(each.kind for each in self.rivals))
            text += f"; changes of another kind do about as well ({others})"
        if self.preset is not None and best >= SOUND:
            text += f"; {find_preset(self.preset).title} runs its policies this way (preset {self.preset})"
        return text


_PRESET = "preset"
Report = Callable[[int, int, int], None]


def _no_report(changes: int, count: int, played: int) -> None:
    """Report nothing."""


def diagnose(
    policy: Policy,
    robot: Robot,
    *,
    seconds: float = 2.0,
    threads: int = 1,
    report: Report = _no_report,
) -> Diagnosis:
    """Play a policy as described, as presets say, and, where it does not walk yet, with likely changes one after the other.

    Args:
        report: called with the number of changes that the contracts being played differ in, how many there are, and how many
            of them have been played.

    Raises:
        ContractError: the policy is not for this robot.
        DiagnosisError: its control period is not a multiple of the physics step.
        BackendError: the engine cannot do this.
    """
    given = policy.contract
    check_robot(given, robot)
    with closing(Bench(policy, robot, threads=threads)) as bench:
        starts = [Alternative(kind="", text="as described", contract=given), *_presets(given, robot)]
        described, *others = bench.play(starts, seconds, partial(report, 1, len(starts)))
        best = max((described, *others), key=lambda each: each.score)
        if best.score < max(_GOOD, described.score + CLEAR) and described.score < _GOOD:
            best, nearby = _search(bench, robot, described, others, seconds, report)
            others += nearby
        mistakes: tuple[Outcome, ...] = ()
        if best.score > described.score + (_DOUBT if described.score >= SOUND else CLEAR):
            mistakes = _explained(bench, robot, given, best, seconds)
    name = best.contract.provenance.get(_PRESET)
    return Diagnosis(
        described=described, others=tuple(_sorted(others)), mistakes=mistakes, preset=name if mistakes else None
    )


def _presets(given: PolicyContract, robot: Robot) -> list[Alternative]:
    """Return the presets that fit a policy's input, with its own times and limits."""
    found: dict[str, Alternative] = {}
    for name, contract in fitting_presets(robot, given.observation_width).items():
        adapted = replace(
            contract,
            control_period=given.control_period,
            command_limits=given.command_limits,
            provenance={_PRESET: name},
        )
        found.setdefault(adapted.hash, Alternative(kind=_PRESET, text=find_preset(name).title, contract=adapted))
    return [each for key, each in found.items() if key != given.hash]


def _search(
    bench: Bench,
    robot: Robot,
    described: Outcome,
    presets: Sequence[Outcome],
    seconds: float,
    report: Report,
) -> tuple[Outcome, list[Outcome]]:
    """Change one thing after the other, from the description and from the best preset on.

    Returns:
        The best contract found, and what is one change away from the description.
    """
    best = described
    nearby: list[Outcome] = []
    seen = {each.contract.hash for each in (described, *presets)}
    begun = [[described]]
    if presets and (first := _sorted(presets)[0]).score > described.score + CLEAR:
        best = first
        begun.append([first])
    for level in range(_MOST):
        near: list[list[Alternative]] = []
        for group in begun:
            found = {a.contract.hash: a for one in group for a in alternatives(one.contract, robot)}
            near.append([each for key, each in found.items() if key not in seen])
            seen |= found.keys()
        if level == 1 and best.score < SOUND:  # a wrong order hides whatever else is wrong
            near[0] += [each for each in _behind_orders(described.contract, robot) if each.contract.hash not in seen]
            seen |= {each.contract.hash for each in near[0]}
        chosen = [each for group in near for each in group]
        short = bench.play(chosen, _SHORT * seconds, partial(report, level + 1, len(chosen)))
        left, made = iter(short), list[list[Outcome]]()
        for tried in near:
            brief = _sorted(next(left) for _ in tried)
            whole = bench.play(brief[:_BEST], seconds)
            made.append(_sorted(whole))
            if level == 0 and not nearby:
                nearby = whole + brief[_BEST:]
        begun = [_of_each_kind(group)[:_BEGUN] for group in made]
        reached = max((group[0] for group in begun if group), key=lambda each: each.score, default=best)
        if level > 0 and reached.score <= best.score + _NEEDED:
            break
        best = max(best, reached, key=lambda each: each.score)
        if best.score >= _GOOD:
            break
    return best, nearby


def _behind_orders(contract: PolicyContract, robot: Robot) -> list[Alternative]:
    """Return contracts with another order of joints and one more thing that decides what the network sees."""
    orders = [each.contract for each in alternatives(contract, robot) if each.kind == "joint order"]
    found = {a.contract.hash: a for one in orders for a in alternatives(one, robot) if a.kind in _SEEN}
    return list(found.values())


def _of_each_kind(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the first outcome of each kind of change."""
    first: dict[str, Outcome] = {}
    for each in outcomes:
        first.setdefault(each.kind, each)
    return list(first.values())


def _explained(bench: Bench, robot: Robot, given: PolicyContract, best: Outcome, seconds: float) -> tuple[Outcome, ...]:
    """Return the changes that the best contract needs, each on top of those before it; the one that matters most comes first."""
    changes = differences(given, best.contract, robot)

    def played(sets: Iterable[Sequence[Change]]) -> list[Outcome]:
        listed = list(sets)
        made = [
            Alternative(
                kind=each[-1].kind if each else "", text=each[-1].text if each else "", contract=changed(given, each)
            )
            for each in listed
        ]
        return bench.play(made, seconds)

    without = played([[c for c in changes if c is not left_out] for left_out in changes])
    score = {id(change): each.score for change, each in zip(changes, without, strict=True)}
    changes.sort(key=lambda change: score[id(change)])
    # of those that can be left out alone, as many as can be left out together
    spare = [n for n in range(1, len(changes)) if score[id(changes[-n])] >= best.score - _NEEDED]
    if spare:
        fewer = played([changes[:-n] for n in spare])
        changes = changes[
            : -max((n for n, each in zip(spare, fewer, strict=True) if each.score >= best.score - _NEEDED), default=0)
            or None
        ]
    return tuple(played([changes[: n + 1] for n in range(len(changes))]))


def _sorted(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return outcomes, the best first."""
    return sorted(outcomes, key=lambda each: -each.score)
