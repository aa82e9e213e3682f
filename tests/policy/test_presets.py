"""Presets of training codes: data that fit any robot with four legs of three joints, or say why not."""

from types import SimpleNamespace

import pytest
from gaitgauge.policy.base import PolicyError
from gaitgauge.policy.contract import standard_contract
from gaitgauge.policy.foreign import presets as module
from gaitgauge.policy.foreign.presets import find_preset, fitting_presets, preset_contract, presets
from gaitgauge.robots import load_robot

GO2, GO1, ANYMAL = (load_robot(name) for name in ("go2", "go1", "anymal_c"))


@pytest.mark.parametrize("robot", [GO2, GO1, ANYMAL], ids=lambda robot: robot.name)
def test_every_preset_describes_every_quadruped(robot):
    for preset in presets().values():
        contract = preset_contract(preset, robot)
        assert contract.robot == robot.name and sorted(contract.joint_names) == sorted(robot.joint_names)
        assert contract.frame_width in (45, 48)


def test_the_go2_of_go2_rl_gym_is_the_standard_contract():
    assert preset_contract(find_preset("go2_rl_gym"), GO2).hash == standard_contract(GO2).hash


def test_values_go_to_parts_of_legs():
    """HIMLoco moves hips by half as much; the rear thighs of its Go2 stand farther back, its hips outwards."""
    found = preset_contract(find_preset("himloco"), GO2, frames=6)
    at = {name: i for i, name in enumerate(found.joint_names)}
    assert [found.action_scale[at[f"FL_{part}_joint"]] for part in ("hip", "thigh", "calf")] == [0.125, 0.25, 0.25]
    pose = {name: found.default_joint_position[i] for name, i in at.items()}
    assert [pose[f"{leg}_hip_joint"] for leg in ("FL", "FR", "RL", "RR")] == [0.1, -0.1, 0.1, -0.1]
    assert [pose[f"{leg}_thigh_joint"] for leg in ("FL", "FR", "RL", "RR")] == [0.8, 0.8, 1.0, 1.0]
    assert (found.history.length, found.history.order) == (6, "frame-major-newest-first")
    assert found.observation_width == 270


def test_joints_come_leg_by_leg_or_kind_by_kind():
    legs, kinds = (preset_contract(find_preset(name), GO2).joint_names for name in ("rl_sar", "isaac_lab"))
    assert legs[:4] == ("FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint")
    assert kinds[:5] == ("FL_hip_joint", "FR_hip_joint", "RL_hip_joint", "RR_hip_joint", "FL_thigh_joint")
    assert preset_contract(find_preset("isaac_lab"), ANYMAL).joint_names[:3] == ("LF_HAA", "RF_HAA", "LH_HAA")


def test_another_robot_has_its_own_pose_and_gains():
    found = preset_contract(find_preset("isaac_lab"), ANYMAL)
    usual = standard_contract(ANYMAL)
    assert set(found.stiffness) == set(usual.stiffness)
    own, standard = (dict(zip(c.joint_names, c.default_joint_position, strict=True)) for c in (found, usual))
    assert own == standard


def test_presets_are_found_by_the_width_of_the_input():
    found = fitting_presets(GO2, 270)
    assert found["himloco"].history.length == 6 and "isaac_lab" not in found
    assert set(fitting_presets(GO2, 48)) == {"legged_gym", "isaac_lab", "mjlab", "playground"}
    assert fitting_presets(GO2, 47) == {}


def test_an_unknown_preset_is_one_sentence_with_the_nearest_name():
    with pytest.raises(PolicyError, match=r"^there is no preset 'himlco'; did you mean 'himloco'\? choose from go2_rl"):
        find_preset("himlco")


def test_a_robot_with_other_legs_is_one_sentence(monkeypatch):
    plan = SimpleNamespace(legs=((0, 1, 2), (3, 4, 5)), foot_position=module.np.array([[0, 0.1, 0], [0, -0.1, 0]]))
    monkeypatch.setattr(module, "body_plan", lambda robot: plan)
    with pytest.raises(
        PolicyError, match=r"a leg of three joints at each corner; robot 'go2' has 12 joints and 2 legs"
    ):
        preset_contract(find_preset("isaac_lab"), GO2)
    assert fitting_presets(GO2, 45) == {}
