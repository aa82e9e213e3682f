"""A hand-made trotting controller as a network: it has no weights, and everything it knows is in its arguments.

It is a baseline that a trained policy has to beat. Diagonal pairs of legs take turns. Swing feet are set down where half
a stance at the commanded speed, and a share of the speed error, puts them (Raibert, Legged Robots That Balance, 1986,
ch. 2); stance feet sweep back under the body. Joint targets come from the inverse kinematics of the leg, with the torque
that carries the body, divided by the motor's stiffness, on top. The speed is estimated from the stance legs' encoders,
the tilt rate from successive gravity directions, which is far less noisy than gyroscope and joint velocities.

Lengths in m, angles in rad, base frame: x forward, y left, z up. Leg order FL, FR, RL, RR; joints hip, thigh, calf.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

GRAVITY = 9.81
LEGS = 4
# What the session keeps for each episode, and where in its state.
_PHASE, _WALKING, _STARTED = 0, 1, 2
_COMMAND = slice(3, 6)
_VELOCITY = slice(6, 8)
_YAW_RATE = 8
_GRAVITY = slice(9, 12)
_RATE = slice(12, 14)
_JOINTS = slice(14, 26)
_FEET = slice(26, 38)
_TARGET = slice(38, 50)
_WIDTH = 50


class TrotController(nn.Module):
    """Trots, walks on the spot or stands, in the observation frame of ``standard_contract`` (45 entries)."""

    hips: torch.Tensor
    side: torch.Tensor
    feet: torch.Tensor
    default: torch.Tensor
    offset: torch.Tensor
    limits: torch.Tensor
    acceleration: torch.Tensor

    def __init__(
        self,
        *,
        default_joint_position: Sequence[float],
        action_scale: float,
        stiffness: float,
        damping: float,
        control_period: float,
        mass: float,
        hip_position: Sequence[Sequence[float]],
        thigh_offset: float,
        link_length: float,
        foot_x: Sequence[float],
        foot_y: float,
        height: float,
        period: float,
        duty: float,
        clearance: float,
        limits: Sequence[float],
        acceleration: Sequence[float],
        placement_gain: float,
        velocity_gain: float,
        attitude_gain: float,
        attitude_damping: float,
        yaw_gain: float,
        yaw_force: float,
        support: float,
        velocity_filter: float,
        yaw_filter: float,
        leading: float,
    ) -> None:
        """Prepare the constants.

        Args:
            default_joint_position: pose of zero actions [rad], (12,).
            action_scale: joint target per unit of action [rad].
            stiffness: of the motors [N·m/rad].
            damping: of the motors and joints together [N·m·s/rad].
            control_period: [s].
            mass: of the robot [kg].
            hip_position: hip joints in the base frame [m], (4, 3).
            thigh_offset: sideways from hip joint to leg plane [m].
            link_length: of thigh and of calf [m].
            foot_x: front and rear feet below a standing robot [m].
            foot_y: feet beside the middle line [m].
            height: of the base origin above the feet's centres [m].
            period: of the gait [s].
            duty: share of the period for which a foot stands.
            clearance: lift of a swinging foot [m].
            limits: largest forward, sideways [m/s] and turning [rad/s] speed that it tries.
            acceleration: at which it goes to a new command, in the same order [1/s of each].
            placement_gain: shift of a landing foot per speed error [s].
            velocity_gain: force of the standing feet per speed error, over the mass [1/s].
            attitude_gain: tilt that standing feet lean against, per tilt.
            attitude_damping: the same per tilt rate [s].
            yaw_gain: turning speed added per error of the turning speed.
            yaw_force: force of the standing feet per error of the turning speed and distance from the middle, over the
                mass [1/s].
            support: share of the weight that the feed-forward torque carries.
            velocity_filter: share of a new speed estimate.
            yaw_filter: share of a new turning-speed measurement.
            leading: time by which joint targets run ahead, against motor lag [s].
        """
        super().__init__()
        self.history_length = 1
        self.frame_width = 9 + 3 * 3 * LEGS
        self.action_scale, self.stiffness, self.damping = action_scale, stiffness, damping
        self.control_period, self.mass = control_period, mass
        self.thigh_offset, self.link_length = thigh_offset, link_length
        self.height, self.period, self.duty, self.clearance = height, period, duty, clearance
        self.placement_gain, self.velocity_gain = placement_gain, velocity_gain
        self.attitude_gain, self.attitude_damping = attitude_gain, attitude_damping
        self.yaw_gain, self.yaw_force = yaw_gain, yaw_force
        self.support, self.leading = support, leading
        self.velocity_filter, self.yaw_filter = velocity_filter, yaw_filter
        side = (1.0, -1.0, 1.0, -1.0)
        feet = [(foot_x[i // 2], side[i] * foot_y, -height) for i in range(LEGS)]
        for name, values in (
            ("hips", hip_position),
            ("side", side),
            ("feet", feet),
            ("default", default_joint_position),
            ("offset", (0.0, 0.5, 0.5, 0.0)),
            ("limits", limits),
            ("acceleration", acceleration),
        ):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32), persistent=False)

    def initial_state(self, n: int) -> torch.Tensor:
        """Return the state at the start of an episode, (n, S)."""
        return torch.zeros(n, _WIDTH, device=self.default.device)

    # ---- leg geometry -----------------------------------------------------------------------------------------------

    def foot_positions(self, joints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return feet in the base frame (N, 4, 3) and their Jacobians (N, 4, 3, 3), columns hip, thigh, calf.

        ``joints`` is (N, 4, 3) [rad], legs by hip, thigh, calf.
        """
        hip, thigh, calf = joints.unbind(-1)
        length, across = self.link_length, self.side * self.thigh_offset
        x = -length * (torch.sin(thigh) + torch.sin(thigh + calf))
        down = length * (torch.cos(thigh) + torch.cos(thigh + calf))
        sin, cos = torch.sin(hip), torch.cos(hip)
        y, z = across * cos + down * sin, across * sin - down * cos
        shin_x, shin_down = -length * torch.cos(thigh + calf), -length * torch.sin(thigh + calf)
        zero = torch.zeros_like(x)
        columns = (
            torch.stack((zero, -z, y), -1),
            torch.stack((-down, x * sin, -x * cos), -1),
            torch.stack((shin_x, shin_down * sin, -shin_down * cos), -1),
        )
        return torch.stack((x, y, z), -1) + self.hips, torch.stack(columns, -1)

    def joint_positions(self, feet: torch.Tensor) -> torch.Tensor:
        """Return joints (N, 4, 3) that put the feet (N, 4, 3) there; what is out of reach is approached."""
        x, y, z = (feet - self.hips).unbind(-1)
        across, length = self.side * self.thigh_offset, self.link_length
        down = torch.sqrt(torch.clamp(y**2 + z**2 - across**2, min=0.01))
        hip = torch.atan2(y, -z) - torch.atan2(across, down)
        reach = torch.clamp((x**2 + down**2) / (2.0 * length**2) - 1.0, -0.85, 0.6)
        calf = -torch.acos(reach)
        return torch.stack((hip, torch.atan2(-x, down) - 0.5 * calf, calf), -1)

    # ---- one step ---------------------------------------------------------------------------------------------------

    def forward(self, history: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (N, 12) and the next state for ``history`` (N, 1, 45) and ``state`` (N, S)."""
        frame = history[:, -1]
        dt = self.control_period
        gravity = frame[:, 3:6]
        wanted = torch.clamp(frame[:, 6:9] / frame.new_tensor((2.0, 2.0, 0.25)), -self.limits, self.limits)
        # what it can do in a diagonal direction lies on an ellipse
        beyond = torch.clamp((wanted / self.limits)[:, :2].norm(dim=1, keepdim=True), min=1.0)
        wanted = torch.cat((wanted[:, :2] / beyond, wanted[:, 2:]), -1)
        joints = frame[:, 9:21] + self.default
        fresh = state[:, _STARTED : _STARTED + 1] < 0.5
        before = torch.where(fresh, gravity, state[:, _GRAVITY])
        joints_before = torch.where(fresh, joints, state[:, _JOINTS])
        feet_before = torch.where(fresh, self.feet.flatten(), state[:, _FEET])
        feet_before = feet_before.unflatten(1, (LEGS, 3))

        # roll and pitch from gravity, their rates from its change
        roll, pitch = torch.atan2(-gravity[:, 1], -gravity[:, 2]), torch.asin(torch.clamp(gravity[:, 0], -1.0, 1.0))
        roll_before = torch.atan2(-before[:, 1], -before[:, 2])
        pitch_before = torch.asin(torch.clamp(before[:, 0], -1.0, 1.0))
        tilt = torch.stack((roll, pitch), -1)
        rate = (tilt - torch.stack((roll_before, pitch_before), -1)) / dt
        rate = state[:, _RATE] + 0.5 * (rate - state[:, _RATE])
        yaw_rate = state[:, _YAW_RATE] + self.yaw_filter * (frame[:, 2] / 0.25 - state[:, _YAW_RATE])

        step = self.acceleration * dt
        command = state[:, _COMMAND] + torch.clamp(wanted - state[:, _COMMAND], -step, step)

        # gait clock
        phase = state[:, _PHASE]
        foot_phase = torch.remainder(phase[:, None] + self.offset, 1.0)
        standing = state[:, _WALKING] < 0.5
        stance = (foot_phase < self.duty) | standing[:, None]

        # speed from the legs that stand
        feet_now, jacobian = self.foot_positions(joints.unflatten(1, (LEGS, 3)))
        feet_then, _ = self.foot_positions(joints_before.unflatten(1, (LEGS, 3)))
        omega = torch.cat((rate, yaw_rate[:, None]), -1)
        speed = -(feet_now - feet_then) / dt - torch.linalg.cross(omega[:, None].expand_as(feet_now), feet_now)
        firm = stance & ((foot_phase > 0.1) & (foot_phase < self.duty - 0.05) | standing[:, None])
        weight = firm.to(speed.dtype)[..., None]
        count = weight.sum(1)
        measured = (speed * weight).sum(1)[:, :2] / torch.clamp(count, min=1.0)
        share = self.velocity_filter * torch.clamp(count, max=2.0) / 2.0
        velocity = state[:, _VELOCITY] + share * (measured - state[:, _VELOCITY])
        error = velocity - command[:, :2]

        # start to walk, or stop at the end of a half step
        busy = (command.abs() > 0.03).any(1) | (velocity.norm(dim=1) > 0.25) | (tilt.norm(dim=1) > 0.25)
        next_phase = phase + dt / self.period
        boundary = torch.floor(2.0 * next_phase) > torch.floor(2.0 * phase)
        walking = torch.where(standing, busy, busy | ~boundary)
        next_phase = torch.where(standing | ~walking, torch.zeros_like(phase), torch.remainder(next_phase, 1.0))

        # where the feet go, in the level frame
        turn = command[:, 2] + self.yaw_gain * (command[:, 2] - yaw_rate)
        sweep = torch.stack(
            (
                command[:, :1] - turn[:, None] * feet_before[..., 1],
                command[:, 1:2] + turn[:, None] * feet_before[..., 0],
            ),
            -1,
        )
        half = 0.5 * self.duty * self.period
        landing_x = self.feet[:, 0] + half * (command[:, :1] - turn[:, None] * self.feet[:, 1])
        landing_y = self.feet[:, 1] + half * (command[:, 1:2] + turn[:, None] * self.feet[:, 0])
        landing = torch.stack((landing_x, landing_y), -1) + self.placement_gain * error[:, None]
        landing = self.feet[:, :2] + torch.clamp(landing - self.feet[:, :2], -0.2, 0.2)
        progress = torch.clamp((foot_phase - self.duty) / (1.0 - self.duty), 0.0, 1.0)
        advance = dt / self.period / (1.0 - self.duty)
        share = torch.clamp(advance / torch.clamp(0.9 - progress, min=advance), max=1.0)[..., None]
        at = feet_before[..., :2]
        swung = at + share * (landing - at)
        swept = at - dt * sweep
        rest = at + 0.1 * (self.feet[:, :2] - at)
        ground = torch.where(standing[:, None, None], rest, torch.where(stance[..., None], swept, swung))
        lift = torch.where(stance, torch.zeros_like(progress), self.clearance * torch.sin(torch.pi * progress) ** 2)
        feet = torch.cat((ground, (lift - self.height)[..., None]), -1)

        # into the base frame: swing feet stay level, standing feet lean against the tilt
        lean = -(self.attitude_gain * tilt + self.attitude_damping * rate)
        ahead = tilt + self.leading * rate
        angle = torch.where(stance[..., None], lean[:, None], ahead[:, None])
        target = self.joint_positions(_turned(feet, angle))

        # torque that carries the body and corrects its speed
        load = stance.to(feet.dtype)
        load = load / torch.clamp(load.sum(1, keepdim=True), min=1.0)
        force = -self.support * self.mass * GRAVITY * gravity[:, None] * load[..., None]
        push = -self.velocity_gain * torch.clamp(error, -0.5, 0.5)
        slow = torch.clamp(command[:, 2] - yaw_rate, -1.0, 1.0)[:, None]
        twist = self.yaw_force * torch.stack((-slow * feet_now[..., 1], slow * feet_now[..., 0]), -1)
        along = self.mass * (push[:, None] + twist) * load[..., None]
        force = force + torch.cat((along, torch.zeros_like(along[..., :1])), -1)
        torque = -(jacobian.transpose(-1, -2) @ force[..., None]).squeeze(-1)
        last = torch.where(fresh, target.flatten(1), state[:, _TARGET])
        motion = torch.clamp((target.flatten(1) - last) / dt, -15.0, 15.0)
        sent = target.flatten(1) + (torque.flatten(1) + self.damping * motion) / self.stiffness
        action = (sent - self.default) / self.action_scale

        following = torch.cat(
            (
                next_phase[:, None],
                walking.to(phase.dtype)[:, None],
                torch.ones_like(phase)[:, None],
                command,
                velocity,
                yaw_rate[:, None],
                gravity,
                rate,
                joints,
                feet.flatten(1),
                target.flatten(1),
            ),
            -1,
        )
        return action, following


def _turned(points: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return points (N, 4, 3) of a level frame seen in one that is rolled and pitched by ``angle`` (N, 4, 2)."""
    roll, pitch = angle.unbind(-1)
    x, y, z = points.unbind(-1)
    sin, cos = torch.sin(pitch), torch.cos(pitch)
    x, z = cos * x - sin * z, sin * x + cos * z
    sin, cos = torch.sin(roll), torch.cos(roll)
    y, z = cos * y + sin * z, -sin * y + cos * z
    return torch.stack((x, y, z), -1)
