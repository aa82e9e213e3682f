"""Logs of robots: formats, joints by name, defects, refusals. Every log here is made by the project itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from gaitgauge.backends.base import PhysicsOptions, Scene
from gaitgauge.backends.registry import make_backend
from gaitgauge.robots import load_robot
from gaitgauge.studies.reality.chirp import Chirp, simulated_log
from gaitgauge.studies.reality.log import LogError, carried_share, free_legs_torque, save_log
from gaitgauge.studies.reality.readers import LogMap, read_log, read_map
from gaitgauge.studies.reality.replaying import check_torque, hung_or_standing
from gaitgauge.terrains.registry import make_terrain

GO2 = load_robot("go2", check=False)
ORDER = tuple(reversed(GO2.joint_names))


@pytest.fixture(scope="module")
def log():
    return simulated_log(GO2, GO2.parameters["gauge"], chirp=Chirp(seconds=1.5))


def columns_of(log):
    names = ("time", "target", "position", "velocity", "torque", "stiffness", "damping")
    return {name: getattr(log, name) for name in names} | {"joint_names": np.array(GO2.joint_names)}


def stored(path, columns):
    np.savez(path, **columns)
    return path


def test_own_format_comes_back_unchanged(log, tmp_path):
    save_log(log, tmp_path / "log.npz")
    back = read_log(tmp_path / "log.npz")
    assert back.robot.name == "go2" and back.held == "hung"
    for name in ("time", "target", "position", "velocity", "torque", "stiffness", "damping"):
        np.testing.assert_allclose(getattr(back, name), getattr(log, name), atol=1e-12)


def test_joints_go_by_name_and_signs_by_the_map(log, tmp_path):
    place = [GO2.joint_names.index(name) for name in ORDER]
    columns = {k: v[..., place] if k not in ("time", "joint_names") else v for k, v in columns_of(log).items()}
    columns["joint_names"] = np.array([name.removesuffix("_joint") for name in ORDER])
    columns["position"], columns["target"] = columns["position"].copy(), columns["target"].copy()
    turned = ORDER.index("FL_calf_joint")
    for key in ("position", "target", "velocity", "torque"):
        columns[key] = columns[key].copy()
        columns[key][:, turned] *= -1.0
    file = stored(tmp_path / "log.npz", columns)
    back = read_log(file, robot="go2", mapping=LogMap(signs={"FL_calf": -1}))
    np.testing.assert_allclose(back.position, log.position)
    with pytest.raises(LogError, match=r"FL_calf_joint stands at .* its sign looks reversed"):
        read_log(file, robot="go2")


def test_names_that_others_use_are_read(log, tmp_path):
    names = {"target": "des_dof_pos", "position": "dof_pos", "velocity": "dof_vel", "torque": "tau_est"}
    columns = {names.get(k, k): v for k, v in columns_of(log).items() if k not in ("stiffness", "damping")}
    back = read_log(stored(tmp_path / "log.npz", columns | {"kp": 25.0, "kd": 1.0}), robot="go2")
    assert back.stiffness.tolist() == [25.0] * 12 and back.torque is not None


def csv_of(path, header, rows):
    path.write_text(
        "\n".join([",".join(header), *(",".join(f"{v:.9g}" for v in row) for row in rows)]), encoding="utf-8"
    )
    return path


def test_own_csv_is_read(log, tmp_path):
    keys = ("target", "position", "stiffness", "damping")
    header = ["time", *(f"{key}_{name}" for key in keys for name in GO2.joint_names)]
    gains = np.tile(np.concatenate([log.stiffness, log.damping]), (len(log.time), 1))
    file = csv_of(tmp_path / "log.csv", header, np.column_stack([log.time, log.target, log.position, gains]))
    back = read_log(file, robot="go2")
    np.testing.assert_allclose(back.position, log.position, atol=1e-8)
    assert back.torque is None and back.stiffness[0] == 25.0


@pytest.mark.parametrize("kind", ["cpp", "rl_sar"])
def test_torques_of_loggers_that_compute_them_are_not_measurements(log, tmp_path, kind):
    sdk = [GO2.joint_names.index(name) for name in GO2.sdk_joint_names]
    parts = {
        "target": log.target,
        "position": log.position[:, sdk],
        "velocity": log.velocity[:, sdk],
        "tau": log.torque[:, sdk],
    }
    mapping = LogMap(
        joints=GO2.sdk_joint_names,
        target_joints=GO2.joint_names,
        stiffness=25.0,
        damping=1.0,
        held="hung",
        period=0.002,
    )
    if kind == "cpp":
        names, times = {"target": "q_des_", "position": "q_", "velocity": "dq_", "tau": "tau_"}, [log.time]
    else:
        names, times = (
            {"target": "joint_pos_target_", "position": "joint_pos_", "velocity": "joint_vel_", "tau": "tau_est_"},
            [],
        )
    header = ["time"] * len(times) + [f"{names[key]}{i}" for key in parts for i in range(12)]
    file = csv_of(tmp_path / "log.csv", header, np.column_stack([*times, *parts.values()]))
    back = read_log(file, robot="go2", mapping=mapping)
    np.testing.assert_allclose(back.position, log.position, atol=1e-8)
    assert back.torque is None and "tau" in back.notes[0]
    with pytest.raises(LogError, match=r"has no times|without names"):
        read_log(file, robot="go2")
    with pytest.raises(LogError, match=r"follows the target of .* different orders"):
        read_log(file, robot="go2", mapping=replace(mapping, target_joints=None))


def test_mcap_is_read_through_a_map(log, tmp_path):
    writing = pytest.importorskip("mcap.writer")
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = writing.Writer(file)
        writer.start()
        schema = writer.register_schema(name="any", encoding="jsonschema", data=b"{}")
        topics = {name: writer.register_channel(name, "json", schema) for name in ("/command", "/state")}
        for row, time in enumerate(log.time[:200]):
            stamp = int((10.0 + time) * 1e9)
            command = {"q": log.target[row].tolist()}
            motors = {"motors": [{"q": q, "dq": v} for q, v in zip(log.position[row], log.velocity[row], strict=True)]}
            for topic, content in (("/command", command), ("/state", motors)):
                writer.add_message(topics[topic], log_time=stamp, data=json.dumps(content).encode(), publish_time=stamp)
        writer.finish()
    (tmp_path / "map.toml").write_text(
        f'robot = "go2"\njoints = {list(GO2.joint_names)}\nstiffness = 25.0\ndamping = 1.0\n'
        '[topics]\ntarget = "/command:q"\nposition = "/state:motors.q"\nvelocity = "/state:motors.dq"\n',
        encoding="utf-8",
    )
    back = read_log(tmp_path / "log.mcap", mapping=read_map(tmp_path / "map.toml"))
    np.testing.assert_allclose(back.velocity, log.velocity[:200])
    np.testing.assert_allclose(back.target, log.target[:200])


def test_bad_rows_are_counted_and_handled(log, tmp_path):
    columns = columns_of(log)
    columns["position"] = columns["position"].copy()
    columns["position"][100] += 0.6  # a jump
    columns["position"][200:203] = columns["position"][200]  # two repetitions
    columns["velocity"] = columns["velocity"].copy()
    columns["velocity"][300, 4] = np.nan
    columns["time"] = columns["time"].copy()
    columns["time"][[400, 401]] = columns["time"][[401, 400]]
    back = read_log(stored(tmp_path / "log.npz", columns), robot="go2")
    assert back.found == {"unordered": 1, "missing": 1, "spikes": 1, "repeated": 2, "late": back.found["late"]}
    assert len(back.time) == len(log.time) - 2 and (np.diff(back.time) > 0).all()
    assert np.abs(back.position - np.interp(back.time, log.time, log.position[:, 0])[:, None]).min() < 1e-9
    assert "1 with a jump (dropped)" in back.defects()
    assert back.cut(0.0, 0.3).found["repeated"] == 0 and back.cut(0.3, 1.0).found["repeated"] == 2


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda c: {k: v[:0] if k not in ("stiffness", "damping", "joint_names") else v for k, v in c.items()},
            "has no rows",
        ),
        (
            lambda c: {k: v[:1] if k not in ("stiffness", "damping", "joint_names") else v for k, v in c.items()},
            "has 1 row;",
        ),
        (lambda c: c | {"position": np.full_like(c["position"], np.nan)}, "values that are missing"),
        (lambda c: c | {k: np.rad2deg(c[k]) for k in ("position", "target")}, "look like degrees"),
        (
            lambda c: c | {"velocity": np.rad2deg(c["velocity"])},
            "velocities of FL_hip_joint are 5. times .* look like degrees",
        ),
        (lambda c: c | {"velocity": -c["velocity"]}, "their sign or their column is wrong"),
        (lambda c: c | {"joint_names": np.roll(c["joint_names"], 1)}, "outside of its range"),
        (lambda c: c | {"joint_names": np.array(["LF_HAA"] * 12)}, "is not of robot 'go2'"),
        (lambda c: {k: v for k, v in c.items() if k != "target"}, "lacks target"),
        (lambda c: {k: v for k, v in c.items() if k != "stiffness"}, "does not say with which stiffness"),
        (lambda c: c | {"time": c["time"][::-1]}, "the time does not rise"),
        (lambda c: c | {"time": 1e3 * c["time"]}, "rows are 2 apart in time; the time must be in seconds"),
        (lambda c: c | {"position": c["position"][:, :5]}, "it must be"),
        (lambda c: c | {"held": np.array("upside down")}, "held is 'upside down'"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_sentence(log, tmp_path, change, sentence):
    with pytest.raises(LogError, match=sentence) as caught:
        read_log(stored(tmp_path / "log.npz", change(columns_of(log))), robot="go2")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_logs_are_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    (tmp_path / "b.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    (tmp_path / "e.csv").write_text("", encoding="utf-8")
    for name, sentence in (
        ("a.npz", "is no .npz file"),
        ("b.csv", "known are"),
        ("e.csv", "is empty"),
        ("c.bag", "logs end in"),
        ("d.npz", "does not exist"),
    ):
        with pytest.raises(LogError, match=sentence):
            read_log(tmp_path / name, robot="go2")


def test_a_robot_on_its_feet_is_not_replayed_as_hung(log):
    loaded = replace(log, position=log.position + np.where(np.arange(12) % 3 == 2, -0.4, 0.0))
    with pytest.raises(LogError, match=r"legs carry \d+% of the robot's weight; it looks like a robot on its feet"):
        hung_or_standing(loaded)
    with pytest.raises(LogError, match=r"hip motors hold .* or the gains in the log are not those that were sent"):
        hung_or_standing(replace(log, stiffness=4 * log.stiffness))
    turning = replace(log, angular_velocity=np.full((len(log.time), 3), 0.6))
    with pytest.raises(LogError, match="looks like a walking robot's"):
        hung_or_standing(turning)
    with pytest.raises(LogError, match="is of a walking robot"):
        hung_or_standing(replace(log, held="walking"))


def test_legs_of_a_standing_robot_carry_its_weight():
    robot, physics = GO2, PhysicsOptions(timestep=0.002, substeps=10)
    terrains = (make_terrain("flat", None),)
    scene = Scene(
        robot=robot, parameters=GO2.parameters["gauge"], terrains=terrains, terrain_index=(0,), physics=physics
    )
    engine = make_backend("mujoco", scene)
    engine.reset(engine.standing())
    for _ in range(75):
        engine.step(torch.tensor([robot.default_joint_position], dtype=engine.dtype))
    position, torque = engine.state.joint_position[0].numpy(), engine.state.joint_torque[0].numpy()
    share = carried_share(robot, position, torque - free_legs_torque(robot, position[None])[0])
    assert share == pytest.approx(1.0, abs=0.1)
    assert abs(carried_share(robot, position, np.zeros(12))) < 1e-9


def test_gains_that_the_torques_contradict_are_refused(log):
    check_torque(log)
    check_torque(replace(log, target=np.tile(log.target[0], (len(log.time), 1))))  # nothing moves
    stiff = simulated_log(
        GO2, GO2.parameters["gauge"], chirp=Chirp(seconds=2.0, last=2.0), damping=5.0, noise=(2e-3, 0.2, 0.1)
    )
    check_torque(stiff)  # noise of speeds is not taken for a low kp
    with pytest.raises(LogError, match=r"says that kp was 60 N·m/rad, but its torques follow 2\d"):
        check_torque(replace(log, stiffness=np.full(12, 60.0)))
    with pytest.raises(LogError, match="kp was 0 N·m/rad, but its torques follow 2"):
        check_torque(replace(log, stiffness=np.zeros(12)))
    with pytest.raises(LogError, match="torques of 0 in every row"):
        check_torque(replace(log, torque=np.zeros_like(log.torque)))
