"""Functions of a control step of K worlds (gauge protocol §3.3). They take tensors and return tensors.

Counters and flags in ``WorldBuffers`` change in place. No function reads a value on the host, so a CUDA graph can capture each.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from ...backends.base import PhysicsState
from ..goals import Schedule, target_command, target_offset
from ..suite import Suite
from .pushes import sideways
from .world_buffers import WorldBuffers


class StepCommand(NamedTuple):
    """The command of a control step."""

    commanded: torch.Tensor
    """Robots that are commanded, (K,) bool; the others settle, or their worlds are empty."""
    velocity: torch.Tensor
    """Forward, lateral [m/s] and yaw [rad/s], (K, 3)."""
    stands: torch.Tensor
    """Robots that settle in this control step for the last time, (K,) bool."""


class SamplePlan(NamedTuple):
    """The samples that fall into a control step."""

    due: torch.Tensor
    """Worlds that take a sample, (K,) bool."""
    at: torch.Tensor
    """Substep (1-based) of the sample, 0 for none, (K,) int64."""


class Events(NamedTuple):
    """Events of a control step, (K,) each."""

    fall: torch.Tensor
    """Robots that fell, bool."""
    restart: torch.Tensor
    """Worlds in which a penetration makes a target goal start again, bool."""
    substeps: torch.Tensor
    """Substeps until the event, all of them without an event, 0 in worlds that are not active, int64."""


def give_commands(
    buffers: WorldBuffers, state: PhysicsState, suite: Suite, schedule: Schedule, *, aimed: bool
) -> StepCommand:
    """Count a control step of the robots that do not settle, and return the commands; ``aimed``: any may aim at a target."""
    rules, speed = suite.settling, torch.linalg.vector_norm(state.base_linear_velocity_w, dim=1)
    still = (speed < rules.speed) & (state.time > rules.shortest)
    stands = buffers.settling & buffers.active & (still | (state.time > rules.longest))
    commanded = buffers.active & ~buffers.settling
    buffers.commanded_steps += commanded
    velocity = schedule.commands(buffers.first_row + buffers.commanded_steps, buffers.limits)
    if aimed:
        velocity = torch.where((buffers.aims & commanded)[:, None], buffers.target_command, velocity)
    return StepCommand(commanded, velocity, stands)


def accept_action(buffers: WorldBuffers, action: torch.Tensor, observation: torch.Tensor) -> None:
    """Keep the policy's action, (K, J), and count a control step of every active world.

    A world in which the action for a finite observation, (K, W), is not finite becomes inactive, and ``not_finite`` tells it.
    """
    buffers.action.copy_(torch.where(buffers.not_finite[:, None], buffers.action, action))
    refused = buffers.active & ~torch.isfinite(action).all(1) & torch.isfinite(observation).all(1)
    buffers.not_finite |= refused
    buffers.active &= ~refused
    buffers.control_steps += buffers.active


def plan_samples(buffers: WorldBuffers, interval: int, substeps: int) -> SamplePlan:
    """Return the samples of a control step of ``substeps``, with ``interval`` substeps between two samples."""
    ahead = interval - buffers.tick % interval
    due = buffers.active & buffers.sampled & (ahead <= substeps)
    return SamplePlan(due, ahead * due)


def find_push(buffers: WorldBuffers, state: PhysicsState, commanded: torch.Tensor) -> torch.Tensor:
    """Return the force on every base in world axes [N], (K, 3): that of a push while the push acts, else zero."""
    steps = buffers.commanded_steps
    pushed = commanded & (steps >= buffers.push_begin) & (steps < buffers.push_end)
    return sideways(state.base_quaternion_w, pushed * buffers.push_force)


def find_events(
    buffers: WorldBuffers, state: PhysicsState, plan: SamplePlan, rows: torch.Tensor, suite: Suite, substeps: int
) -> Events:
    """Find falls, and penetrations that make a target goal start again, in a control step of ``substeps``.

    The first penetration of a velocity goal's segment interrupts nothing. The buffers remember how far the segment was.
    ``rows``: samples that each world has taken before, (K,) int64.
    """
    watches = suite.events.penetration is not None
    active = buffers.active
    never = torch.full_like(state.tilt_substep, substeps + 1)
    fell_at = torch.where(state.tilt_substep > 0, state.tilt_substep, never)
    # at which substep the state became invalid is not known: nothing of this control step counts
    fell_at = torch.where(state.diverged, torch.zeros_like(fell_at), fell_at)
    buffers.diverged |= state.diverged & active
    buffers.overflowed |= state.overflowed & active
    deep_at = never
    if watches:
        watched = (state.penetration_substep > 0) & buffers.watched
        deep_at = torch.where(watched, state.penetration_substep, never)
    deep = active & (deep_at < fell_at)
    restart = deep & buffers.aims
    fall = active & (fell_at <= substeps) & ~restart
    if watches:
        for kept, now in (
            (buffers.penetration_control_steps, buffers.control_steps),
            (buffers.penetration_substeps, buffers.substeps + deep_at),
            (buffers.penetration_samples, rows + (plan.due & (plan.at <= deep_at))),
            (buffers.penetration_overflowed, buffers.overflowed),
        ):
            kept.copy_(torch.where(deep, now, kept))
        buffers.penetrated |= deep
        buffers.watched &= ~deep
    return Events(fall, restart, torch.minimum(torch.where(restart, deep_at, fell_at), never - 1) * active)


def advance(
    buffers: WorldBuffers, plan: SamplePlan, command: StepCommand, events: Events, suite: Suite
) -> tuple[torch.Tensor, torch.Tensor]:
    """Count the substeps up to each event; returns the worlds that took a sample, and those that took one that counts, (K,) bool."""
    buffers.tick += events.substeps
    buffers.substeps += events.substeps
    due = plan.due & (plan.at <= events.substeps)
    return due, due if suite.settling.sampled else due & command.commanded


def count_falls(buffers: WorldBuffers, command: StepCommand, events: Events, suite: Suite, substeps: int) -> None:
    """Count falls, and the samples that a fall costs: those of the rest of the sub-command, unless a fall closes the goal."""
    buffers.falls += events.fall
    if suite.events.fall == "close-goal":
        return
    interval = suite.metrics.interval
    # a fall while settling costs the whole sub-command that would have followed
    begun = (buffers.commanded_steps - 1) * command.commanded
    step_began = torch.where(command.commanded, buffers.tick - events.substeps, buffers.tick)
    ends = step_began + (buffers.length - begun) * substeps
    lost = ends // interval - buffers.tick // interval
    costs = events.fall & buffers.sampled & ~buffers.aims
    buffers.lost_samples.copy_(torch.where(costs, lost, buffers.lost_samples))


def end_segments(
    buffers: WorldBuffers, state: PhysicsState, command: StepCommand, events: Events, suite: Suite, *, aimed: bool
) -> None:
    """End settling and segments, and work out the next commands of robots that aim at a target.

    Where penetrations matter, a robot at the end of its way goes back to its spawn and settles once more before the segment ends.

    Args:
        aimed: whether any robot may aim at a target.
    """
    buffers.settling &= ~command.stands
    settled = buffers.active & ~buffers.settling
    full = settled & (buffers.commanded_steps >= buffers.length)
    if not aimed:
        buffers.ended |= full | events.fall
        return
    commands = suite.commands
    offset = target_offset(state, buffers.target, commands.target_distance)
    near = torch.hypot(offset[:, 0], offset[:, 1]) < commands.target_radius
    over = (near | full) & command.commanded & buffers.aims & ~(events.fall | events.restart)
    if commands.heading_frame != commands.target_distance:
        offset = target_offset(state, buffers.target, commands.heading_frame)
    buffers.target_command.copy_(target_command(offset, buffers.backward, buffers.speed, buffers.limits[:, 2]))
    over &= ~buffers.done
    buffers.reached |= over & near
    ended = (full & ~buffers.aims) | events.fall
    if suite.events.penetration is None:
        buffers.ended |= ended | over
        return
    # a penetration while the robot settles once more can still undo it
    buffers.done &= ~events.restart
    buffers.reached &= ~events.restart
    buffers.respawn |= over | events.restart
    buffers.ended |= ended | (buffers.done & settled & ~events.restart)
    buffers.done |= over
