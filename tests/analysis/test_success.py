"""Success beside the return, and instead of it."""

import re

import numpy as np
import pandas as pd
import pytest
import tyro
from sweeps import SCALE, main, row, run, write_run

import analyze
import evaluate
import ppo_continuous_noisy as ppo
from analysis.folders import SUCCESS
from analysis.robustness import read_robustness
from analysis.runs import finished, read_runs
from analysis.studies import make_studies

ENV = "FetchReach-v4"
PUSH, OTHER = "RandomNormalNoisyAction(0.3)", "RandomNormalNoisyObservation(0.1)"


def write_success(root, rates, env=ENV, **config):
    """Write runs with these final rates of success, one for each seed; their returns are equal."""
    for seed, rate in enumerate(rates, start=1):
        folder = write_run(root, [-50.0, -50.0], env=env, seed=seed, **config)
        path = folder / "eval.csv"
        lines = path.read_text().splitlines()
        for i, line in enumerate(lines[1:], start=1):  # two tests of two episodes
            lines[i] = f"{line},{int(i > 2 and 2 * rate >= i - 2)}"
        path.write_text("\n".join([f"{lines[0]},success", *lines[1:]]) + "\n")


@pytest.fixture
def runs_dir(tmp_path):
    """Five runs that solve half of their episodes, and five with noise that solve more."""
    write_success(tmp_path / "runs", [0.5, 0.5, 0.5, 0.5, 0.5])
    write_success(tmp_path / "runs", [0.5, 1, 1, 1, 1], noise=SCALE, rate=1.0)
    return tmp_path / "runs"


def test_the_verdict_is_in_percentage_points(runs_dir, capsys):
    out = runs_dir / "out"
    write_run(runs_dir, [-50.0, -50.0])  # Hopper
    analyze.main(analyze.Args(runs_dir, out, metric="success_rate"))
    said = capsys.readouterr().out
    found = rf"{ENV} with {re.escape(SCALE)} at rate 1.00 is better than no noise: \+40 \[.*\]"
    assert re.search(f"{found} percentage points of success, p = 0.048", said)
    assert not re.search(r"\(\+\d+ %", said)
    assert "Runs that count: 10. SAC: 10 runs of" in said
    assert "never tell success: 1 run on Hopper-v5\n" in said
    assert re.search(r"against no noise \(.* in percentage points\):\n", said)
    for name in ("best", "noises", "summary_SAC"):
        table = pd.read_csv(out / f"{name}.csv")
        assert len(table) and table.filter(regex="_percent$").isna().all(axis=None)
    assert "test success rate (%)" in next(out.glob("curves_*.svg")).read_text()


def test_success_is_beside_the_return(runs_dir):
    tables = run(runs_dir.parent)
    found = row(tables["success"], noise=SCALE)
    assert found[["mean", "baseline_mean", "difference", "n"]].tolist() == [90, 50, 40, 5]
    assert found["p"] == pytest.approx(12 / 252)  # all four of 100 % on one side


def test_evaluate_stores_success(tmp_path, capsys):
    """And analyze.py judges by what the scripts and evaluate.py have written."""
    env_id = "toy_envs:Success-v0"
    words = ["--env-id", env_id, "--runs-dir", str(tmp_path), "--no-compile"]
    words += ["--total-timesteps", "24", "--num-steps", "12", "--num-minibatches", "3"]
    assert ppo.train(tyro.cli(ppo.Args, args=words))
    [run_dir] = tmp_path.iterdir()
    evaluate.main(evaluate.Args((run_dir,), episodes=6))
    solved = pd.read_csv(run_dir / "robustness.csv")["success"].tolist()
    env, expected = ppo.make_env(env_id), []
    for episode in range(6):
        env.reset(seed=2_000_000 + episode)
        expected.append(int(env.unwrapped.solved))
    assert solved == expected and 0 < sum(solved) < 6
    assert f", {100 * sum(solved) / 6:.0f} % solved" in capsys.readouterr().out
    main(analyze.Args(tmp_path, metric="success_rate"))
    table = pd.read_csv(tmp_path / "results/robustness.csv")
    assert table["mean"].item() == pytest.approx(100 * np.mean(solved))


def test_a_run_that_tells_no_success_had_none(runs_dir):
    """Some environments tell a success only."""
    header = "noise,noise_rate,episode,episodic_return,episodic_length,success"
    for folder in runs_dir.glob(f"*{SCALE}*"):
        rows = [f",0.0,{i},-50.0,9,{int(i < 1)}" for i in range(5)]
        tests = {"robustness.csv": "\n".join([header, *rows, ""])}
        tests["eval.csv"] = (folder / "eval.csv").read_text()
        for name, text in tests.items():
            if int(folder.name[-1]) <= 2:
                text = "".join(line.rpartition(",")[0] + "\n" for line in text.splitlines())
            (folder / name).write_text(text)
    entries = read_runs(runs_dir)
    [study], [note] = make_studies(entries, SUCCESS)
    assert study.finals[max(study.finals)][:, 0].tolist() == [0, 0, 100, 100, 100]
    assert f"runs on {ENV} that never tell success, as others do, count as 0 %: 2" in note
    table, _ = read_robustness(finished(entries), SUCCESS)
    assert table.sort_values("seed")["mean"].tolist() == [0, 0, 20, 20, 20]


def test_robustness_is_judged_by_success(tmp_path, capsys):
    """In percentage points, never in percent of a rate, and only where the environment tells it."""
    root = tmp_path / "runs"
    write_success(root, [0.5] * 5)
    write_success(root, [0.5] * 5, noise=SCALE, rate=1.0)
    header = "noise,noise_rate,episode,episodic_return,episodic_length,success\n"
    for noise, solved in (("", 2), (SCALE, 4)):
        for folder in root.iterdir():
            if (SCALE in folder.name) == bool(noise):
                text = "".join(f",0.0,{i},-50.0,9,1\n" for i in range(5))
                seed = int(folder.name[-1])
                rows = [int(i < solved + (seed == 1)) for i in range(5)]
                text += "".join(f"{PUSH},1.0,{i},-50.0,9,{told}\n" for i, told in enumerate(rows))
                text += f"{OTHER},1.0,0,-50.0,9,\n"  # there the environment told nothing
                (folder / "robustness.csv").write_text(header + text)
    tables = run(tmp_path, metric="success_rate")
    said = capsys.readouterr().out
    assert "succeeds more often under noise over 1 of 1 test condition (+40 [" in said
    assert "] percentage points of success, p = 0.0079" in said
    assert "no test of robustness tells success in 1 test condition\n" in said
    scores = tables["robustness_score"]
    assert scores["difference"].tolist() == [40] and scores["conditions"].tolist() == [1]
    assert scores.filter(regex="percent$").isna().all(axis=None)
    assert tables["robustness"]["mean"].tolist() == [100, 44, 100, 84]
