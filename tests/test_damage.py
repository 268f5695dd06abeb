"""Damaged and hostile folders of runs: each kind, fed to everything that reads folders of runs."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import stub_run

import analyze
import evaluate
import noisy_wrappers
from analysis.choice import CHOICE_COLUMNS
from analysis.folders import DamageError, read_run
from sweep import choose
from sweep.__main__ import main as sweep
from sweep.options import parse_args

ROOT = Path(__file__).parents[1]
CHOOSE = ["choose", "--algos", "ppo", "--envs", "Pendulum-v1", "Pusher-v5", "--noise-rates", "1"]
CHOOSE += ["--noises", "RandomNormalNoisyReward(1)", "RandomDropoutObservation(0.9)", "--confirm"]
CHOOSE += ["5", "--budget", "2", "--total-timesteps", "4000"]


def config(**values):
    """Return a change of config.json: of its arguments, or of what stands beside them."""

    def damage(folder):
        content = json.loads((folder / "config.json").read_text())
        for name, value in values.items():
            (content if name in content else content["args"])[name] = value
        (folder / "config.json").write_text(json.dumps(content))

    return damage


def text(name, change):
    """Return a change of a file's text."""

    def damage(folder):
        (folder / name).write_text(change((folder / name).read_text()))

    return damage


A = "RandomNormalNoisyReward(1.0)"
DAMAGE = {  # and what is said of it
    "args that are no object": (config(args=["--seed", 1]), "config.json: "),
    "no versions": (config(versions=None), "config.json: "),
    "no defaults": (
        text("config.json", lambda text: text.replace("{", '{"defaults": 1, ', 1)),
        "defaults is no object",
    ),
    "a seed as text": (config(seed="1"), "'str' object"),
    "tests of no number": (config(eval_episodes=None), "'NoneType' object"),
    "arguments of other types": (config(env_kwargs=[1, "a:2"]), "config.json: TypeError: "),
    "a list as name": (config(exp_name=["a"]), "config.json: TypeError: "),
    "an escape sequence": (config(exp_name="\x1b[31m"), r"'\x1b[31m'"),
    "an unknown noise": (config(noise=["RandomX(1)"], noise_rate=[1.0]), "RandomX"),
    "a path as algorithm": (config(algorithm="x/../../ESCAPED"), "'x/../../ESCAPED'"),
    "an infinite result": (
        text("result.json", lambda text: re.sub(r'_mean": [^,}]*', '_mean": 1e999', text)),
        "final_return_mean is inf",
    ),
    "half a line": (text("eval.csv", lambda text: text[:-5]), "half-written"),
    "no text": (lambda folder: (folder / "eval.csv").write_bytes(b"\xff\n"), "eval.csv: "),
}


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A choice in two environments after its first batch: two noises in each."""
    folder = tmp_path_factory.mktemp("choice")
    args = parse_args("status", "/", [*CHOOSE, "--runs-dir", str(folder)])
    for found in choose.choices(args):
        for run in found.runs.values():
            stub_run.train(run.command)
    return folder


@pytest.fixture
def case(searched, tmp_path, monkeypatch):
    """The choice, a sweep with the same runs, and the run in each of them to be damaged."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(analyze, "figures", lambda *_: [])
    monkeypatch.setattr(evaluate, "load", lambda *_: nullcontext((gym.make("Pendulum-v1"), None)))
    monkeypatch.setattr(noisy_wrappers, "play", lambda *_: np.array([[1.0, 1, 0]]))
    choice = Path(shutil.copytree(searched, tmp_path / "choice"))
    runs = Path(shutil.copytree(searched / "search", tmp_path / "runs"))
    name = "p1.0_s1_NormalNoisyReward_1.0__Pendulum-v1__ppo_continuous_noisy"
    return SimpleNamespace(choice=choice, runs=runs, bad=[choice / "search" / name, runs / name])


def view(name, *words):
    """Return the exit status of a view of the sweep."""
    return sweep(name, "/", list(map(str, words)))


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named(name, case):
    damage, said = DAMAGE[name]
    damage(case.bad[0])
    with pytest.raises(DamageError) as error:
        read_run(case.bad[0])
    assert said in str(error.value)


# All programs read a run in one place, so one kind of damage is enough.
@pytest.mark.slow
def test_a_damaged_run_hides_no_other_anywhere(case, capsys):
    damage, said = DAMAGE["an infinite result"]
    for folder in case.bad:
        damage(folder)
    assert analyze.main(analyze.Args(case.runs, case.runs.parent / "out")) == 1
    assert "Runs that count: 3." in capsys.readouterr().out
    missing = (case.runs.parent / "out/missing.csv").read_text()
    assert case.bad[1].name in missing and said in missing

    words = [*CHOOSE, "--runs-dir", case.choice]
    assert view("list", *words) == 0
    out, err = capsys.readouterr()  # the choice in the other environment goes on
    assert out.count("\n") == 10 and str(case.bad[0]) not in out
    assert f"warning: {case.bad[0]}/" in err and said in err
    assert view("status", *words) == 1
    out = capsys.readouterr().out
    assert "14 runs: 3 done, 0 running, 1 failed, 10 to do" in out
    assert "Pusher-v5, confirmation" in out and re.search(f"damaged .*{re.escape(said)}", out)

    assert view("status", "--runs-dir", case.runs) == 1
    out = capsys.readouterr().out
    assert "4 runs: 3 done, 0 running, 1 failed, 0 to do" in out
    assert re.search(f"damaged .*{re.escape(str(case.bad[1]))}/.*{re.escape(said)}", out)
    assert evaluate.main(evaluate.Args((case.runs,), episodes=1)) == 1
    out, err = capsys.readouterr()
    assert err.startswith(f"error: {case.bad[1]}: ") and said in err and err.count("\n") == 1
    assert len(list(case.runs.glob("*/robustness.csv"))) == 3


def test_what_is_no_run_is_left_alone(case, capsys):
    """Nor is it called damaged, and nobody is advised to delete it."""
    for name in ("__MACOSX", "__pycache__", "pretrained", "org__model", "logs", "results"):
        (case.runs / name).mkdir()
        (case.runs / name / "config.json").write_text('{"architectures": ["Bert"]}')
    (case.runs / "ray__tune").mkdir()
    (case.runs / "ray__tune/result.json").write_text("{}\n{}\n")
    (case.runs / "link__to__nothing").symlink_to("nowhere")
    (case.runs / "starting__now").mkdir()
    (case.runs / "starting__now/.lock").touch()  # of a script that is importing PyTorch
    shutil.copytree(case.bad[1], case.runs / ".hidden__copy")
    assert analyze.main(analyze.Args(case.runs, case.runs.parent / "out")) == 0
    assert view("status", "--runs-dir", case.runs) == 0
    assert evaluate.main(evaluate.Args(tuple(case.runs.iterdir()), episodes=1)) == 0
    out, err = capsys.readouterr()
    assert "Runs that count: 4." in out and "5 runs: 4 done" in out
    assert "(1 unfinished, 2 missing)" in out and "unfinished runs are left out: 1" in out
    assert "delete" not in out + err and not err


def test_one_phase_of_a_choice_is_not_analysed_alone(case, capsys):
    """There fewer comparisons would be corrected for."""
    shutil.copytree(case.choice / "search", case.choice / "confirmation")
    with pytest.raises(SystemExit) as end:
        analyze.main(analyze.Args(case.choice / "confirmation"))
    assert end.value.code == 2
    assert f"all of it with --runs-dir {case.choice}\n" in capsys.readouterr().err


@pytest.mark.slow
def test_a_folder_that_cannot_be_entered_hides_no_run(case):
    """A process without root's rights must be told of it."""
    case.bad[1].chmod(0)
    words = [sys.executable, ROOT / "analyze.py", "--runs-dir", case.runs]
    if not os.geteuid():
        rights = "-dac_override,-dac_read_search"
        words = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", *words]
    shown = subprocess.run(words, capture_output=True, text=True)
    case.bad[1].chmod(0o755)
    assert shown.returncode == 1, shown.stderr
    assert "Runs that count: 3." in shown.stdout and "(1 corrupt" in shown.stdout
    missing = (case.runs / "results/missing.csv").read_text()
    assert case.bad[1].name in missing and "config.json: Permission denied" in missing


@pytest.mark.parametrize("lines", ["", ",".join(CHOICE_COLUMNS) + "\n,,,,,,A(1),x,1,1,yes\n"])
def test_a_damaged_choice_file_is_named(lines, case, capsys):
    (case.choice / "choice.csv").write_text(lines)
    with pytest.raises(SystemExit) as end:
        analyze.main(analyze.Args(case.choice))
    assert end.value.code == 2 and "error: choice.csv: " in capsys.readouterr().err
