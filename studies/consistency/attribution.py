"""Attribution: one option switched at a time, everything else as the suite has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...backends.base import PhysicsOptions, Support
from ...backends.registry import backend_class
from ...gauge.episodes import QUALITY
from ...gauge.plan import Records
from .closed_loop import Design
from .request import ConsistencyError
from .variants import Value, Variant

PERTURBATION = 1e-7
"""Relative change of the state at each reset, and of the targets, that shows what chaos alone does: one rounding of float32."""
FLOOR_DRAWS = 3
"""Times that the reference engine is perturbed, each time otherwise: one draw would take its own luck for the floor."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One thing that engines may do differently."""

    name: str
    title: str
    option: str = ""
    """Field of ``PhysicsOptions``; empty for a perturbed state."""
    value: Value = None
    perturbation: float = 0.0
    """Relative change of the state at each reset, where there is no option; 0 for single precision all along."""
    fixed_buffers_only: bool = False
    """True where it matters only to engines that hold contacts in buffers of fixed size."""

    def applies(self, variant: Variant, suite: PhysicsOptions) -> bool:
        """Return whether switching it changes anything in an engine."""
        if not self.option:
            return True
        if self.fixed_buffers_only and backend_class(variant.backend).capabilities()["gpu"].support is Support.NONE:
            return False
        return getattr(variant.physics(suite), self.option) != self.value

    def switch(self, variant: Variant) -> Variant:
        """The engine with the factor switched."""
        if self.option:
            return variant.switched(self.option, self.value)
        return replace(variant, perturbation=self.perturbation, draw=1) if self.perturbation else rounded(variant)


def rounded(variant: Variant, draw: int = 1) -> Variant:
    """The same engine with state and targets put off as single precision puts them off."""
    return replace(variant, perturbation=PERTURBATION, draw=draw, rounding=True)


FACTORS: tuple[Factor, ...] = (
    Factor(name="precision", title="state and targets off by 1e-7, as in float32"),
    Factor(name="state-1e-5", title="initial state off by 1e-5", perturbation=1e-5),
    Factor(name="state-1e-3", title="initial state off by 1e-3", perturbation=1e-3),
    Factor(name="timestep-1ms", title="timestep 1 ms", option="timestep", value=0.001),
    Factor(name="timestep-5ms", title="timestep 5 ms", option="timestep", value=0.005),
    Factor(name="cone", title="pyramidal friction cone", option="cone", value="pyramidal"),
    Factor(name="feet", title="feet that turn and roll freely", option="foot_condim", value=3),
    Factor(name="impratio", title="impratio 1", option="impratio", value=1.0),
    Factor(name="iterations", title="3 solver iterations", option="iterations", value=3),
    Factor(name="tolerance", title="solver tolerance 1e-5", option="tolerance", value=1e-5),
    Factor(
        name="contacts",
        title="room for 100 contacts in each world",
        option="contacts_per_world",
        value=100,
        fixed_buffers_only=True,
    ),
)


def choose_factors(names: Sequence[str]) -> tuple[Factor, ...]:
    """Factors by name, all for none. Raises ConsistencyError: an unknown name."""
    known = {f.name: f for f in FACTORS}
    for name in names:
        if name not in known:
            raise ConsistencyError(f"there is no factor '{name}' to switch; choose from {', '.join(known)} (--factor)")
    return tuple(f for f in FACTORS if not names or f.name in names)


def effect_of_switch(
    design: Design, base: Records, switched: Records, others: dict[str, Records], *, name: str
) -> dict[str, Any]:
    """What switching a factor does to an engine's score and metrics, and to its gap to other engines.

    Args:
        others: records by label of the engines that differ from ``base``.
        name: seeds the intervals' generators.

    Returns:
        Plain data: ``gap`` and signed ``difference`` of the engine to itself, ``metrics`` with their signed differences, and
        for each other engine the ``gap_before`` and ``gap_after`` the switch with the paired ``change``: where its interval lies
        below zero, the switch brings the engines together; where it is ``equivalent`` to none, the factor is no cause.
    """
    first, second = design.table(base), design.table(switched)
    shift = second.column(QUALITY) - first.column(QUALITY)
    to: dict[str, Any] = {}
    for label, records in others.items():
        target = design.table(records).column(QUALITY)
        before = np.abs(target - first.column(QUALITY))
        after = np.abs(target - second.column(QUALITY))
        to[label] = {
            "gap_before": design.mean(before),
            "gap_after": design.mean(after),
            **design.judged(after - before, f"{name}/{label}/change", key="change"),
        }
    return {
        "score": design.mean(second.column(QUALITY)),
        "gap": design.estimate(np.abs(shift), f"{name}/gap", magnitude=True).plain(),
        "difference": design.estimate(shift, f"{name}/difference").plain(),
        "metrics": {
            metric: design.estimate(second.column(metric) - first.column(metric), f"{name}/{metric}").plain()
            for metric in first.columns[:-1]
        },
        "to": to,
    }
