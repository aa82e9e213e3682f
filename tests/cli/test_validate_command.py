"""``gaitgauge validate`` as a user runs it."""

import json


def test_the_papers_example(run):
    done = run("validate", "--example", "paper")
    assert done.exit_code == 0, done.output
    assert "0.0573" in done.stdout and "longitudinal (linear, stairs)" in done.stdout
    found = json.loads(run("validate", "--example", "paper", "--json").stdout)
    assert round(found[0]["simulators"]["RoboGauge"]["errors"]["groups"]["average"]["tracking"], 4) == 0.0558


def test_tables_of_ones_own(run, refused, tmp_path):
    for name, value in (("real", 0.5), ("sim", 0.75)):
        (tmp_path / f"{name}.csv").write_text(f"motion,lin_vel_err\nwalk,{value}\n")
    done = run("validate", "real.csv", "sim.csv", "--json")
    assert json.loads(done.stdout)["simulators"]["sim"]["errors"]["metrics"]["walk"] == {"lin_vel_err": 0.25}
    assert "give the measured table" in refused("validate", "real.csv")
    assert "leave out either the files or --example" in refused("validate", "real.csv", "sim.csv", "--example", "paper")
    assert "does not exist" in refused("validate", "real.csv", "none.csv")
    assert "no example 'other'" in refused("validate", "--example", "other")
