"""The leaderboard: what is ranked, what is only listed, and that hostile text stays text."""

import gzip
import json
from pathlib import Path

import pytest
from gaitgauge.cli.main import app
from gaitgauge.gauge.coverage import UNPROVED, notes
from gaitgauge.gauge.suite import load_suite
from gaitgauge.policy.finding import find_policy
from gaitgauge.studies.cards.board import board_data, render_board, write_board
from gaitgauge.studies.cards.verify import CardError
from gaitgauge.studies.compare.comparison import ComparisonError
from gaitgauge.studies.policies import file_digest
from sample_results import HOSTILE, Page, made_of, read, sample
from typer.testing import CliRunner

CHANCE = sample().chance.to_data()


def card(
    score, *, kind="complete", text="complete", path="a/walk.pt", digest="ab" * 32, observations=("command",), **other
):
    return {
        "schema": 2,
        "suite": {"name": "mine", "version": "1.1.0", "title": "", "digest": digest},
        "coverage": {"kind": kind, "text": text},
        "score": score,
        "score_interval": None if score is None else [score - 0.01, score + 0.01],
        "level": 7.5,
        "chance": CHANCE,
        "policy": {"path": path, "file_sha256": "cd" * 32, "observations": list(observations)},
        "pipeline": "stress",
        "backend": "mujoco",
        "robot": "go2",
        "provenance": {},
        "environments": [],
    } | other


def board(cards):
    """Return the tables of the cards whose content is given."""
    return board_data({name: read(content) for name, content in cards.items()})


def test_complete_cards_are_ranked_by_score_and_others_only_listed():
    part = card(0.9, kind="part", text="1 of 7 terrains")
    (table,) = board({"low.json": card(0.5), "part.json": part, "high.json": card(0.6), "same.json": card(0.5)})
    assert [(e["rank"], e["card"]) for e in table["ranked"]] == [(1, "high.json"), (2, "low.json"), (2, "same.json")]
    assert [(e["rank"], e["coverage"]) for e in table["others"]] == [(None, "part: 1 of 7 terrains")]
    assert table["ranked"][0]["command"] == "gaitgauge verify high.json --policy FILE"


def test_a_card_of_schema_2_is_marked_as_unproved():
    older = sample().to_data() | {"schema": 2}
    tables = board({"new.json": sample().to_data(), "old.json": older})
    assert {e["card"]: e["proved"] for e in tables[0]["ranked"]} == {"new.json": True, "old.json": False}
    assert Page(render_board(tables)).text.count("unproved") == 1
    assert notes(read(older)) == [UNPROVED] and notes(sample()) == []


def test_policies_whose_files_are_called_alike_are_told_apart():
    kept = "runs/HIM/seed-1/kept/policy.gauge.pt"
    cards = {"one.json": card(0.9, path=kept), "CTS-seed-1/results.json": card(0.8, path="policy.gauge.pt")}
    cards |= {
        "b.json": card(0.7, path="b\\walk.pt"),
        "c.json": card(0.6, path="c/walk.pt"),
        "d.json": card(0.5, path="d/trot.pt"),
    }
    (table, other) = board(cards | {"e.json": card(0.9, path="b/walk.pt", robot="a1")})
    assert [e["policy"] for e in table["ranked"]] == ["HIM seed-1", "CTS-seed-1", "b walk", "c walk", "trot"]
    assert [e["policy"] for e in other["ranked"]] == ["walk"]


def test_results_that_do_not_state_their_coverage_or_have_no_score_are_not_ranked():
    old, levels = card(0.7), card(None)
    del old["coverage"]
    (table,) = board({"old.json": old, "levels.json": levels})
    assert not table["ranked"]
    assert [e["card"] for e in table["others"]] == ["old.json", "levels.json"]


def test_other_rules_engines_and_robots_have_tables_of_their_own():
    cards = {"a": card(0.5), "b": card(0.5, digest="00"), "c": card(0.5, backend="newton"), "d": card(0.5, robot="a1")}
    assert len(board(cards)) == 4


def test_a_robot_of_the_same_name_with_other_files_has_a_table_of_its_own():
    """A policy may carry its robot: a lighter one that is called go2 is none."""
    files = {"a": "ab" * 32, "b": "ab" * 32, "c": "cd" * 32}
    cards = {name: card(0.5, provenance={"digests": {"robot": digest}}) for name, digest in files.items()}
    tables = board(cards)
    assert [len(table["ranked"]) for table in tables] == [2, 1]
    assert [table["robot_digest"] for table in tables] == ["ab" * 32, "cd" * 32]
    assert "cdcdcdcdcdcd" in render_board(tables)
    assert board({"old": card(0.5)})[0]["robot_digest"] is None


def test_policies_that_see_the_ground_are_ranked_apart():
    cards = {"1": card(0.9, observations=("command", "height_scan")), "2": card(0.8, observations=("command",))}
    first, second = sorted(board(cards), key=lambda table: table["exteroceptive"])
    assert [e["card"] for e in first["ranked"]] == ["2"] and [e["card"] for e in second["ranked"]] == ["1"]
    assert second["ranked"][0]["observations"] == "exteroceptive" and second["ranked"][0]["rank"] == 1
    assert render_board([first, second]).count("policies that see the ground</li>") == 1


def test_privileged_observations_are_marked_and_have_no_rank():
    cards = {
        "1": card(0.9, observations=("command", "base_linear_velocity_b")),
        "2": card(0.8, observations=("command", "joint_position")),
        "3": card(0.7),
    }
    del cards["3"]["policy"]["observations"]
    (table,) = board(cards)
    assert [(e["rank"], e["observations"]) for e in table["ranked"]] == [(1, "measurable"), (2, "not stated")]
    assert [(e["rank"], e["observations"]) for e in table["others"]] == [(None, "privileged")]


def test_the_page_is_well_formed_and_hostile_text_stays_text():
    page = Page(render_board(board({"x.json": card(0.5, path=HOSTILE), "y.json": card(0.4)})))
    assert not page.open
    assert page.count("img") == page.count("script") == 0
    assert "0.5000" in page.text and "0.4900 – 0.5100" in page.text
    assert "gaitgauge verify y.json --policy FILE" in page.text


def test_a_folder_becomes_a_page_and_what_is_no_card_is_named(tmp_path):
    with pytest.raises(CardError, match="holds no score cards"):
        write_board(tmp_path, tmp_path / "board.html")
    (tmp_path / "one.json").write_text(json.dumps(card(0.5)))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "results.json").write_text(json.dumps(card(0.6)))
    text = write_board(tmp_path, tmp_path / "board.html").read_text()
    assert f"gaitgauge verify {tmp_path / 'run' / 'results.json'}" in text
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ComparisonError, match=r"other.json"):
        write_board(tmp_path, tmp_path / "second.html")
    assert not (tmp_path / "second.html").exists()


def test_the_folder_of_one_evaluation_is_a_board_of_one(tmp_path):
    (tmp_path / "request.json").write_text("{}")
    with pytest.raises(ComparisonError, match=r"request.json"):
        write_board(tmp_path, tmp_path / "board.html")
    (tmp_path / "results.json").write_text(json.dumps(card(0.6)))
    text = write_board(tmp_path, tmp_path / "board.html").read_text()
    assert f"gaitgauge verify {tmp_path / 'results.json'}" in text


def test_a_card_is_not_written_over(tmp_path):
    (tmp_path / "one.json").write_text(text := json.dumps(card(0.5)))
    done = CliRunner().invoke(app, ["board", str(tmp_path), "--out", str(tmp_path / "one.json")])
    assert done.exit_code == 2 and "ends in .html" in done.stderr
    assert (tmp_path / "one.json").read_text() == text


@pytest.fixture
def whole(tmp_path):
    """A complete card of robogauge-1.1, which a function writes into a folder after changes."""
    content = sample(resamples=2000).to_data()
    content["suite"]["digest"] = load_suite("robogauge-1.1").digest

    def write(**changes):
        (tmp_path / "card.json").write_text(json.dumps(content | changes))
        return write_board(tmp_path, tmp_path / "boards" / "all.html")

    write.content = content
    return write


def test_a_card_that_holds_less_than_it_says_is_not_put_on_the_board(whole):
    """The page's folder is created."""
    assert "robogauge-1.1 1.1.0" in Page(whole().read_text()).text
    rows = [row for row in read(whole.content).environments if row.friction != 0.2]
    part = made_of(read(whole.content), rows).to_data()
    with pytest.raises(CardError, match=r"card\.json' calls itself complete, but holds 8 of 9 frictions"):
        whole(**part)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            {"name": "zz", "version": "9"},
            r"card\.json' names its suite zz 9, but its digest a43a.* is that of robogauge-1\.1",
        ),
        ({"version": "9"}, r"names its suite robogauge-1\.1 9, but its digest"),
        (
            {"digest": "ab" * 32},
            r"is of robogauge-1\.1 1\.1\.0 with digest ab.*, but robogauge-1\.1 here is 1\.1\.0 with a43a",
        ),
    ],
)
def test_a_card_that_names_another_suite_than_its_own_is_not_put_on_the_board(whole, change, named):
    """Renamed, it was not checked, and headed the table of a suite that it does not hold."""
    with pytest.raises(CardError, match=named):
        suite, found = whole.content["suite"] | change, whole.content["provenance"]
        digests = found["digests"] | {"suite": suite["digest"]}
        whole(suite=suite, provenance=found | {"digests": digests})


def test_suites_of_the_same_digest_and_other_names_have_tables_of_their_own():
    cards = {name: card(0.5, suite={"name": name, "version": "1", "digest": "ab" * 32}) for name in ("one", "two")}
    assert [table["suite"]["name"] for table in board(cards)] == ["one", "two"]


def test_a_policy_that_ships_is_found_by_name_where_it_is_the_card_s():
    policy = {"path": "pretrained", "file_sha256": file_digest("pretrained")}
    cards = {"a": card(0.5, policy=policy), "b": card(0.4, policy=policy | {"file_sha256": "ab" * 32})}
    (table,) = board(cards)
    assert [e["command"] for e in table["ranked"]] == [
        "gaitgauge verify a",
        "gaitgauge verify b --policy FILE",  # of another release
    ]


def test_what_a_card_says_of_a_policy_beside_it_is_checked_and_what_lies_nowhere_is_marked(tmp_path):
    shipped = Path(__file__).parents[2] / "docs/data/scorecards/pretrained-robogauge-1.1.json.gz"
    content = json.loads(gzip.decompress(shipped.read_bytes()))
    content["policy"]["path"] = "mine.gauge.pt"

    def marked(change):
        (tmp_path / "card.json").write_text(json.dumps(content | change))
        return Page(write_board(tmp_path, tmp_path / "board.html").read_text()).text.count("policy unseen")

    weak = {"motors": content["motors"] | {"stiffness": [1.0] * 12}}
    assert marked({}) == marked(weak) == 1
    (tmp_path / "mine.gauge.pt").write_bytes(find_policy("pretrained").read_bytes())
    assert marked({}) == 0
    with pytest.raises(CardError, match=r"card\.json': motors\.stiffness is"):
        marked(weak)
    (tmp_path / "mine.gauge.pt").write_bytes(b"another file")
    assert marked(weak) == 1
