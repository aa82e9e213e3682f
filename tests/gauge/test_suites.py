"""Suites as data: what ships, how a suite of one's own extends another, and what is refused."""

from dataclasses import replace

import pytest
from gaitgauge.gauge.suite import SUITE_FOLDER, SuiteError, load_suite, suite_names
from gaitgauge.terrains.registry import gauge_terrain_names

REFERENCE, OWN = load_suite("robogauge-1.1"), load_suite("gaitgauge-1")


@pytest.fixture
def suite_file(tmp_path):
    """Writes a suite file and gives its path."""

    def write(text, name="mine.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


def mine(text=""):
    return f'extends = "gaitgauge-1"\nname = "mine"\nversion = "1.0.0"\n{text}'


def test_every_suite_that_ships_loads_under_its_own_name():
    assert {"robogauge-1.1", "gaitgauge-1"} <= set(suite_names())
    for name in suite_names():
        suite = load_suite(name)
        assert suite.name == name
        assert load_suite(str(SUITE_FOLDER / f"{name}.toml")) == suite
        assert set(suite.matrix.terrains) <= set(gauge_terrain_names())


def test_the_reference_has_the_published_numbers():
    assert REFERENCE.matrix.frictions == (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    assert set(REFERENCE.matrix.terrains) == set(gauge_terrain_names())
    assert REFERENCE.matrix.payloads == (0.0,)
    assert (REFERENCE.matrix.seeds, REFERENCE.matrix.search_seeds) == ((0, 1, 2), (0, 1, 2, 3, 4))
    assert REFERENCE.physics.control_period == pytest.approx(0.02)
    assert not REFERENCE.physics.torque_limits
    assert REFERENCE.goal("diagonal_velocity").phases == (3.0, 3.0)
    assert REFERENCE.goal("max_velocity").phases == (5.0, 2.0)
    assert sum(REFERENCE.metrics.weights.values()) == 8
    assert REFERENCE.commands.target_time == {"slope": 20.0, "wave": 20.0, "stairs": 30.0, "obstacle": 30.0}
    noise = REFERENCE.noise
    assert (noise.joint_position, noise.joint_velocity, noise.base_angular_velocity) == (0.01, 3.0, 0.8)
    assert (REFERENCE.scoring.level_weight, REFERENCE.scoring.quality_weight) == (0.09, 0.19)


def test_the_own_suite_has_eight_metrics_and_acting_torque_limits():
    assert len(OWN.metrics.weights) == 8
    assert sum(OWN.metrics.weights.values()) == 10
    assert OWN.physics.torque_limits
    assert OWN.events.penetration is None
    assert OWN.events.fall_tilt == OWN.physics.watch_tilt == pytest.approx(1.309)
    assert OWN.scoring.decimals is None
    assert OWN.goals == REFERENCE.goals
    assert OWN.matrix.frictions == REFERENCE.matrix.frictions


def test_a_suite_of_ones_own_changes_what_it_names_and_nothing_else(suite_file):
    suite = load_suite(suite_file(mine("[matrix]\nfrictions = [0.5, 1]\n[events]\nfall = 'close-goal'")))
    assert suite == replace(
        OWN,
        name="mine",
        matrix=replace(OWN.matrix, frictions=(0.5, 1.0)),
        events=replace(OWN.events, fall="close-goal"),
    )
    assert isinstance(suite.matrix.frictions[1], float)


def test_a_suite_may_extend_another_file_beside_it(suite_file, monkeypatch):
    suite_file(mine("[noise]\nlatency = 3"), "base.toml")
    path = suite_file('extends = "base.toml"\nname = "second"\n[settling]\nlongest = 1')
    monkeypatch.chdir("/")
    suite = load_suite(path)
    assert (suite.name, suite.noise.latency, suite.settling.longest) == ("second", 3, 1.0)


def test_digests_tell_suites_of_one_name_apart(suite_file):
    one = load_suite(suite_file(mine("[settling]\nlongest = 2.0")))
    other = load_suite(suite_file(mine("[settling]\nlongest = 2.5"), "other.toml"))
    assert one.name == other.name
    assert one.digest != other.digest
    assert one.digest == load_suite(suite_file(mine("[settling]\nlongest = 2"))).digest


def test_published_suites_keep_their_digests():
    # results bear them: what a suite may say anew must not change what was published
    assert load_suite("robogauge-1.1").digest.startswith("a43a0522c0c034c0")
    assert load_suite("gaitgauge-1").digest.startswith("364e879262c30d63")


def test_a_suite_may_limit_torque_by_speed(suite_file):
    plain, limited = (load_suite(suite_file(mine(text))) for text in ("", "[physics]\ntorque_speed_limit = true"))
    assert limited.physics.torque_speed_limit and limited.digest != plain.digest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[matrix]\nfriction = [1.0]", "matrix has the unknown key 'friction'; allowed here: crossed, frictions"),
        ("colour = 3", "has the unknown key 'colour'"),
        ("[matrix]\nfrictions = 0.6", r"frictions is 0.6; a list is needed"),
        ("[matrix]\nfrictions = ['rough']", "frictions is 'rough'; a number is needed"),
        ("[matrix]\nfrictions = []", "needs at least one terrain, friction"),
        ("[matrix]\nseeds = [1.5]", "seeds is 1.5; a whole number is needed"),
        ("[commands]\nflat = [1.0, 2.0]", "flat is .1.0, 2.0.; a list with 3 entries is needed"),
        ("[metrics.weights]\nlin_vel_err = 'much'", "weights.lin_vel_err is 'much'; a number is needed"),
        ("[physics]\ntorque_limits = 1", "torque_limits is 1; a true or false is needed"),
        ("[noise]\nstream = 'dice'", "noise.stream is 'dice'; choose one of reference, counter"),
        ("[events]\nfall = 'ignore'", "events.fall is 'ignore'; choose one of close-goal, zero-rest"),
        ("[events]\nfall_tilt = 1.0", r"events.fall_tilt \(1.0\) and physics.watch_tilt \(1.309\) must be the same"),
        ("[events]\npenetration = 0.1", "must be the same"),
        ("[metrics]\ninterval = 5", "metrics.interval is 5 substeps; at least physics.substeps"),
        ("[noise]\nlatency = 11", "noise.latency is 11 substeps"),
        ("[scoring]\npass_rate = 1.2", "scoring.pass_rate is 1.2"),
        (
            "[metrics]\nweights = { dof_power = 1.0 }",
            "scoring.groups.tracking names 'ang_vel_err', which has no weight",
        ),
        ("[metrics]\nweights = { dof_power = 0.0 }", "weights must be above zero"),
        ("goals = 3", "goals is 3; a list is needed"),
        ("[[goals]]\nname = 'max_velocity'", "goals is incomplete; it lacks phases"),
        ("x = [", "cannot be read"),
    ],
)
def test_a_malformed_suite_is_refused_in_one_sentence(suite_file, text, message):
    with pytest.raises(SuiteError, match=message) as caught:
        load_suite(suite_file(mine(text)))
    assert "\n" not in str(caught.value)


def test_a_suite_must_not_pass_for_another(suite_file):
    for text in (
        'extends = "gaitgauge-1"\n[settling]\nlongest = 1.0',
        'extends = "gaitgauge-1"\nname = "robogauge-1.1"',
    ):
        with pytest.raises(SuiteError, match="give it a 'name' of its own"):
            load_suite(suite_file(text))


def test_suites_that_extend_each_other_are_refused(suite_file):
    suite_file('extends = "b.toml"\nname = "a"', "a.toml")
    path = suite_file('extends = "a.toml"\nname = "b"', "b.toml")
    with pytest.raises(SuiteError, match="extends itself"):
        load_suite(path)


def test_an_unknown_suite_is_refused_with_a_hint(tmp_path):
    with pytest.raises(SuiteError, match="there is no suite 'gaitguage-1'; did you mean 'gaitgauge-1'"):
        load_suite("gaitguage-1")
    with pytest.raises(SuiteError, match="there is no suite"):
        load_suite(str(tmp_path / "missing.toml"))


def test_an_incomplete_suite_is_refused(suite_file):
    with pytest.raises(SuiteError, match="is incomplete; it lacks version"):
        load_suite(suite_file('name = "mine"'))
