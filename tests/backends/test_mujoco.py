"""The CPU engine's own promises: what happens in a world does not depend on which worlds are stepped along with it."""

from dataclasses import fields, replace

import mujoco
import pytest
import torch
from gaitgauge.backends.base import BackendError, PhysicsOptions, PhysicsState, Randomization, ResetState, Scene
from gaitgauge.backends.mujoco import MujocoBackend
from gaitgauge.backends.mujoco.model import build_models
from gaitgauge.robots import load_robot
from gaitgauge.terrains import make_terrain

WORLDS = 5
NAMES = [f.name for f in fields(PhysicsState)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    robot = load_robot("go2")
    return Scene(
        robot=robot,
        parameters=next(iter(robot.parameters.values())),
        terrains=(make_terrain("flat", 0),),
        terrain_index=(0,) * WORLDS,
        physics=PhysicsOptions(watch_tilt=1e-3, watch_penetration=1e-4),
    )


def start(scene: Scene, held: torch.Tensor | None, worlds: torch.Tensor | None, backend: MujocoBackend) -> None:
    lift = torch.linspace(0.0, 0.1, WORLDS, dtype=torch.float64)
    position = torch.stack((lift * 0.0, lift * 0.0, scene.robot.stand_height + lift), dim=1)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(WORLDS, 1)
    backend.reset(ResetState(base_position=position, base_quaternion=upright, held_target=held), worlds)


@pytest.mark.parametrize("substeps", [None, 1, 4])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_world_moves_alike_in_any_company(scene: Scene, substeps: int | None, threads: int):
    """Limp and held motors side by side, all worlds at once against one world at a time, to the last bit."""
    pose = torch.tensor(scene.robot.default_joint_position, dtype=torch.float64).repeat(WORLDS, 1)
    limp = torch.tensor([True, False, True, False, False])
    generator = torch.Generator().manual_seed(2)
    together = MujocoBackend(scene, threads=threads)
    apart = [MujocoBackend(scene) for _ in range(WORLDS)]
    alone = torch.eye(WORLDS, dtype=torch.bool)
    for backend in (together, *apart):
        start(scene, pose, ~limp, backend)
        start(scene, None, limp, backend)
    last = 10 if substeps is None else substeps
    tilted = False
    for step in range(12):
        targets = pose + 0.3 * torch.randn(WORLDS, 12, generator=generator, dtype=torch.float64)
        delay = torch.randint(0, last + 1, (WORLDS,), generator=generator)
        sample_at = torch.randint(0, last + 1, (WORLDS,), generator=generator)
        some = torch.rand(WORLDS, generator=generator) < 0.7
        if step == 6:
            for backend in (together, *apart):
                start(scene, None, limp, backend)
        given = None if step in (1, 7) else targets.to(torch.float32 if step % 2 else torch.float64)
        options = {"delay": delay, "sample_at": sample_at, "substeps": substeps}
        together.step(given, worlds=None if step % 3 == 0 else some, **options)
        for world, backend in enumerate(apart):
            if step % 3 == 0 or some[world]:
                backend.step(given, worlds=alone[world], **options)
            for name in NAMES:
                here, there = getattr(together.state, name)[world], getattr(backend.state, name)[world]
                assert torch.equal(here, there), f"state.{name} of world {world} after step {step}"
                if sample_at[world] and (step % 3 == 0 or some[world]):
                    here, there = getattr(together.sample, name)[world], getattr(backend.sample, name)[world]
                    assert torch.equal(here, there), f"sample.{name} of world {world} after step {step}"
        tilted |= bool(together.state.tilt_substep.any())
    assert tilted


def test_limits_by_speed_act_in_a_whole_step_as_in_its_substeps(scene: Scene):
    """A step is played in one call, and again where a motor was beyond its limit; ten steps of one substep leave no choice."""
    physics = PhysicsOptions(torque_limits=True, torque_speed_limit=True, watch_tilt=1e-3)
    whole, parts = (MujocoBackend(replace(scene, physics=physics)) for _ in range(2))
    pose = torch.tensor(scene.robot.default_joint_position, dtype=torch.float64).repeat(WORLDS, 1)
    for backend in (whole, parts):
        start(scene, pose, None, backend)
    generator = torch.Generator().manual_seed(3)
    beyond = torch.zeros(WORLDS, dtype=torch.int64)
    for step in range(8):
        scale = torch.tensor([0.0, 0.05, 1.0, 3.0 if step % 3 else 0.0, 3.0], dtype=torch.float64)
        targets = pose + scale[:, None] * torch.randn(WORLDS, 12, generator=generator, dtype=torch.float64)
        whole.step(targets)
        for _ in range(10):
            parts.step(targets, substeps=1)
        for name in ("base_position_w", "joint_position", "joint_velocity", "joint_torque", "foot_contact_force_w"):
            assert torch.equal(getattr(whole.state, name), getattr(parts.state, name)), f"{name} after step {step}"
        beyond += torch.from_numpy(whole._beyond)
    assert beyond[0] == 0 and 0 < beyond[3] < 8 and beyond[4] > 0


@pytest.mark.parametrize("cause", ["tilt", "penetration", "target"])
def test_a_step_is_eventful_exactly_where_a_flag_is_set(scene: Scene, cause: str):
    physics = PhysicsOptions(watch_tilt=0.5, watch_penetration=0.01)
    backend = MujocoBackend(replace(scene, terrains=(make_terrain("wave", 1),), physics=physics))
    pose = torch.tensor(scene.robot.default_joint_position, dtype=torch.float64).repeat(WORLDS, 1)
    high = torch.tensor([5.0, 0.0, 1.0], dtype=torch.float64).repeat(WORLDS, 1)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(WORLDS, 1)
    backend.reset(ResetState(base_position=high, base_quaternion=upright, held_target=pose))
    backend.step(pose)
    assert not backend.eventful
    if cause == "tilt":
        upright[2] = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])
    elif cause == "penetration":
        high[2, 2] = 0.1
    else:
        pose[2, 3] = torch.nan
    backend.reset(ResetState(base_position=high, base_quaternion=upright))
    backend.step(pose)
    assert backend.eventful
    pose[2, 3] = 0.0
    others = torch.arange(WORLDS) != 2
    backend.step(pose, worlds=others)
    assert not backend.eventful, "the world with the event did not step"


def test_more_worlds_than_the_memory_holds_are_one_sentence(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    def refuse(*arguments: object) -> None:
        raise ValueError("Could not allocate memory")

    monkeypatch.setattr("mujoco.batch.Batch", refuse)
    with pytest.raises(BackendError, match="MuJoCo cannot make 5 worlds: Could not allocate memory; ask for fewer"):
        MujocoBackend(scene)


def test_targets_that_are_not_finite_leave_the_old_ones_in_force(scene: Scene):
    pose = torch.tensor(scene.robot.default_joint_position, dtype=torch.float64).repeat(WORLDS, 1)
    broken, whole = MujocoBackend(scene), MujocoBackend(scene)
    for backend in (broken, whole):
        start(scene, pose, None, backend)
    targets = pose + 0.2
    spoilt = targets.clone()
    spoilt[3, 5] = float("nan")
    kept = targets.clone()
    kept[3] = pose[3]
    broken.step(spoilt)
    whole.step(kept)
    assert broken.state.diverged.tolist() == [False, False, False, True, False]
    assert torch.isnan(spoilt[3, 5]) and torch.equal(broken.state.joint_position, whole.state.joint_position)


def test_only_worlds_whose_values_change_get_new_models(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    """Training hands over all motors in every step, of which a reset changes a few."""
    backend, made = MujocoBackend(scene), []
    apply = backend._apply_randomization
    monkeypatch.setattr(backend, "_apply_randomization", lambda row: (made.append(row), apply(row)))
    strength = torch.linspace(0.8, 1.2, WORLDS * 12, dtype=torch.float64).view(WORLDS, 12)
    mass = torch.linspace(-1.0, 1.0, WORLDS)
    for _ in range(2):
        backend.randomize(Randomization(motor_strength=strength, base_mass_offset=mass))
    assert sorted(made) == list(range(WORLDS))
    strength[3] = 0.5  # in the caller's own tensor
    backend.randomize(Randomization(motor_strength=strength))
    assert made[WORLDS:] == [3]
    assert backend._strength[3].tolist() == [0.5] * 12 and backend._strength[2].tolist() == strength[2].tolist()
    assert float(backend._models[3].body_mass.sum()) == pytest.approx(
        float(backend._palette[0].body_mass.sum() + mass[3]), abs=1e-6
    )


def test_a_randomization_that_is_refused_changes_nothing(scene: Scene):
    """Else the same values without the mistake would seem to be in the models already."""
    backend = MujocoBackend(scene)
    strength, mass = torch.full((WORLDS, 12), 0.5), torch.full((WORLDS,), 2.0)
    with pytest.raises(BackendError, match=f"motor_strength has 1 rows for {WORLDS} worlds"):
        backend.randomize(Randomization(motor_strength=strength[:1], base_mass_offset=mass))
    nominal = backend._palette[0].body_mass.sum()
    assert [model.body_mass.sum() for model in backend._models] == pytest.approx([nominal] * WORLDS)
    backend.randomize(Randomization(base_mass_offset=mass))
    assert [model.body_mass.sum() for model in backend._models] == pytest.approx([nominal + 2.0] * WORLDS)


def meeting(model: mujoco.MjModel) -> set[frozenset[str]]:
    """Pairs of geoms, of which at least one moves, whose masks let them meet."""
    return {
        frozenset((model.geom(a).name, model.geom(b).name))
        for a in range(model.ngeom)
        for b in range(a)
        if (model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a])
        and (model.body_weldid[model.geom_bodyid[[a, b]]] > 0).any()
    }


@pytest.mark.parametrize("name", ["go2", "go1", "anymal_c"])
def test_without_self_collision_parts_meet_the_ground_alone(name: str):
    """On flat ground and on a wave, whose models hold the other's boxes and field where they meet nothing."""
    robot = load_robot(name)
    terrains = make_terrain("flat"), make_terrain("stairs_fd", 3), make_terrain("wave", 3)

    def pairs(option):
        scene = Scene(
            robot=robot,
            parameters=robot.parameters[robot.default_parameters],
            terrains=terrains,
            terrain_index=(0,),
            physics=PhysicsOptions(self_collision=option),
        )
        return [(model, meeting(model)) for model in build_models(scene)]

    for (model, none), (_, every) in zip(pairs(False), pairs(True), strict=True):
        ground = {model.geom(g).name for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] == 0}
        assert none == {pair for pair in every if pair & ground} and none < every


@pytest.mark.parametrize(("name", "kind"), [("go2w", "mjJAC_AUTO"), ("g1", "mjJAC_SPARSE")])
def test_constraints_of_a_humanoid_alone_have_sparse_jacobians(name: str, kind: str):
    """Scores of four legs were published with dense ones, and differ in the last bits with others."""
    robot = load_robot(name)
    ground = {"terrains": (make_terrain("flat", 0),), "terrain_index": (0,)}
    scene = Scene(robot=robot, parameters=next(iter(robot.parameters.values())), **ground, physics=PhysicsOptions())
    assert build_models(scene)[0].opt.jacobian == getattr(mujoco.mjtJacobian, kind)
