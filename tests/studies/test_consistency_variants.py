"""Variants of engines, and the backends that stand before them."""

import pytest
import torch
from gaitgauge.backends import ResetState, Scene
from gaitgauge.backends.base import BackendError, PhysicsOptions
from gaitgauge.robots import load_robot
from gaitgauge.studies.consistency import variants
from gaitgauge.studies.consistency.request import ConsistencyError
from gaitgauge.studies.consistency.variants import Variant, parse_variant, place
from gaitgauge.studies.consistency.wrapping import PerturbedBackend, RetimedBackend
from gaitgauge.terrains.registry import make_terrain
from gaitgauge_fake_engine import FakeBackend, FakeScript

GO2 = load_robot("go2")


def scene(worlds=2, **physics):
    return Scene(
        robot=GO2,
        parameters=GO2.parameters["gauge"],
        terrains=(make_terrain("flat"),),
        terrain_index=(0,) * worlds,
        physics=PhysicsOptions(**physics),
    )


def standing(backend):
    n = backend.num_worlds
    position = torch.tensor([0.0, 0.0, 0.4], dtype=backend.dtype).repeat(n, 1)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=backend.dtype).repeat(n, 1)
    return {"base_position": position, "base_quaternion": upright}


def test_variants_are_read_and_named():
    variant = parse_variant("newton:steel@timestep=0.005@cone=pyramidal@self_collision=false@contacts_per_world=20")
    assert variant.backend == "newton:steel"
    changed = {"timestep": 0.005, "cone": "pyramidal", "self_collision": False, "contacts_per_world": 20}
    assert dict(variant.overrides) == changed
    assert parse_variant(variant.label) == variant
    third = parse_variant("mujoco@timestep=0.003333333333")
    assert parse_variant(third.label) == third
    assert parse_variant("mujoco@cone=pyramidal@timestep=0.001") == parse_variant(
        "mujoco@timestep=0.001@cone=pyramidal"
    )
    assert dict(parse_variant("mujoco@contacts_per_world=none").overrides) == {"contacts_per_world": None}
    assert parse_variant("mujoco@self_collision=true").physics(PhysicsOptions()) == PhysicsOptions()
    assert ":" not in variant.folder and "/" not in variant.folder
    physics = variant.physics(PhysicsOptions())
    assert (physics.timestep, physics.substeps, physics.cone) == (0.005, 4, "pyramidal")
    assert physics.control_period == pytest.approx(0.02)
    assert parse_variant("mujoco").physics(PhysicsOptions()) == PhysicsOptions()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("@timestep=0.005", "names no engine"),
        ("mujoco@speed=3", "timestep"),
        ("mujoco@timestep", "option=value"),
        ("mujoco@substeps=3", "no physics option"),
        ("mujoco@timestep=fast", "'@timestep' is 'fast'; it must be a number"),
        ("mujoco@timestep=nan", "it must be a finite number"),
        ("mujoco@timestep=-0.005", "it must be greater than or equal to 0.00001"),
        ("mujoco@iterations=1.5", "it must be a whole number"),
        ("mujoco@iterations=-1", "it must be greater than or equal to 1"),
        ("mujoco@cone=square", "it must be 'elliptic' or 'pyramidal'"),
        ("mujoco@self_collision=perhaps", "it must be true or false"),
        ("mujoco@torque_limits=perhaps", "it must be true or false"),
        ("mujoco@" + "x" * 10_000, "no physics option"),
    ],
)
def test_malformed_variants_are_refused(text, words):
    with pytest.raises(ConsistencyError, match=words):
        parse_variant(text)


@pytest.mark.parametrize("timestep", [0.003, 0.05])
def test_timestep_that_does_not_divide_the_control_period_is_refused(timestep):
    with pytest.raises(ConsistencyError, match="does not divide"):
        parse_variant(f"mujoco@timestep={timestep}").physics(PhysicsOptions())


def test_place_chooses_devices(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert place(Variant(backend="mujoco"), None).device == "cpu"
    assert place(Variant(backend="mujoco"), "cuda").device == "cpu"  # it has no use for a GPU, whatever the others get
    assert place(Variant(backend="fake"), "cpu").device == "cpu"
    with pytest.raises(BackendError, match="--device cpu"):
        place(Variant(backend="mujoco-warp"), None)
    with pytest.raises(BackendError, match="no GPU"):
        place(Variant(backend="fake"), "cuda")
    with pytest.raises(BackendError, match="unknown backend"):
        place(Variant(backend="nonsense"), None)


class Spy(FakeBackend):
    """Notes what it is asked."""

    def __init__(self, scene, **options):
        super().__init__(scene, **options)
        self.asked = []

    def step(self, joint_targets, **arguments):
        self.asked.append(arguments | {"joint_targets": joint_targets})
        super().step(joint_targets, **arguments)

    def reset(self, start, worlds=None):
        self.given = start
        super().reset(start, worlds)


def test_retimed_backend_rounds_to_the_engines_own_grid():
    outer = scene(10)
    backend = RetimedBackend(Spy(scene(10, timestep=0.005, substeps=4)), outer)
    assert backend.scene is outer
    backend.reset(ResetState(**standing(backend)))
    target = torch.zeros(10, 12, dtype=backend.dtype)
    backend.step(target, delay=torch.arange(10), sample_at=torch.arange(10) + torch.tensor([0] * 9 + [1]))
    asked = backend.inner.asked[0]
    # delays of 0, 2 … 18 ms on a grid of 5 ms: their mean of 9 ms stays
    assert asked["delay"].tolist() == [0, 0, 1, 1, 2, 2, 2, 3, 3, 4]
    assert asked["sample_at"].tolist() == [0, 1, 1, 1, 2, 2, 2, 3, 3, 4]
    assert asked["substeps"] == 4
    assert backend.state.time[0] == pytest.approx(0.02)
    backend.step(None, substeps=1)
    assert backend.inner.asked[1]["substeps"] == 1


def test_retimed_backend_counts_watches_in_outer_substeps():
    inner = FakeBackend(
        scene(4, timestep=0.005, substeps=4, watch_tilt=0.5, watch_penetration=0.01),
        script=FakeScript(penetration_time=torch.tensor([0.005, 0.01, 0.02, 9.0])),
    )
    backend = RetimedBackend(inner, scene(4))
    backend.reset(ResetState(**standing(backend)))
    backend.step(torch.zeros(4, 12, dtype=backend.dtype))
    # after 5, 10 and 20 ms: the third, fifth and tenth substep of 2 ms
    assert backend.state.penetration_substep.tolist() == [3, 5, 10, 0]
    assert backend.state.clone().penetration_substep.tolist() == [3, 5, 10, 0]
    assert backend.state.tilt_substep.tolist() == [0, 0, 0, 0]
    assert torch.equal(backend.state.base_position_w, inner.state.base_position_w)


def test_retimed_backend_keeps_the_control_period():
    with pytest.raises(BackendError, match="control period"):
        RetimedBackend(FakeBackend(scene(timestep=0.005, substeps=3)), scene())


def perturbed(draw=1, names=("a", "b", "a"), **options):
    backend = PerturbedBackend(Spy(scene(3)), 1e-7, draw=draw, **options)
    backend.assign(range(3), names)
    backend.reset(ResetState(**standing(backend)))
    return backend


def test_perturbations_are_small_and_the_episodes_own():
    backend = perturbed()
    pose = torch.tensor(GO2.default_joint_position, dtype=backend.dtype)
    off = backend.inner.given.joint_position / pose - 1.0
    assert 0.0 < off.abs().max() <= 1e-7
    assert torch.equal(off[0], off[2]), "one episode, whatever its world"
    assert not torch.equal(off[0], off[1]), "another episode"
    assert abs(float(off.mean())) < 0.5e-7, "to either side"
    height = backend.inner.given.base_position[:, 2]
    assert 0.0 < (height - 0.4).abs().max() <= 1e-7
    assert not torch.equal(backend.inner.given.joint_position, perturbed(2).inner.given.joint_position), "draws"


def test_rounding_puts_every_target_off_and_begins_anew_with_a_reset():
    backend = perturbed(targets=True)
    target = torch.full((3, 12), 0.5, dtype=backend.dtype)

    def steps(count):
        backend.inner.asked.clear()
        for _ in range(count):
            backend.step(target)
        return [asked["joint_targets"] / target - 1.0 for asked in backend.inner.asked]

    first, second = steps(2)
    assert 0.0 < first.abs().max() <= 1e-7
    assert not torch.equal(first, second)
    backend.reset(ResetState(**standing(backend)), torch.tensor([True, False, False]))
    again = steps(1)[0]
    assert torch.equal(again[0], first[0])
    assert not torch.equal(again[2], first[2]), "its episode goes on"
    plain = perturbed()
    plain.step(target)
    assert torch.equal(plain.inner.asked[0]["joint_targets"], target)
    plain.step(None, substeps=1)


def test_variant_builds_what_it_says(monkeypatch):
    made = []

    def make(name, asked, *, device, threads):
        made.append((name, asked.physics, device, threads))
        return FakeBackend(asked)

    monkeypatch.setattr(variants, "make_backend", make)
    plain = Variant(backend="fake").worlds(scene(), threads=2)
    assert isinstance(plain, FakeBackend)
    variant = parse_variant("fake@timestep=0.004")
    assert isinstance(variant.worlds(scene(), threads=1), RetimedBackend)
    assert made[1][1].substeps == 5
    wobbly = Variant(backend="fake", perturbation=1e-7)
    assert isinstance(wobbly.worlds(scene(), threads=1), PerturbedBackend)
