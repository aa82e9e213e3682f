import torch
from gaitgauge.backends.registry import backend_names
from gaitgauge.cli import doctor
from gaitgauge.gauge.pipelines import make_environments
from gaitgauge.gauge.suite import load_suite, suite_names
from gaitgauge.policy.foreign.presets import presets
from gaitgauge.policy.loading import load_policy
from gaitgauge.terrains.registry import terrain_names
from gaitgauge.training.tasks import TASKS


def test_lists_are_complete(run):
    for what, names in {
        "terrains": terrain_names(),
        "backends": backend_names(),
        "suites": suite_names(),
        "tasks": list(TASKS),
        "policies": ["latest", "best", "pretrained"],
        "presets": list(presets()),
        "zoo": ["himloco.pt", "270, frames", "PMY9527"],
    }.items():
        result = run("list", what)
        assert result.exit_code == 0
        for name in names:
            assert name in result.stdout


def test_suites_are_listed_with_the_environments_that_they_run(run):
    printed = run("list", "suites").stdout
    for name in suite_names():
        suite = load_suite(name)
        count = len(make_environments(suite, terrains=suite.matrix.terrains, frictions=None, payloads=None, level=None))
        row = next(line for line in printed.splitlines() if f" {name} " in line)
        assert f" {count} (" in row


def test_policies_of_training_runs_are_listed(run, tmp_path, policy, contract):
    runs = tmp_path / "logs" / "rsl_rl" / "go2_flat"
    for name in ("2026-01-01_10-00-00/model_50.pt", "2026-01-01_10-00-00/model_100.pt", "2026-01-02_10-00-00/best.pt"):
        (runs / name).parent.mkdir(parents=True, exist_ok=True)
        (runs / name).write_bytes(policy.read_bytes())
    long = runs / f"2026-01-02_10-00-01_{'with_a_long_name' * 2}"
    long.mkdir()
    (long / "model_7.pt").write_bytes(b"damaged")
    result = run("list", "policies")
    assert result.exit_code == 0
    rows = result.stdout.splitlines()
    (first,) = [r for r in rows if "model_100.pt" in r]
    assert contract.hash[:12] in first
    assert not any("model_50.pt" in r for r in rows)
    assert "unusable" in result.stdout
    assert any("best.pt" in r and contract.hash[:12] in r for r in rows)


def test_import_writes_the_same_policy_with_its_contract(run, tmp_path, policy, contract):
    result = run("import", policy, tmp_path / "deep" / "copy.gauge.pt")
    assert result.exit_code == 0
    assert contract.hash in result.stdout
    assert "FL_hip_joint" in result.stdout
    copy = load_policy(tmp_path / "deep" / "copy.gauge.pt")
    assert copy.contract == contract or copy.contract.hash == contract.hash
    observation = torch.randn(1, 45)
    assert torch.equal(copy.session(1).act(observation), load_policy(policy).session(1).act(observation))


def test_doctor_says_what_to_do_about_a_missing_package(monkeypatch, run):
    monkeypatch.setattr(
        doctor, "requires", lambda name: ["rich>=1", "no-such-package>=2", "numpy<1", 'x; extra == "dev"']
    )
    findings = {f.what: f for f in doctor.check_packages()}
    assert set(findings) == {"rich", "no-such-package", "numpy"}
    assert findings["rich"].status == doctor.OK
    assert findings["no-such-package"].status == doctor.PROBLEM
    assert "pip install 'no-such-package>=2'" in findings["no-such-package"].advice
    assert findings["numpy"].status == doctor.PROBLEM
    assert "<1" in findings["numpy"].found

    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_packages,))
    assert run("doctor").exit_code == 1
    monkeypatch.setattr(doctor, "requires", lambda name: ["rich>=1"])
    assert run("doctor").exit_code == 0


def test_doctor_survives_what_kills_a_process(monkeypatch):
    monkeypatch.setattr(doctor.picture, "PROBE", "import os; os.abort()")
    assert [f.status for f in doctor.check_rendering()] == [doctor.WARNING, doctor.WARNING]
    monkeypatch.setattr(doctor, "_MUJOCO_PROBE", "raise ImportError('no libmujoco')")
    (finding,) = doctor.check_mujoco()
    assert finding.status == doctor.PROBLEM
    assert "no libmujoco" in finding.found
    monkeypatch.setattr(doctor, "_MUJOCO_PROBE", 'print(\'["3.17.0", "3.1.0"]\')')
    assert [f.status for f in doctor.check_mujoco()] == [doctor.PROBLEM]


def test_doctor_treats_no_gpu_as_a_warning(monkeypatch):
    monkeypatch.setattr(doctor, "_TORCH_PROBE", "print('[null, []]')")
    monkeypatch.setattr(doctor, "_driver", lambda: None)
    assert [f.status for f in doctor.check_gpu()] == [doctor.WARNING]
    monkeypatch.setattr(doctor, "_driver", lambda: "570.1")
    (finding,) = doctor.check_gpu()
    assert finding.status == doctor.WARNING
    assert "CUDA build" in finding.advice


def test_doctor_finds_a_folder_that_takes_no_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert all(f.status != doctor.PROBLEM for f in doctor.check_room())
    (tmp_path / "logs").write_text("a file in the way")
    assert any(f.status == doctor.PROBLEM and "logs" in f.what for f in doctor.check_room())
