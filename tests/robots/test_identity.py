"""What a policy remembers of its robot, and what becomes of it where the robot is gone or has changed."""

import base64
import json
import shutil
import zlib
from dataclasses import replace

import pytest
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.robot_of import REMEMBERED, robot_for, without_copy
from gaitgauge.robots import RobotError, load_robot
from gaitgauge.robots.identity import identify, recall
from gaitgauge.robots.loading import robot_digest


def through_json(entry):
    return json.loads(json.dumps(entry, default=str))


def test_an_installed_robot_is_remembered_by_name():
    go2 = load_robot("go2")
    entry = identify(go2, "go2")
    assert entry == {"name": "go2", "digest": robot_digest(go2)}
    assert recall(entry) == (go2, None)


def test_a_changed_robot_is_said():
    entry = identify(load_robot("go2"), "go2") | {"digest": "0" * 64}
    _, sentence = recall(entry)
    assert sentence.startswith(
        "the installed robot 'go2' has changed since the policy was made: its digest is 5a519c5a7b5e"
    )


def test_a_robot_that_is_gone_comes_from_the_policy(unseen, tmp_path):
    entry = through_json(identify(unseen, str(tmp_path / "gone" / "robot.toml")))
    robot, sentence = recall(entry)
    assert robot == replace(unseen, mjcf=robot.mjcf)
    assert robot.mjcf != unseen.mjcf and robot.mjcf.read_text() == unseen.mjcf.read_text()
    assert robot_digest(robot) == robot_digest(unseen)
    assert sentence == f"'{tmp_path}/gone/robot.toml' is not there; the robot is the copy that the policy carries"


def test_a_robot_of_many_files_is_carried_whole(unseen, tmp_path):
    """Included files and meshes lie where the model looks for them."""
    (tmp_path / "model" / "parts").mkdir(parents=True)
    text = unseen.mjcf.read_text().replace("<worldbody>", '<include file="parts/more.xml"/><worldbody>')
    mjcf = tmp_path / "model" / "unseen.xml"
    mjcf.write_text(text)
    (tmp_path / "model" / "parts" / "more.xml").write_text("<mujoco><option timestep='0.004'/></mujoco>")
    robot = replace(unseen, mjcf=mjcf)
    entry = through_json(identify(robot, "gone/robot.toml"))
    shutil.rmtree(tmp_path / "model")
    assert set(entry["files"]) == {"unseen.xml", "parts/more.xml"}
    assert robot_digest(recall(entry)[0]) == entry["digest"]


BOMB = base64.b64encode(zlib.compress(bytes(20_000_000))).decode()
READING = base64.b64encode(zlib.compress(b"<mujoco><include file='/etc/passwd'/></mujoco>")).decode()
LAUGHS = base64.b64encode(zlib.compress(b"<!DOCTYPE m [<!ENTITY a 'ha'>]><mujoco model='&a;'/>")).decode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e | {"files": {"../x.xml": next(iter(e["files"].values()))}}, "outside its folder"),
        (lambda e: e | {"files": {"unseen.xml": "no base64"}}, "cannot be unpacked"),
        (lambda e: e | {"files": dict.fromkeys("abc", BOMB)}, "unpacks to more than 50 MB"),
        (lambda e: e | {"files": {"a\0b": "", **e["files"]}}, "without control characters"),
        (lambda e: e | {"files": {"unseen.xml": LAUGHS}}, "defines XML entities"),
        (lambda e: e | {"files": {"unseen.xml": READING}}, "names the file '/etc/passwd', which is none of its own"),
        (lambda e: e | {"description": e["description"] | {"mjcf": "none.xml"}}, "none.xml' cannot be read"),
        (lambda e: e | {"digest": "0" * 64}, "is damaged: its digest"),
        (lambda e: e | {"digest": "short"}, "the robot that the policy remembers.*digest"),
        (lambda e: e | {"files": None}, "which is not there; say where it is with --robot"),
        (lambda e: e | {"description": e["description"] | {"mjcf": "/etc/passwd"}}, "none of its own"),
        (lambda e: "go2", "the robot that the policy remembers"),
    ],
)
def test_what_strangers_write(unseen, change, message):
    entry = change(through_json(identify(unseen, "gone/robot.toml")))
    with pytest.raises(RobotError, match=message):
        recall(entry)


def test_robot_of_a_policy(unseen, caplog):
    entry = through_json(identify(unseen, "/gone/robot.toml"))
    contract = standard_contract(unseen, provenance={REMEMBERED: entry})
    assert robot_for(contract).joint_names == unseen.joint_names
    assert "the robot is the copy that the policy carries" in caplog.text
    assert "files" not in without_copy(contract.provenance)[REMEMBERED]
    with pytest.raises(
        RobotError, match=r"is not installed and which it does not carry; give its robot.toml with --robot"
    ):
        robot_for(replace(contract, provenance={}))
    assert robot_for(standard_contract(load_robot("go2"))) == load_robot("go2")
