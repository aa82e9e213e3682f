"""The tasks of two legs: level ground, and all terrains. Written for the Unitree G1; ``scaling`` makes them other robots'.

The policy drives the legs. Motors hold waist and arms; the training physics has them rigid, so that a G1 has 18 degrees of freedom
instead of 35, as many as a quadruped. Terms and weights start from those of four public trainings of the G1 (unitree_rl_gym, mjlab,
MuJoCo Playground, Holosoma): a gait clock with one phase for each foot, soles kept level and apart, hips and ankles near the standing
pose, an upright trunk.
"""

from __future__ import annotations

from dataclasses import replace

from ...backends.base import TRAINING_PHYSICS
from ...terrains.training_tiles import TileShape
from ..configuration import AlgorithmConfiguration, NetworkConfiguration, Ramp, RunConfiguration, TrainingConfiguration
from ..environment.configuration import (
    CommandConfiguration,
    CommandStage,
    EnvironmentConfiguration,
    GaitConfiguration,
    JointConfiguration,
    NoiseConfiguration,
    ObservationConfiguration,
    PushConfiguration,
    RandomizationConfiguration,
    ResetConfiguration,
    TerminationConfiguration,
)
from ..environment.reward_configuration import PoseWeights, RewardConfiguration
from ..environment.terrain_configuration import TerrainConfiguration, TileConfiguration

_REWARDS = RewardConfiguration(
    linear_tracking=2.0,
    yaw_tracking=1.0,
    # From a standstill the kernel of a fast command is flat.
    progress=0.5,
    alive=1.0,
    termination=-2.0,
    vertical_velocity=Ramp(start=-1.0, end=-0.5, begin=0.0, until=0.2),
    roll_pitch_rate=-0.1,
    orientation=-5.0,
    base_height=Ramp(start=-10.0, end=-20.0, begin=0.0, until=0.2),
    base_height_target=0.75,
    trunk_area=(0.2, 0.2),
    pose=-0.5,
    pose_weights=PoseWeights(hip_roll=2.0, hip_pitch=0.05, hip_yaw=4.0, knee=0.05, ankle=1.0, waist=4.0, arm=4.0),
    clock_height=2.0,
    clock_sigma=0.004,
    clock_contact=0.5,
    foot_tilt=-1.0,
    foot_slip=-0.2,
    feet_apart=-5.0,
    least_apart=0.17,
    foot_regulation=0.0,
    hip_regulation=0.0,
    stand_still=-0.1,
    collision=0.0,
    joint_limits=-5.0,
    torque=-1e-5,
    joint_power=-1e-4,
    action_rate=-0.01,
    action_smoothness=-0.005,
    dynamic_sigma=False,
)
_WALK = EnvironmentConfiguration(
    robot="g1",
    num_envs=8192,
    episode_length=20.0,
    # A walking G1 has 4 contacts in the mean and seldom more than 8; one that lies on the ground has been reset before.
    physics=replace(TRAINING_PHYSICS, contacts_per_world=20),
    joints=JointConfiguration(driven=("hip", "knee", "ankle"), rigid=True),
    gait=GaitConfiguration(period=0.8, swing_share=0.45, swing_height=0.09),
    # half as much again as gaitgauge-biped-1 adds
    observations=ObservationConfiguration(
        noise=NoiseConfiguration(base_angular_velocity=0.3, joint_velocity=2.0), height_offset=0.75
    ),
    rewards=_REWARDS,
    commands=CommandConfiguration(
        stages=(
            CommandStage(begin=0.0, forward=(-0.4, 0.6), lateral=(-0.3, 0.3), yaw=(-0.5, 0.5)),
            CommandStage(begin=0.2, forward=(-0.6, 0.9), lateral=(-0.4, 0.4), yaw=(-0.8, 0.8)),
            CommandStage(begin=0.4, forward=(-0.8, 1.2), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
        ),
        dynamic=False,
        straight_probability=0.4,
    ),
    reset=ResetConfiguration(joint_scale=(0.8, 1.2), velocity=0.3, footprint=(0.3, 0.4)),
    randomization=RandomizationConfiguration(
        friction=(0.3, 1.25), base_mass=(-1.0, 4.5), base_com=(-0.04, 0.04), motor_strength=(0.9, 1.1)
    ),
    push=PushConfiguration(linear=0.5),
    termination=TerminationConfiguration(trunk_contact=1.0, tilt=0.9, low=0.45),
)
_BRISK, _CAREFUL = (1.0, 0.5, 1.0), (0.8, 0.3, 0.8)
_GROUND = TerrainConfiguration(
    tiles=(
        TileConfiguration(name="wave", share=0.08, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="slope_up", share=0.11, command_limits=_BRISK, sigma=0.25),
        TileConfiguration(name="slope_down", share=0.11, command_limits=_BRISK, sigma=0.25),
        TileConfiguration(name="rough_slope", share=0.06, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="stairs_up", share=0.22, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="stairs_down", share=0.18, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="bars", share=0.05, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="obstacles", share=0.05, command_limits=_CAREFUL, sigma=0.25),
        TileConfiguration(name="flat", share=0.14, command_limits=(1.2, 0.5, 1.0), sigma=0.25, ends=False),
    ),
    # Steps of 10 cm are those of level 6, slopes of 15 degrees too.
    shape=TileShape(
        slope_gradient=(0.06, 0.35),
        stair_riser=(0.03, 0.12),
        obstacle_height=(0.03, 0.1),
        wave_steepness=(0.08, 0.3),
        roughness=0.025,
    ),
    highest_start_level=3,
)
_ROUGH = replace(
    _WALK,
    num_envs=16384,
    episode_length=25.0,
    physics=replace(TRAINING_PHYSICS, contacts_per_world=32),
    gait=replace(_WALK.gait, swing_height=0.13),
    terrain=_GROUND,
    rewards=replace(
        _REWARDS,
        progress=1.0,
        orientation=-2.0,
        base_height=Ramp(start=-5.0, end=-10.0, begin=0.0, until=0.2),
        foot_tilt=-0.3,
        clock_sigma=0.008,
        collision=-0.25,
    ),
    commands=replace(
        _WALK.commands,
        stages=(
            CommandStage(begin=0.0, forward=(-0.4, 0.6), lateral=(-0.3, 0.3), yaw=(-0.5, 0.5)),
            CommandStage(begin=0.1, forward=(-0.6, 0.9), lateral=(-0.4, 0.4), yaw=(-0.8, 0.8)),
            CommandStage(begin=0.2, forward=(-0.8, 1.2), lateral=(-0.5, 0.5), yaw=(-1.0, 1.0)),
        ),
        dynamic=True,
        straight_probability=0.5,
        heading_gain=1.0,
        crossing_probability=0.5,
    ),
    termination=replace(_WALK.termination, low=0.4, stuck=8.0),
)
_LEARNING = AlgorithmConfiguration(
    symmetry="alternate",
    student_period=2,
    entropy_coefficient=Ramp(start=0.01, end=0.002, begin=0.4, until=0.7),
    desired_kl=Ramp(start=0.01, end=0.004, begin=0.5, until=0.9),
)


def walk(
    terrain: TerrainConfiguration, method: str, network: NetworkConfiguration
) -> tuple[EnvironmentConfiguration, TrainingConfiguration]:
    """Return the settings of a method on level ground, for a quarter of an hour on an H100."""
    run = RunConfiguration(experiment="g1_walk", iterations=1800, save_interval=100, gauge_interval=0)
    return replace(_WALK, terrain=terrain), _training(method, network, run)


def rough(method: str, network: NetworkConfiguration) -> tuple[EnvironmentConfiguration, TrainingConfiguration]:
    """Return the settings of a method on all terrains, for an hour on an H100."""
    run = RunConfiguration(experiment="g1_rough", iterations=3000, save_interval=200, gauge_interval=0)
    return _ROUGH, _training(method, network, run)


def _training(method: str, network: NetworkConfiguration, run: RunConfiguration) -> TrainingConfiguration:
    return TrainingConfiguration(
        algorithm=replace(_LEARNING, method=method), network=replace(network, initial_std=0.8), run=run
    )
