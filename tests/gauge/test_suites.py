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
    assert len(OWN.metrics.weights) == 9 and OWN.metrics.weights["motion_done"] == 0.0
    assert sum(OWN.metrics.weights.values()) == 10
    assert OWN.physics.torque_limits
    assert OWN.events.penetration is None
    assert OWN.events.fall_tilt == OWN.physics.watch_tilt == pytest.approx(1.309)
    assert OWN.scoring.decimals is None
    assert OWN.goals == REFERENCE.goals
    assert OWN.matrix.frictions == REFERENCE.matrix.frictions


def test_checkpoints_are_chosen_on_seeds_that_no_benchmark_scores():
    mid = load_suite("mid").matrix
    for suite in (REFERENCE, OWN):
        scored = {*suite.matrix.seeds, *suite.matrix.search_seeds}
        assert scored.isdisjoint({*mid.seeds, *mid.search_seeds})
    assert load_suite("mid").version == "2.0.0"


def test_scores_during_training_have_seeds_of_their_own_too():
    seeds = {
        name: {*load_suite(name).matrix.seeds, *load_suite(name).matrix.search_seeds}
        for name in ("quick", "mid", "robogauge-1.1", "gaitgauge-1")
    }
    for name in ("quick", "mid"):
        assert not seeds[name] & set().union(*(other for key, other in seeds.items() if key != name))


def test_the_own_suites_search_seeds_are_not_scored():
    matrix = load_suite("gaitgauge-1").matrix
    assert not {*matrix.seeds} & {*matrix.search_seeds}


def test_a_suite_of_ones_own_changes_what_it_names_and_nothing_else(suite_file):
    suite = load_suite(
        suite_file(mine("[matrix]\nfrictions = [0.5, 1]\nnominal_friction = 0.5\n[events]\nfall = 'close-goal'"))
    )
    assert suite == replace(
        OWN,
        name="mine",
        version="1.0.0",
        matrix=replace(OWN.matrix, frictions=(0.5, 1.0), nominal_friction=0.5),
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
    assert load_suite("mid").digest.startswith("efec24c012a74816")


def test_a_suite_may_limit_torque_by_speed(suite_file):
    plain, limited = (
        load_suite(suite_file(mine(f"[physics]\ntorque_speed_limit = {text}"))) for text in ("false", "true")
    )
    assert limited.physics.torque_speed_limit and limited.digest != plain.digest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[noise]\nstream = 'reference'",
            "noise.projected_gravity is 0.05, which the stream 'reference' does not draw",
        ),
        (
            "[noise]\nstream = 'reference'\nprojected_gravity = 0.0\nbase_linear_velocity = 0.0",
            "scoring.level is 'area', and episodes need noise of their own",
        ),
        (
            "[scoring]\nlevel = 'curve'\nbracket_seeds = 7",
            "scoring.bracket_seeds is 7; at most the 6 of matrix.search_seeds",
        ),
        ("[push]\nforce = [100.0, 80.0]", "push.force .100 to 80 N. must rise"),
        ("[push]\nafter = [3.5, 1.5]", "push.after .3.5 to 1.5 s. must rise"),
        ("[push]\ngoal = 'target_pos_velocity'", "push.goal .target_pos_velocity. is none of goals with sub-commands"),
        ("gains = 'mine'", "gains is 'mine'"),
        ("[matrix]\nfriction = [1.0]", "unknown field 'matrix.friction'; did you mean 'frictions'"),
        ("colour = 3", "unknown field 'colour'; choose from name, version"),
        ("[matrix]\nfrictions = 0.6", "matrix.frictions is 0.6; it must be a list"),
        ("[matrix]\nfrictions = ['rough']", r"matrix.frictions\[0\] is 'rough'; it must be a number"),
        ("[matrix]\nfrictions = []", r"matrix.frictions is \[\]; it must have at least 1 item"),
        ("[matrix]\nfrictions = [0.5, -1]", r"matrix.frictions\[1\] is -1; it must be greater than 0"),
        ("[matrix]\nfrictions = [0.5, 0.5]", "matrix.frictions has an entry twice"),
        ("[matrix]\nfrictions = [nan]", r"matrix.frictions\[0\] is nan; it must be a finite number"),
        ("[matrix]\npayloads = [-100]", r"matrix.payloads\[0\] is -100; it must be greater than or equal to -5"),
        ("[matrix]\nseeds = [1.5]", r"matrix.seeds\[0\] is 1.5; it must be a whole number"),
        ("[matrix]\nseeds = [1000000000000000000000]", r"matrix.seeds\[0\] is 1000000000000000000000; .* 2\^63"),
        ("[matrix]\nseeds = [-1]", "greater than or equal to 0"),
        ("[matrix]\nnominal_friction = inf", "matrix.nominal_friction is inf; it must be a finite number"),
        (
            "[matrix]\nfrictions = [0.2, 0.4]",
            r"matrix.nominal_friction \(0.6\) is none of matrix.frictions \(0.2, 0.4\); add it there, or let",
        ),
        ("[matrix]\npayloads = [2]", r"matrix.nominal_payload \(0\) is none of matrix.payloads \(2\)"),
        (
            "goals = [{ name = 'jump', phases = [] }]",
            "the goal 'jump' has no commands; give it sub_commands, or choose one of diagonal_velocity",
        ),
        ("[commands]\nflat = [1.0, 2.0]", r"commands.flat is \[1.0, 2.0\]; more entries are needed"),
        ("[commands]\nflat = [1.0, 2.0, 3.0, 4.0]", "commands.flat is .*; it must have at most 3 items"),
        ("[commands]\ntarget_radius = inf", "commands.target_radius is inf; it must be a finite number"),
        ("[metrics.weights]\nlin_vel_err = 'much'", "metrics.weights.lin_vel_err is 'much'; it must be a number"),
        ("[metrics.weights]\nlin_vel_err = inf", "metrics.weights.lin_vel_err is inf; it must be a finite number"),
        ("[metrics]\nsoft_limit_joints = []", "metrics.soft_limit_joints is .*; it must have at least 1 item"),
        ("[physics]\ntorque_limits = 1", "physics.torque_limits is 1; it must be true or false"),
        ("[physics]\nself_collision = 'legs'", "physics.self_collision is 'legs'; it must be true or false"),
        ("[physics]\niterations = -1", "physics.iterations is -1; it must be greater than or equal to 1"),
        ("[noise]\nstream = 'dice'", "noise.stream is 'dice'; it must be 'reference' or 'counter'"),
        ("[noise]\njoint_velocity = nan", "noise.joint_velocity is nan; it must be a finite number"),
        ("[events]\nfall = 'ignore'", "events.fall is 'ignore'; it must be 'close-goal' or 'zero-rest'"),
        ("[events]\nfall_tilt = 1.0", r"events.fall_tilt \(1.0\) and physics.watch_tilt \(1.309\) must be the same"),
        ("[events]\npenetration = 0.1", "must be the same"),
        ("[settling]\nshortest = 4.0", "settling.shortest"),
        ("[metrics]\ninterval = 5", "metrics.interval is 5 substeps; at least physics.substeps"),
        ("[noise]\nlatency = 11", "noise.latency is 11 substeps"),
        ("[noise]\nlatency = -1", "noise.latency is -1; it must be greater than or equal to 0"),
        ("[scoring]\npass_rate = 1.2", "scoring.pass_rate is 1.2; it must be less than or equal to 1"),
        ("[scoring]\nbootstrap = 1000000000", "scoring.bootstrap is 1000000000; it must be less than or equal to"),
        (
            "[scoring]\nlevel_weight = 0.5",
            r"a perfect score would be 4.69 \(level_weight 0.5 for each of 9 levels, quality_weight 0.19\)",
        ),
        ("[scoring]\nlevels = 11", "a perfect score would be 1.09"),
        ("[scoring]\nquality_weight = 0.2", "a perfect score would be 1.01"),
        ("[scoring]\nlevels = 0", "scoring.levels is 0; it must be greater than or equal to 1"),
        (
            "[metrics]\nweights = { dof_power = 1.0 }",
            "scoring.groups.tracking names 'ang_vel_err', which has no weight",
        ),
        (
            "[metrics]\nweights = { dof_power = -0.1 }",
            "metrics.weights.dof_power is -0.1; it must be greater than or equal to 0",
        ),
        (
            "[metrics]\nweights = { dof_power = 0.0 }",
            "metrics.weights are all zero; give at least one metric a weight above 0",
        ),
        ("[metrics]\nweights = {}", "metrics.weights is {}; .* at least 1 item"),
        (
            "[matrix]\nterrains = ['flat', 'flatt']",
            r"suite file .*mine.toml: matrix.terrains has the unknown terrain 'flatt'; did you mean 'flat'\? choose from flat, ",
        ),
        ("push = 'no'", "push is 'no'; it must be a table, or false$"),
        ("push = true", "push is True; it must be a table, or false$"),
        ("[push]\ngoal = 3", "push.goal is 3; it must be a text$"),
        ("[metrics]\nzmp_span = -1", "metrics.zmp_span is -1; it must be greater than 0, or false$"),
        ("[scoring]\ndecimals = 'all'", "scoring.decimals is 'all'; it must be a whole number, or false$"),
        ("goals = 3", "goals is 3; it must be a list"),
        ("goals = []", "goals is .*; it must have at least 1 item"),
        ("[[goals]]\nname = 'max_velocity'", r"the goal 'max_velocity' has the phases \[\]; give it 2 lengths"),
        ("[[goals]]\nname = 'max_velocity'\nphases = [5.0]", r"has the phases \[5.0\]; give it 2 lengths"),
        (
            "[[goals]]\nname = 'max_velocity'\nphases = [1, 1, 1]",
            r"has the phases \[1.0, 1.0, 1.0\]; give it 2 lengths",
        ),
        ("[[goals]]\nname = 'max_velocity'\nphases = [1, 0]", r"phases\[1\] is 0; it must be greater than 0"),
        ("[[goals]]\nname = 'target_pos_velocity'\nphases = [3, 3]", r"has the phases \[3.0, 3.0\]; give it 0 lengths"),
        (
            "[metrics.weights]\nlin_vel_err = 1.0\ngrace = 1.0",
            "metrics.weights has the unknown metric 'grace'; choose from lin_vel_err, ang_vel_err",
        ),
        ("[metrics.weights]\ndof_powr = 1.0", "unknown metric 'dof_powr'; did you mean 'dof_power'"),
        ("[[goals]]\nname = 'dance'\nphases = []", "the goal 'dance' has no commands"),
        ("[[goals]]\nname = 'max_velocity'\nphases = [1e9, 1]", r"phases\[0\] is 1000000000.0; it must be less"),
        ("[[goals]]\nname = 'max_velocity'\nphases = [1, 1]\n" * 2, "goals has a goal twice"),
        ("x = " + "[" * 50 + "]" * 50, "nested too deep"),
        ("x = " + "[" * 5000, "nested too deep"),
        ("x = 2020-01-01", "x is datetime.date"),
        ("x = '" + "a" * 1_000_001 + "'", "larger than 1 MB"),
        ("x = [", "not valid TOML"),
    ],
)
def test_a_malformed_suite_is_refused_in_one_sentence(suite_file, text, message):
    with pytest.raises(SuiteError, match=message) as caught:
        load_suite(suite_file(mine(text)))
    assert "\n" not in str(caught.value)
    assert "mine.toml" in str(caught.value)
    assert len(str(caught.value)) < 600


def test_a_suite_must_not_pass_for_another(suite_file):
    for text in (
        'extends = "gaitgauge-1"\n[settling]\nlongest = 1.0',
        'extends = "gaitgauge-1"\nname = "robogauge-1.1"',
    ):
        with pytest.raises(SuiteError, match="give it a 'name' of its own"):
            load_suite(suite_file(text))


@pytest.mark.parametrize(
    "name", ["../../home", "/etc", ".", "..", "", "a/b", r"a\\b", "x" * 300, "[/x]", r"a\u0000", r"a\n"]
)
def test_a_suite_s_name_is_never_a_path(suite_file, name):
    with pytest.raises(SuiteError, match="name is "):
        load_suite(suite_file(f'extends = "gaitgauge-1"\nname = "{name}"'))


@pytest.mark.parametrize("name", ["x" * 300 + ".toml", "nul\0.toml", "\udcff.toml", "folder.toml"])
def test_paths_that_cannot_be_opened_are_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(SuiteError, match="suite file '"):
        load_suite(name)


def test_suites_that_extend_each_other_are_refused(suite_file):
    suite_file('extends = "b.toml"\nname = "a"', "a.toml")
    path = suite_file('extends = "a.toml"\nname = "b"', "b.toml")
    with pytest.raises(SuiteError, match="extends itself"):
        load_suite(path)


@pytest.mark.parametrize(
    ("base", "sentence"),
    [
        ("5", "extends is 5; it must be a suite's name or the path of a .toml file"),
        ('["a"]', r"extends is \['a'\]; it must be a suite's name"),
        ("true", "extends is True; it must be a suite's name"),
        ("{ a = 1 }", "extends is {'a': 1}; it must be a suite's name"),
        ('""', r"mine\.toml: extends is ''; it must be one of demo, .*, or a .toml file"),
        ('"../.."', r"mine\.toml: extends is '../..'; it must be one of demo"),
        ('"DEMOS"', r"mine\.toml: extends is 'DEMOS'; it must be one of demo"),
        ('"gaitgauge-2"', "did you mean 'gaitgauge-1'"),
        ('"\\u0000.toml"', "suite file '.*' (does not exist|cannot be read)"),
        ('"/etc/none.toml"', "suite file '/etc/none.toml' does not exist"),
        ('"mine.toml"', "extends itself"),
        ('"./../suites/mine.toml"', "does not exist|extends itself"),
    ],
)
def test_what_a_suite_cannot_extend_is_named(suite_file, base, sentence):
    with pytest.raises(SuiteError, match=sentence) as caught:
        load_suite(suite_file(f'extends = {base}\nname = "mine"'))
    assert str(caught.value).isprintable()


def test_an_unknown_suite_is_refused_with_a_hint(tmp_path):
    with pytest.raises(SuiteError, match=r"there is no suite 'gaitguage-1'; did you mean 'gaitgauge-1'"):
        load_suite("gaitguage-1")
    with pytest.raises(SuiteError, match=r"missing.toml' does not exist"):
        load_suite(str(tmp_path / "missing.toml"))


def test_an_incomplete_suite_is_refused(suite_file):
    with pytest.raises(SuiteError, match=r"mine.toml: it lacks version, title"):
        load_suite(suite_file('name = "mine"'))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[physics]\ntimestep = 1e-12\n", "physics.timestep is 1e-12; it must be greater than or equal to 0.00001"),
        (
            "[commands]\nflat = [0.0, 0.0, 0.0]\n",
            r"commands.flat is \[0.0, 0.0, 0.0\]; tracking errors are measured by",
        ),
        ("[commands]\nlevelled = [1.0, 0.0, 1.0]\n", "commands.levelled is .* each must be above 0"),
    ],
)
def test_a_suite_that_never_ends_or_commands_nothing_is_refused(tmp_path, text, sentence):
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "demo"\nname = "mine"\n{text}')
    with pytest.raises(SuiteError, match=sentence):
        load_suite(str(path))
