"""Fit a robot's joint constants to logs of it: nonlinear least squares on simulated motions, with intervals and what stays unknown.

The legs of a hung robot are independent trees, so one simulation perturbs one joint of every leg, and a column of the Jacobian
for each of them follows from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...robots import JointParameters
from ...robots.sets import joint_groups
from .log import Array, Log, LogError
from .residuals import BLOCK, SETTLING
from .rig import FixedRig, acting_parameters, at_rows, beginning, held_targets, num_steps

_ROWS_PER_SECOND = 100.0
"""Rows of a log that are compared [1/s]; neighbouring rows of faster logs say the same."""
_KNOWN = 0.5
"""Largest ratio of an unknown's standard deviation after and before the logs at which they count as having told it."""
_TORQUE_WEIGHT = 0.5
"""Weight of a torque's squared difference beside a position's, each in units of the nominal set's RMS."""
_LEVEL = 0.98
"""Probability with which an interval is to hold its constant."""
_ITERATIONS = 12
_TURNS, _SETTLED = 8, 0.2
"""Most fits in a row, and the relative change of the residuals' weight below which it is no longer corrected."""
_STEP = 0.02
"""Perturbation for derivatives, in standard deviations of the prior."""

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A constant that is identified."""

    spread: float
    """Standard deviation of its prior."""
    low: float
    high: float
    each_joint: bool = False
    """True where every joint has its own, False where all joints of a group share it."""
    apart: float | None = None
    """Standard deviation of the joints of a group from each other, where they are alike: that of what they share is ``spread``."""
    unit: str = ""


KINDS: dict[str, Kind] = {
    "armature": Kind(spread=0.02, low=1e-5, high=1.0, unit="kg·m²"),
    "joint_damping": Kind(spread=0.3, low=0.0, high=20.0, each_joint=True, apart=0.05, unit="N·m·s/rad"),
    "friction_loss": Kind(spread=0.5, low=0.0, high=20.0, each_joint=True, unit="N·m"),
    "stiffness_factor": Kind(spread=0.1, low=0.3, high=2.0, each_joint=True, apart=0.02),
    "damping_factor": Kind(spread=0.1, low=0.3, high=2.0, each_joint=True, apart=0.02),
    "target_offset": Kind(spread=0.05, low=-0.5, high=0.5, each_joint=True, unit="rad"),
}
"""Constants of the robot; each log adds a ``delay`` and, unreported, the velocities of its first row."""
_DELAY = Kind(spread=0.01, low=0.0, high=0.05, unit="s")
_START = Kind(spread=0.5, low=-20.0, high=20.0, unit="rad/s")


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """One number of the fit."""

    key: str
    """A key of ``KINDS``, ``delay`` or ``start``."""
    label: str
    joints: tuple[int, ...]
    """Joints that it acts on."""
    log: int | None
    """The log that it belongs to; None for all."""
    prior: float
    kind: Kind


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Identified constants."""

    parameters: JointParameters
    """The set; its ``delay`` is the mean over the logs."""
    delays: tuple[float, ...]
    """Of each log [s]."""
    unknowns: tuple[Unknown, ...]
    values: Array
    """Of the unknowns, (U,)."""
    intervals: Array
    """98 % intervals, (U, 2): of sixty at 95 %, three would not hold their constant."""
    known: NDArray[np.bool_]
    """False where the logs do not tell an unknown, which then is at its prior, (U,)."""
    evaluations: int
    """Simulations of a whole log."""


class _Problem:
    """Logs, unknowns, and the residuals of a guess."""

    def __init__(self, logs: Sequence[Log], base: JointParameters, threads: int) -> None:
        self.logs, self.base = logs, base
        self.robot = logs[0].robot
        self.rig = FixedRig(self.robot, base, threads=threads)
        self.trees = self.rig.trees
        joints = self.robot.num_joints
        self.unknowns = _unknowns(logs, base)
        self.rows = [_chosen(log) for log in logs]
        self.steps = [num_steps(log) for log in logs]
        self.starts = [beginning(log) for log in logs]
        self.evaluations = 0
        self.groups = np.zeros(joints, dtype=np.int64)
        for number, members in enumerate(joint_groups(self.robot).values()):
            self.groups[members] = number
        self._layout()
        self.scale = np.ones(len(self.block))
        nominal = self.series(self.priors()[None], nominal=True)[0]
        self.scale = self._nominal_scale(nominal)

    def _layout(self) -> None:
        """Number the residuals: block of time, joint, log and quantity of each."""
        block: list[NDArray[np.int64]] = []
        joint: list[NDArray[np.int64]] = []
        part: list[NDArray[np.int64]] = []
        first = 0
        for index, (log, rows) in enumerate(zip(self.logs, self.rows, strict=True)):
            time = log.time[rows]
            number = first + (time / BLOCK).astype(np.int64)
            first = int(number.max()) + 1
            for quantity in range(2 if log.torque is not None else 1):
                block.append(np.repeat(number, self.robot.num_joints))
                joint.append(np.tile(np.arange(self.robot.num_joints), len(rows)))
                part.append(np.full(block[-1].shape, 2 * index + quantity))
        self.block, self.joint, self.part = (np.concatenate(x) for x in (block, joint, part))

    def _nominal_scale(self, residual: Array) -> Array:
        """Return each residual's unit: the nominal set's RMS in this log, quantity and group of joints."""
        keys = self.part * (self.groups.max() + 1) + self.groups[self.joint]
        total = np.bincount(keys, weights=residual**2)
        count = np.bincount(keys).clip(1)
        unit = np.sqrt(total / count)[keys]
        weight = np.where(self.part % 2 == 1, np.sqrt(_TORQUE_WEIGHT), 1.0)
        found: Array = np.maximum(unit, 1e-9) / weight
        return found

    def priors(self) -> Array:
        return np.array([u.prior for u in self.unknowns])

    def bounds(self) -> tuple[Array, Array]:
        return np.array([u.kind.low for u in self.unknowns]), np.array([u.kind.high for u in self.unknowns])

    def spreads(self) -> Array:
        return np.array([u.kind.spread for u in self.unknowns])

    def precision(self, free: NDArray[np.int64]) -> Array:
        """Return the inverse covariance of some unknowns' priors, (F, F); joints that are alike are correlated."""
        covariance = np.diag(self.spreads() ** 2)
        of = [(u.key, self.groups[u.joints[0]]) for u in self.unknowns]
        for i, one in enumerate(self.unknowns):
            if one.kind.apart is not None:
                covariance[i, [k for k, other in enumerate(of) if other == of[i]]] = one.kind.spread**2
                covariance[i, i] += one.kind.apart**2
        return np.asarray(np.linalg.inv(covariance[np.ix_(free, free)]), dtype=np.float64)

    def constants(self, x: Array, number: int | None = None) -> dict[str, Array]:
        """Return the constants of a guess by key, (J,) each; ``start`` and ``delay`` those of a log."""
        found = {
            key: np.asarray(_value(self.base, key, self.robot.num_joints), dtype=np.float64).copy() for key in KINDS
        }
        found |= {"delay": np.zeros(self.robot.num_joints), "start": np.zeros(self.robot.num_joints)}
        for unknown, value in zip(self.unknowns, x, strict=True):
            if unknown.log is None or unknown.log == number:
                found[unknown.key][list(unknown.joints)] = value
        return found

    def parameters(self, x: Array) -> JointParameters:
        """Return a guess as a set."""
        found = self.constants(x)
        delays = [v for u, v in zip(self.unknowns, x, strict=True) if u.key == "delay"]
        values: dict[str, Any] = {key: tuple(float(v) for v in found[key]) for key in KINDS}
        return replace(self.base, **values, delay=float(np.mean(delays)))

    def simulate(self, guesses: Array, number: int, *, nominal: bool = False) -> Array:
        """Return position, velocity and torque of some guesses in a log at its rows, (3, G, T, J)."""
        log, sets, targets, starts = self.logs[number], [], [], []
        held: dict[float, Array] = {}
        position, velocity = self.starts[number]
        own = [
            i for i, u in enumerate(self.unknowns) if u.log in (None, number)
        ]  # guesses may differ in other logs alone
        _, first, same = np.unique(guesses[:, own], axis=0, return_index=True, return_inverse=True)
        for x in guesses[first]:
            found = self.constants(x, number)
            values: dict[str, Any] = {key: tuple(found[key].tolist()) for key in KINDS}
            sets.append(acting_parameters(log, self.base if nominal else replace(self.base, **values)))
            delay = 0.0 if nominal else float(found["delay"][0])
            if delay not in held:
                held[delay] = held_targets(log, delay, self.steps[number])
            offset = (
                np.asarray(_value(self.base, "target_offset", len(position))) if nominal else found["target_offset"]
            )
            targets.append(held[delay] + offset)
            starts.append((position, velocity + found["start"]))
        self.evaluations += len(first)
        return self.rig.run(sets, np.stack(targets), starts)[:, same.ravel()]

    def series(self, guesses: Array, *, nominal: bool = False) -> Array:
        """Return the residuals of some guesses in their units, without those of the prior, (G, R)."""
        parts = []
        for number, (log, rows) in enumerate(zip(self.logs, self.rows, strict=True)):
            series = self.simulate(guesses, number, nominal=nominal)
            short = replace(log, time=log.time[rows])
            for recorded, simulated in ((log.position, series[0]), (log.torque, series[2])):
                if recorded is not None:
                    parts.append((at_rows(short, simulated) - recorded[rows]).reshape(len(guesses), -1))
        return np.concatenate(parts, axis=1) / self.scale

    def jacobian(self, x: Array, free: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return residuals (R,) and their derivatives by the free unknowns, (R, F)."""
        _, high = self.bounds()
        step = self.spreads() * _STEP
        step = np.where(x + step > high, -step, step)
        shared = self._together(free)
        guesses = np.tile(x, (1 + len(shared), 1))
        for row, members in enumerate(shared, 1):
            guesses[row, members] += step[members]
        residual = self.series(guesses)
        change = residual[1:] - residual[0]
        column = {int(u): i for i, u in enumerate(free)}
        found = np.zeros((residual.shape[1], len(free)))
        for row, members in enumerate(shared):
            for member in members:
                own = change[row] / step[member]
                if len(members) > 1:
                    tree = self.trees[list(self.unknowns[member].joints)]
                    own = np.where(np.isin(self.trees[self.joint], tree), own, 0.0)
                found[:, column[int(member)]] = own
        return residual[0], found

    def _together(self, free: NDArray[np.int64]) -> list[list[int]]:
        """Return unknowns that one simulation can perturb: of one kind and log, on joints of different trees."""
        found: list[tuple[Any, set[int], list[int]]] = []
        for number in map(int, free):
            unknown = self.unknowns[number]
            trees = {int(t) for t in self.trees[list(unknown.joints)]}
            place = next((f for f in found if f[0] == (unknown.key, unknown.log) and not f[1] & trees), None)
            if place is None:
                found.append(((unknown.key, unknown.log), set(trees), [number]))
            else:
                place[1].update(trees)
                place[2].append(number)
        return [members for _, _, members in found]


def _value(base: JointParameters, key: str, joints: int) -> Sequence[float]:
    value = getattr(base, key)
    return value if value is not None else (0.0 if key == "target_offset" else 1.0,) * joints


def _unknowns(logs: Sequence[Log], base: JointParameters) -> list[Unknown]:
    robot = logs[0].robot
    names = [name.removesuffix("_joint") for name in robot.joint_names]
    found = []
    for key, kind in KINDS.items():
        start = _value(base, key, robot.num_joints)
        parts = {names[j]: [j] for j in range(len(names))} if kind.each_joint else joint_groups(robot)
        for part, joints in parts.items():
            prior = float(np.mean([start[j] for j in joints]))
            found.append(
                Unknown(key=key, label=f"{key} {part}", joints=tuple(joints), log=None, prior=prior, kind=kind)
            )
    every = tuple(range(robot.num_joints))
    for number, log in enumerate(logs):
        label, prior = f"delay of {log.name}", base.delay or 0.005
        found.append(Unknown(key="delay", label=label, joints=every, log=number, prior=prior, kind=_DELAY))
        for j in every:
            label = f"start of {names[j]} in {log.name}"
            found.append(Unknown(key="start", label=label, joints=(j,), log=number, prior=0.0, kind=_START))
    return found


def _chosen(log: Log) -> NDArray[np.int64]:
    rows = np.flatnonzero(log.fresh & (log.time >= SETTLING))
    every = max(round(1.0 / (_ROWS_PER_SECOND * log.period)), 1)
    return rows[::every]


def identify(
    logs: Sequence[Log],
    base: JointParameters,
    *,
    draws: int = 200,
    seed: int = 0,
    threads: int = 2,
    say: Say = lambda _: None,
) -> Fit:
    """Identify a robot's constants from logs of it hung by its trunk.

    Positions, and torques where a log has them, are compared at 100 rows a second. Each group of joints in each log counts
    alike: differences are in units of the nominal set's RMS. Priors, whose spreads are in ``KINDS``, decide what the logs do
    not. Unknowns that the logs do not tell are put back to their priors, and the rest is fitted again.

    Args:
        base: set to start from; its values are the priors' means.
        draws: of the bootstrap over blocks of half a second and over the priors, each followed by one Newton step.

    Raises:
        LogError: no logs, or one of a standing robot.
    """
    if not logs:
        raise LogError("no log was given; name one or more files")
    if standing := next((log.name for log in logs if log.held == "standing"), None):
        raise LogError(f"log '{standing}' is of a standing robot; constants are identified on a robot that hangs")
    problem = _Problem(logs, base, threads)
    try:
        return _identify(problem, draws, seed, say)
    finally:
        problem.rig.close()


def _identify(problem: _Problem, draws: int, seed: int, say: Say) -> Fit:
    x, spreads, priors = problem.priors(), problem.spreads(), problem.priors()
    known = np.ones(len(x), dtype=bool)
    trust = 1.0  # weight of a residual against the prior, corrected below by what the fit leaves
    for turn in range(_TURNS):
        free, weight = np.flatnonzero(known), trust
        x[~known] = priors[~known]
        x = _descend(problem, x, free, weight, say)
        residual, jacobian = problem.jacobian(x, free)
        trust = 1.0 / max(_inflated(problem, residual), 1e-12)
        if abs(trust / weight - 1.0) > _SETTLED and turn < _TURNS - 2:
            continue  # priors bent the fit by more than what it leaves allows
        hessian = trust * jacobian.T @ jacobian + problem.precision(free)
        after = np.sqrt(np.diag(np.linalg.inv(hessian))) / spreads[free]
        told = np.array([a < _KNOWN or problem.unknowns[u].key == "start" for a, u in zip(after, free, strict=True)])
        if told.all() or turn == _TURNS - 1:
            break
        known[free[~told]] = False
    drawn, telling = _bootstrap(problem, x, free, residual, jacobian, trust, draws, seed)
    from scipy import stats

    spread, tail = drawn.std(axis=0), (1.0 + _LEVEL) / 2.0
    reach, widest = stats.t.ppf(tail, np.maximum(telling - 1.0, 1.0)), float(stats.norm.ppf(tail)) * spreads
    intervals = np.stack([priors - widest, priors + widest], axis=1)
    intervals[free] = np.stack([x[free] - reach * spread, x[free] + reach * spread], axis=1)
    intervals = intervals.clip(*(bound[:, None] for bound in problem.bounds()))
    delays = tuple(float(v) for u, v in zip(problem.unknowns, x, strict=True) if u.key == "delay")
    return Fit(
        parameters=problem.parameters(x),
        delays=delays,
        unknowns=tuple(problem.unknowns),
        values=x,
        intervals=intervals,
        known=known,
        evaluations=problem.evaluations,
    )


def _descend(problem: _Problem, x: Array, free: NDArray[np.int64], trust: float, say: Say) -> Array:
    """Return the best guess, by SciPy's bounded trust-region least squares."""
    from scipy.optimize import least_squares

    low, high = (b[free] for b in problem.bounds())
    spreads, priors = problem.spreads()[free], problem.priors()[free]
    whiten = np.linalg.cholesky(problem.precision(free)).T
    memory: dict[bytes, tuple[Array, Array]] = {}
    turns = 0

    def whole(part: Array) -> Array:
        guess = x.copy()
        guess[free] = part
        return guess

    def residuals(part: Array) -> Array:
        found = problem.series(whole(part)[None])[0]
        return np.concatenate([np.sqrt(trust) * found, whiten @ (part - priors)])

    def derivatives(part: Array) -> Array:
        nonlocal turns
        turns += 1
        say(f"iteration {turns}")
        if part.tobytes() not in memory:
            memory.clear()
            memory[part.tobytes()] = problem.jacobian(whole(part), free)
        found = memory[part.tobytes()][1]
        return np.concatenate([np.sqrt(trust) * found, whiten])

    inside = np.clip(x[free], low + 1e-9, high - 1e-9)
    solved = least_squares(
        residuals, inside, derivatives, bounds=(low, high), x_scale=spreads, max_nfev=_ITERATIONS, ftol=1e-4, xtol=1e-4
    )
    return whole(solved.x)


def _inflated(problem: _Problem, residual: Array) -> float:
    """Return the mean square of the residuals times the number of neighbours that say the same (their correlation time)."""
    total, weight = 0.0, 0.0
    joints = problem.robot.num_joints
    for part in np.unique(problem.part):
        own = residual[problem.part == part].reshape(-1, joints)
        for j in range(joints):
            series = own[:, j] - own[:, j].mean()
            power = np.abs(np.fft.rfft(series, 2 * len(series))) ** 2
            correlation = np.fft.irfft(power)[: len(series)]
            correlation /= max(correlation[0], 1e-12)
            negative = np.flatnonzero(correlation < 0.05)
            last = int(negative[0]) if len(negative) else len(series)
            total += float((own[:, j] ** 2).mean()) * (1.0 + 2.0 * float(correlation[1:last].sum()))
            weight += 1.0
    return total / weight


def _bootstrap(
    problem: _Problem,
    x: Array,
    free: NDArray[np.int64],
    residual: Array,
    jacobian: Array,
    trust: float,
    draws: int,
    seed: int,
) -> tuple[Array, Array]:
    """Return the free unknowns of each draw of blocks and priors, (draws, F), and how many equal blocks tell each as well, (F,)."""
    blocks = int(problem.block.max()) + 1
    order = np.argsort(problem.block, kind="stable")
    edges = np.searchsorted(problem.block[order], np.arange(blocks + 1))
    hessians = np.empty((blocks, len(free), len(free)))
    gradients = np.empty((blocks, len(free)))
    for b in range(blocks):
        rows = order[edges[b] : edges[b + 1]]
        hessians[b] = trust * jacobian[rows].T @ jacobian[rows]
        gradients[b] = trust * jacobian[rows].T @ residual[rows]
    precision = problem.precision(free)
    prior_gradient = precision @ (x[free] - problem.priors()[free])
    centre = gradients.sum(axis=0) + prior_gradient  # zero at an optimum inside the bounds
    random = np.random.default_rng(seed)
    counts = random.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=draws)
    guesses = random.normal(size=(draws, len(free))) @ np.linalg.cholesky(precision).T  # where the prior decides
    found = np.empty((draws, len(free)))
    for d, count in enumerate(counts):
        hessian = np.tensordot(count, hessians, axes=1) + precision
        found[d] = x[free] - np.linalg.solve(hessian, count @ gradients + prior_gradient - centre + guesses[d])
    inverse = np.linalg.inv(hessians.sum(axis=0) + precision)
    told = np.einsum("ij,bjk,ki->bi", inverse, hessians, inverse, optimize=True)
    return found, told.sum(axis=0) ** 2 / (told**2).sum(axis=0).clip(1e-300)
