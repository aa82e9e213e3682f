"""``gaitgauge latent``, where it takes a moment."""

import json

import pytest
from gaitgauge.cli.console import Terminal
from gaitgauge.cli.latent import print_latents

SHORT = ("--terrain", "flat", "--terrain", "wave", "--seconds", 0.2, "--robots", 2, "--threads", 1)


def test_tables_and_a_sentence_on_what_was_left_out(run, policy, tmp_path):
    result = run("latent", "pretrained", policy, *SHORT, "--out", "here")
    assert result.exit_code == 1
    assert "terrains told apart" in result.stdout and "of 8 experts count at once" in result.stdout
    assert result.stderr.splitlines()[-1].startswith("standing was left out: ")
    found = json.loads((tmp_path / "here" / "latent.json").read_text())
    assert found["policies"][0]["label"] == "pretrained" and found["terrains"] == ["flat", "wave"]


@pytest.mark.slow
def test_a_single_terrain_is_said_to_have_nothing_to_be_told_from(run):
    result = run("latent", "pretrained", *SHORT[2:], "--out", "here")
    assert result.exit_code == 1 and "commands told apart" in result.stdout
    assert result.stderr.splitlines()[-1].startswith("telling terrains apart was left out: 'wave' is the only terrain")


def test_one_sentence_for_a_policy_with_nothing_to_look_at(refused, policy):
    sentence = refused("latent", policy, *SHORT)
    assert sentence == (
        f"'{policy}' has neither an encoder nor experts (network 'mlp'), so there is no latent to look at; give a policy of "
        "another network, such as cts or moe_cts"
    )


def test_a_policy_without_experts_is_told_so(capsys):
    plain = {"label": "plain", "terrains": {}, "commands": {}, "experts": None, "falls": 0, "walkers": 2}
    print_latents(Terminal(), {"terrains": ["flat"], "commands": ["forward"], "policies": [plain]})
    assert "plain has no experts, so there are no weights of them to show" in capsys.readouterr().out
