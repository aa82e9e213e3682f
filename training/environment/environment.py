"""Simulate the training environment: rsl_rl's ``VecEnv`` on any physics backend.

One step, in order: the action becomes joint targets with a drawn latency; the physics advances one control period; rewards, ends,
curriculum and commands are judged on the new state; worlds at the end of an episode are reset and others pushed; observations are made of
the state after that, so that the first observation of an episode is fresh. Nothing in a step waits for the device.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from ...backends.base import Randomization, ResetState, Scene
from ...backends.graphs import WARM_UP, RecordedFunction
from ...backends.registry import make_backend
from ...files.parsing import shown
from ...robots.registry import load_robot
from ...robots.welding import welded
from ...terrains.height_scan import heading
from ..configuration import ConfigurationError
from .configuration import EnvironmentConfiguration, Stretch
from .curriculum import assign_kinds, build_palette
from .domain_randomization import draw_bodies
from .events import EpisodeStart
from .memory import copied, fitting, restore
from .observations import Observations
from .own_terms import resolve_own
from .policy_interface import driven_robot, joint_parameters, joints_of, training_contract
from .scenarios import read_scenarios, with_scenarios
from .step import EnvironmentStep, StepResult
from .step_inputs import AFTER_RESET, AFTER_STEP, static_inputs
from .stretches import check_stretches, settings_in, stretch_at

_log = logging.getLogger(__name__)

STATE_VERSION = 1
_PROGRESS = ("step", "level", "diverged_total")
"""What of the memory a run keeps where its episodes begin anew."""
_SEED_STRIDE = 1_000_003
"""Distance of the seeds of a run's stretches: those of its processes are neighbours."""


class TrainingEnvironment(VecEnv):
    """Vectorized locomotion environment. Observation groups: ``policy``, ``history`` and ``privileged``.

    Attributes:
        contract: the interface of the policies trained here, one frame of observation.
        backend: the physics.
        common_step_counter: environment steps taken in the run.
        stretch: number of stretches of the schedule that have begun; ``configuration`` holds the settings of the present one.
        unfused: why the torch parts are not compiled though they should have been, a sentence; empty otherwise.
    """

    def __init__(
        self,
        configuration: EnvironmentConfiguration,
        *,
        backend: str = "mujoco-warp",
        device: str = "cuda:0",
        threads: int = 1,
        capture: bool = False,
        fuse: bool | None = None,
        progress: float | None = None,
    ) -> None:
        """Build the worlds and begin their first episodes.

        Args:
            capture: replay the torch parts of a step as CUDA graphs; needs a CUDA device.
            fuse: compile the torch parts with ``torch.compile``, which merges their several hundred small kernels into a few; numbers
                differ in the last digits. None: on a GPU, unless a function of one's own cannot be compiled, which ``unfused`` then says.
            progress: fraction of the run that a state which is loaded next has reached, None for the beginning: the environment is then
                built once, with the settings of that stretch.

        Raises:
            ConfigurationError: a setting that makes no sense, such as ``capture`` without a CUDA device, or ``fuse`` for a function that
                cannot be compiled.
            BackendError: the engine cannot do what is asked.
        """
        if capture and torch.device(device).type != "cuda":
            raise ConfigurationError(
                f"capture=True needs a CUDA device, but the environment is on '{device}'; use capture=False there"
            )
        if configuration.num_envs < 1:
            raise ConfigurationError(
                f"environment.num_envs is {configuration.num_envs}; an environment needs at least 1 world"
            )
        if configuration.joints.moving and not configuration.joints.rigid:
            raise ConfigurationError(
                f"environment.joints.moving is {','.join(configuration.joints.moving)}, but no joint is rigid; set "
                "environment.joints.rigid=true, or leave moving out"
            )
        schedule = configuration.schedule
        if not 0.0 <= schedule.begin <= 1.0:
            raise ConfigurationError(
                f"environment.schedule.begin is {schedule.begin:g}; it is a fraction of the run, 0 to 1"
            )
        described = load_robot(configuration.robot)
        self.contract = training_contract(described, joint_parameters(described, configuration), configuration)
        whole = driven_robot(described, configuration)
        check_stretches(configuration, whole, self.contract)
        self._model_folder = TemporaryDirectory(prefix="gaitgauge-robot-") if configuration.joints.rigid else None
        moving = joints_of(whole, configuration.joints.moving, "moving")
        self.robot = whole if self._model_folder is None else welded(whole, Path(self._model_folder.name), moving)
        self._parameters = joint_parameters(self.robot, configuration)
        self.num_envs = configuration.num_envs
        self.num_actions = self.contract.num_joints
        self.common_step_counter = 0
        self._given, self._engine = configuration, (backend, device, threads)
        self._captures, self._fuses = capture, fuse
        self._first_step = round(schedule.begin * schedule.horizon_steps)
        reached = self._first_step if progress is None else round(progress * schedule.horizon_steps)
        self._build(stretch_at(schedule, reached))

    def _build(self, stretch: int) -> None:
        """Build the worlds with the settings of a stretch and begin their first episodes."""
        configuration, (backend, device, threads) = settings_in(self._given, stretch), self._engine
        self.cfg = self.configuration = configuration
        self.stretch = stretch
        parameters = self._parameters
        self.palette = build_palette(configuration.terrain)
        scenarios = read_scenarios(configuration)
        if scenarios:
            self.palette = with_scenarios(self.palette, scenarios, configuration)
        kind = assign_kinds([tile.share for tile in self.palette.tiles], configuration.num_envs)
        level = self._start_levels(configuration)
        scene = Scene(
            robot=self.robot,
            parameters=parameters.commanded(parameters.stiffness, parameters.damping),
            terrains=self.palette.terrains,
            terrain_index=tuple(self.palette.index[kind, level, 0].tolist()),
            physics=configuration.physics,
        )
        self.backend = make_backend(backend, scene, device=device, threads=threads)
        self.device = self.backend.device
        self._generator = torch.Generator(device=self.device)
        self._generator.manual_seed(configuration.seed + _SEED_STRIDE * stretch)
        state = self.backend.state
        self._inputs = state if self.backend.state_stays else static_inputs(state)
        self.parts = EnvironmentStep(
            configuration,
            robot=self.robot,
            parameters=parameters,
            contract=self.contract,
            palette=self.palette,
            kind=kind.to(self.device),
            inputs=self._inputs,
            generator=self._generator,
            scenarios=scenarios,
        )
        self.max_episode_length = self.parts.max_episode_length
        self.kind = self.parts.kind
        self._events = resolve_own(configuration.events, "environment.events").values()
        self._bodies = draw_bodies(
            configuration.randomization, self.num_envs, len(self.robot.collision_bodies), self._generator
        )
        if self.parts.scenarios is not None:
            self.parts.scenarios.load(self._bodies, self._generator)
        self.backend.randomize(Randomization(**self._bodies))
        self.parts.memory.step.fill_(self._first_step)
        self._begin(level.to(self.device))
        self._after_physics: Callable[[], StepResult] = self.parts.after_physics
        self._observe: Callable[[], Observations] = self.parts.observe
        self.unfused = ""
        if self._fuses or (self._fuses is None and self.device.type == "cuda"):
            self._fuse(required=self._fuses is not None)
        if self._captures:
            self._capture()

    def _rebuild(self, stretch: int) -> None:
        """Free the worlds and build those of another stretch."""
        self.backend.close()
        # Two environments at once may not fit into the device's memory; recorded and compiled functions hold on to their tensors.
        del self.backend, self.parts, self.palette, self.kind, self._inputs, self._bodies, self._events
        del self._after_physics, self._observe, self._observations
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        self._build(stretch)

    @property
    def progress(self) -> torch.Tensor:
        """Return the fraction of the run that schedules are at, a scalar tensor."""
        return self.parts.progress()

    @staticmethod
    def _start_levels(configuration: EnvironmentConfiguration) -> torch.Tensor:
        """Draw the levels at the start at random, since a pattern over the worlds would give the student's only every second level."""
        terrain = configuration.terrain
        highest = min(terrain.highest_start_level, terrain.levels - 1) if terrain.curriculum else terrain.levels - 1
        random = torch.Generator().manual_seed(configuration.seed)
        return torch.randint(highest + 1, (configuration.num_envs,), generator=random)

    def _begin(self, level: torch.Tensor) -> None:
        """Begin an episode in every world, on the given levels, (N,)."""
        memory = self.parts.memory
        memory.level.copy_(level)
        memory.moves_level.zero_()  # what an earlier episode came to moves nothing
        if self.parts.pushes.steps > 0:
            memory.push_phase.random_(self.parts.pushes.steps, generator=self._generator)
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self.parts.uniform.draw()
        self._reset(self.parts.begin_episodes(everyone, ~everyone, self.progress, memory.commanded_heading))
        self._read(AFTER_STEP)
        self._observations = self.parts.observe().clone()

    @contextmanager
    def _trial(self) -> Iterator[None]:
        """Let both torch parts run inside the context; their changes are put back."""
        parts = self.parts
        tensors = parts.memory.by_name() | {f"motors.{name}": v for name, v in parts.motors.by_name().items()}
        if parts.scenarios is not None:
            tensors |= {f"scenarios.{name}": v for name, v in parts.scenarios.by_name().items()}
        before = copied(tensors)
        try:
            with torch.no_grad():
                yield
        finally:
            restore(before, tensors)

    def _fuse(self, *, required: bool) -> None:
        """Compile both torch parts; where that is impossible, refuse if it is ``required``, or say so in ``unfused``."""
        from torch._dynamo.exc import TorchDynamoException  # loading it takes more than a second

        after_physics = torch.compile(self._after_physics, fullgraph=True, dynamic=False)
        observe = torch.compile(self._observe, fullgraph=True, dynamic=False)
        try:
            with self._trial():
                after_physics()
                observe()
        except TorchDynamoException as error:
            reason = next(line.strip() for line in str(error).splitlines() if line.strip())
            sentence = f"the environment's torch parts cannot be compiled ({shown(reason)})"
            if required:
                raise ConfigurationError(f"{sentence}; use fuse=False, on the command line --no-fuse") from error
            cause = "a function of your own in the task may be the cause"
            self.unfused = f"{sentence} and run as they are, which is slower; {cause}"
            return
        self._after_physics, self._observe = after_physics, observe

    def _capture(self) -> None:
        """Record both torch parts."""
        with self._trial():
            self._after_physics = RecordedFunction(self._after_physics, self.device)
            self._observe = RecordedFunction(self._observe, self.device)
            for _ in range(WARM_UP + 1):
                self._after_physics()
                self._observe()

    # --- rsl_rl's interface -----------------------------------------------------------------------------------------

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Return control steps of every world's present episode, (N,) int64. Assigning copies into the same tensor."""
        return self.parts.memory.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.parts.memory.episode_length.copy_(value)

    def get_observations(self) -> TensorDict:
        """Return present observations, copies."""
        return self._pack(self._observations.clone())

    @torch.no_grad()
    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all worlds by one control period with raw network outputs, (N, J). Return observations; rewards (N,); dones (N,) int64;
        extras with ``time_outs`` (N,) float and, every ``log_interval`` steps, ``log``. All are new tensors that no later step touches.
        """
        parts = self.parts
        parts.action.copy_(actions)
        parts.uniform.draw()
        targets, delay = parts.targets(), parts.delay()
        if parts.scenarios is not None:
            parts.scenarios.apply(self.backend, self._bodies["friction"])
            targets, delay = parts.scenarios.late(targets, delay)
        self.backend.step(targets, delay=delay)
        self._read(AFTER_STEP)
        result = self._after_physics()
        self.common_step_counter += 1
        extras: dict[str, Any] = {"time_outs": result.time_out.float()}
        if self.common_step_counter % self.configuration.log_interval == 0:
            extras["log"] = self._log()
        self._reset(result.start)
        if result.push is not None:
            self.backend.push(**vars(result.push))
        for event in self._events:
            event(self, result.done)
        self._read(AFTER_RESET)
        self._observations = self._observe().clone()
        return self._pack(self._observations), result.reward.clone(), result.done.long(), extras

    def close(self) -> None:
        """Free the physics."""
        self.backend.close()
        if self._model_folder is not None:
            self._model_folder.cleanup()

    # --- parts of a step --------------------------------------------------------------------------------------------

    def _read(self, names: tuple[str, ...]) -> None:
        if self.backend.state_stays:
            return
        state = self.backend.state
        for name in names:
            getattr(self._inputs, name).copy_(getattr(state, name))

    def _reset(self, start: EpisodeStart) -> None:
        self.parts.motors.apply(self.backend)
        held = self.parts.default_pose.expand(self.num_envs, -1)
        index = self.parts.memory.terrain_index
        self.backend.reset(replace(start.state, held_target=held, terrain_index=index), start.worlds)

    def _pack(self, observations: Observations) -> TensorDict:
        return TensorDict(dict(vars(observations)), batch_size=[self.num_envs], device=self.device)

    def _log(self) -> dict[str, torch.Tensor]:
        """Return the figures since the last log, as tensors on the device."""
        log = self.parts.log.read(self.parts.memory, self.progress)
        if self.parts.scenarios is not None:
            log |= self.parts.scenarios.log()
        if self._given.schedule.stretches:
            log["Curriculum/stretch"] = torch.tensor(float(self.stretch))
        return log | {"Physics/overflow_worlds": self.backend.state.overflowed.sum().float()}

    # --- stretches --------------------------------------------------------------------------------------------------

    def set_horizon(self, steps: int) -> None:
        """Spread the schedules over another number of environment steps of the whole run, which begins at the same fraction of it."""
        self._given, self.configuration = (
            replace(each, schedule=replace(each.schedule, horizon_steps=steps))
            for each in (self._given, self.configuration)
        )
        self.cfg = self.configuration
        first = round(self._given.schedule.begin * steps)
        self.parts.memory.step.add_(first - self._first_step)
        self._first_step = first
        self.parts.rate.fill_(1.0 / steps)

    @property
    def stretch_ends(self) -> bool:
        """Return True where the next stretch of the schedule is due: ``next_stretch`` begins it."""
        return stretch_at(self._given.schedule, self._first_step + self.common_step_counter) > self.stretch

    def next_stretch(self) -> Stretch:
        """Build the worlds of the stretch that is due, with new bodies, begin their episodes on the levels reached, and return it."""
        self._enter(self.progress_dict())
        return self._given.schedule.stretches[self.stretch - 1]

    def _enter(self, state: dict[str, Any]) -> bool:
        """Build the stretch that a saved state has reached; returns True if it begins there, which its episodes then have done."""
        reached = {**state, **{k: v for k, v in state.get("memory", {}).items() if k in _PROGRESS}}
        stretch = stretch_at(self._given.schedule, int(reached["step"]))
        if stretch != self.stretch:
            self._rebuild(stretch)
        if begins := state.get("stretch", 0) != stretch:
            self._begin_from({**reached, "bodies": self._bodies})
        return begins

    # --- resuming ---------------------------------------------------------------------------------------------------

    def progress_dict(self) -> dict[str, Any]:
        """Return the progress of a run without its running episodes: step counter, levels, the bodies that were drawn, since the levels
        were found with them, and how many worlds have diverged.
        """
        return {
            "version": STATE_VERSION,
            "stretch": self.stretch,
            "step": self.parts.memory.step.clone(),
            "level": self.parts.memory.level.to(torch.int16),
            "diverged_total": self.parts.memory.diverged_total.clone(),
            "bodies": copied(self._bodies),
            "common_step_counter": self.common_step_counter,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return everything that continuing needs: memory, random state, randomization, observations, and poses and velocities of the
        physics.

        The physics itself is put back by a reset: what an engine carries from step to step beside positions, velocities and targets (a
        solver's warm start, contact caches) is lost. On an engine without such memory, continuing equals never having stopped.
        """
        state = self.backend.state
        return {
            "version": STATE_VERSION,
            "stretch": self.stretch,
            "memory": copied(self.parts.memory.by_name()),
            "motors": copied(self.parts.motors.by_name()),
            "scenarios": {} if self.parts.scenarios is None else copied(self.parts.scenarios.by_name()),
            "bodies": copied(self._bodies),
            "seen_before": copied(self.parts.seen_before()),
            "observations": copied(vars(self._observations)),
            "generator": self._generator.get_state(),
            "common_step_counter": self.common_step_counter,
            "physics": {name: getattr(state, name).clone() for name in AFTER_RESET},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, or begin new episodes from ``progress_dict``. The environment must have been built with the same
        configuration.

        Raises:
            ValueError: the state is of another version or of another environment.
        """
        if state.get("version") != STATE_VERSION:
            raise ValueError(
                f"the saved environment has version {state.get('version')}, this program reads {STATE_VERSION}"
            )
        if self._given.schedule.stretches and self._enter(state):
            return
        if "memory" not in state:
            self._begin_from(state)
            return
        parts, now = self.parts, self.backend.state
        # A run from before headings were remembered goes on with the robots' own, one from before motor speeds with 1, one from
        # before the steps of the rewards with the episodes' length.
        headings = heading(state["physics"]["base_quaternion_w"])
        older = {"commanded_heading": headings, "holds_heading": torch.zeros_like(parts.memory.holds_heading)}
        older["episode_steps"] = state["memory"]["episode_length"]
        # and one from before gait clocks and averages of the yaw rate has none
        older |= {
            name: getattr(parts.memory, name) for name in ("foot_air_time", "foot_contact_time", "clocks", "turn_error")
        }
        restore({**older, **state["memory"]}, parts.memory.by_name())
        self._require_below(parts.memory.level, self.palette.num_levels, "level")
        self._require_below(parts.memory.terrain_index, len(self.palette.terrains), "terrain_index")
        motors = parts.motors.by_name()
        restore({"motor_speed": torch.ones_like(motors["motor_speed"]), **state["motors"]}, motors)
        self._take_bodies(state["bodies"])
        parts.motors.apply(self.backend)
        if parts.scenarios is not None:
            restore(state["scenarios"], parts.scenarios.by_name())
        # a run from before these were kept goes on with what a new episode begins with
        restore(parts.seen_before() | state.get("seen_before", {}), parts.seen_before())
        self._observations = Observations(**fitting(state["observations"], vars(self._observations))).clone()
        self._generator.set_state(state["generator"].cpu())
        self.common_step_counter = int(state["common_step_counter"])
        physics = fitting(state["physics"], {name: getattr(now, name) for name in AFTER_RESET})
        parts.action.copy_(parts.memory.action)
        held = parts.targets() if parts.scenarios is None else parts.scenarios.acting(parts.targets())
        self.backend.reset(
            ResetState(
                base_position=physics["base_position_w"],
                base_quaternion=physics["base_quaternion_w"],
                joint_position=physics["joint_position"],
                base_linear_velocity=physics["base_linear_velocity_w"],
                base_angular_velocity=physics["base_angular_velocity_b"],
                joint_velocity=physics["joint_velocity"],
                held_target=held,
                terrain_index=parts.memory.terrain_index,
            )
        )
        self._read(AFTER_RESET)
        if parts.scenarios is not None:
            parts.scenarios.prepare(self._inputs, parts.memory.episode_length)

    def _begin_from(self, progress: dict[str, Any]) -> None:
        """Begin new episodes where ``progress_dict`` says that the run is."""
        if len(progress["level"]) != self.num_envs:
            raise ValueError(
                f"the saved environment does not fit: it has {len(progress['level'])} worlds, this environment "
                f"{self.num_envs}"
            )
        memory = self.parts.memory
        # a run from before those that diverged were carried on begins to count
        progress = {"diverged_total": memory.diverged_total, **progress}
        found = fitting(progress, {name: getattr(memory, name) for name in _PROGRESS})
        self._require_below(found["level"], self.palette.num_levels, "level")
        memory.step.copy_(found["step"])
        memory.diverged_total.copy_(found["diverged_total"])
        self.common_step_counter = int(progress["common_step_counter"])
        self._take_bodies(progress["bodies"])
        self._begin(found["level"])

    def _take_bodies(self, saved: dict[str, Any]) -> None:
        self._bodies = fitting(saved, self._bodies)
        self.backend.randomize(Randomization(**self._bodies))

    @staticmethod
    def _require_below(numbers: torch.Tensor, count: int, name: str) -> None:
        """Refuse saved numbers of things that are not there: engines read memory by them, unchecked."""
        if numbers.numel() and not 0 <= int(numbers.min()) <= int(numbers.max()) < count:
            raise ValueError(f"the saved environment does not fit: '{name}' is not between 0 and {count - 1}")
