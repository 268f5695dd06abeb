"""analyze.py on small synthetic sweeps: hand-computed tables, recorded oracles, simulations."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import analysis.effects
import analysis.figures
import analysis.formatting
import analysis.runs
import analysis.statistics
import analysis.style
import analysis.tables
import analyze
from noisy_wrappers import BASELINE, Configuration

RESULTS = Path(analyze.__file__).parent / "results"
NAN = float("nan")
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
ENDING = "RandomEarlyTermination(50)"


def write_run(
    root,
    curve,
    algorithm="SAC",
    env="Hopper-v5",
    noise=(),
    rate=(),
    seed=1,
    every=10_000,
    spread=1.0,
    folder=None,
    finished=True,
    versions=None,
    **args,
):
    """Write one run folder: `curve` is its mean return at each evaluation (two episodes each)."""
    noise, rate = ((noise,), (rate,)) if isinstance(noise, str) else (noise, rate)
    steps = every * np.arange(1, len(curve) + 1)
    name = f"{env}__{algorithm}__{'+'.join(map(str, noise + rate)) or 'baseline'}__{seed}"
    folder = Path(root) / (folder or name.replace("/", "-"))
    folder.mkdir(parents=True)
    settings = {
        "env_id": env,
        "exp_name": f"{algorithm.lower()}_continuous_noisy",
        "seed": seed,
        "noise": noise,
        "noise_rate": rate,
    }
    settings |= {"total_timesteps": int(steps[-1]), "eval_frequency": every, "eval_episodes": 2}
    settings |= {"runs_dir": str(root), "torch_threads": 1, "gamma": 0.99, **args}
    versions = versions or {"torch": "2.13.0", "mujoco": "3.15.0"}
    config = {"algorithm": algorithm, "args": settings, "versions": versions}
    config |= {"matmul_precision": "medium", "git_commit": None}
    (folder / "config.json").write_text(json.dumps(config))
    lines = [
        f"{step},{episode},{float(value) + sign * spread!r},1000\n"
        for step, value in zip(steps, curve, strict=True)
        for episode, sign in enumerate((-1, 1))
    ]
    (folder / "eval.csv").write_text(
        "step,episode,episodic_return,episodic_length\n" + "".join(lines)
    )
    if finished:
        (folder / "result.json").write_text(json.dumps({"final_return_mean": float(curve[-1])}))
    return folder


# Final returns of the sweep that the tables below are computed from by hand.
FINALS = {
    ("Hopper-v5", "", 0): [100, 110, 120, 130],  # mean 115, std 12.9099
    ("Hopper-v5", SCALE, 0.05): [130, 140, 150, 160],  # mean 145
    ("Hopper-v5", SCALE, 0.2): [90, 100, 115, 155],  # mean 115: matched
    ("Hopper-v5", ENDING, 0.05): [10, 20, 30, 40],  # mean 25
    ("Pusher-v5", "", 0): [-50, -40, -30, -40],  # mean -40, std 8.1650
    ("Pusher-v5", SCALE, 0.05): [-30, -20, -30, -20],  # mean -25
    ("Pusher-v5", SCALE, 0.2): [-60, -50, -60, -50],  # mean -55
    ("Pusher-v5", ENDING, 0.05): [-80, -80, -80, -80],
}


def small_sweep(root, order=1, **kwargs):
    """Write the runs of FINALS: five evaluations at 0.2, 0.4, ... 1.0 times the final return."""
    cells = [(key, seed) for key in FINALS for seed in range(4)][::order]
    for i, ((env, noise, rate), seed) in enumerate(cells):
        final = FINALS[env, noise, rate][seed]
        start = 0 if final > 0 else 2 * final
        curve = [start + (final - start) * part for part in (0.2, 0.4, 0.6, 0.8, 1)]
        folder = f"{order}-{i:03}" if order != 1 else None
        config = {"noise": noise, "rate": rate} if noise else {}
        write_run(root, curve, env=env, seed=seed + 1, folder=folder, **config, **kwargs)


def main(args, drawn=False):
    """Run analyze.py's main function, without figures: drawing takes longer than all the rest."""
    with nullcontext() if drawn else mock.patch.object(analyze, "figures", return_value=[]):
        analyze.main(args)


def run(tmp_path, runs="runs", out="results", compare=None, drawn=False):
    """Analyse and read the csv tables."""
    args = analyze.Args(runs_dir=tmp_path / runs, out=tmp_path / out, compare=compare, latex=True)
    main(args, drawn)
    empty = dict.fromkeys(("exp_name", "phase", "environment", "noise"), "")
    text = dict.fromkeys((*empty, "noise_rate", "test_rate"), str)
    files = sorted((tmp_path / out).glob("*.csv"))
    return {f.stem: pd.read_csv(f, dtype=text).fillna(empty) for f in files}


def row(table, **where):
    """The only row of a table with these values."""
    for name, value in where.items():
        table = table[table[name] == value]
    assert len(table) == 1, table
    return table.iloc[0]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep")
    small_sweep(path / "runs")
    return SimpleNamespace(path=path, tables=run(path, drawn=True))


# ------------------------------------------------------------------------ tables computed by hand


def test_summary_by_hand(sweep):
    table = sweep.tables["summary_SAC"]
    assert list(table.columns) == analysis.tables.COLUMNS["summary"]
    assert len(table) == len(FINALS)
    base = row(table, environment="Hopper-v5", noise="")
    assert (base["algorithm"], base["noise_rate"], base["n"], base["mean"]) == (
        "SAC",
        "0.00",
        4,
        115,
    )
    assert base["std"] == pytest.approx(np.sqrt((15**2 + 5**2 + 5**2 + 15**2) / 3))
    assert np.isnan(base["improvement_percent"])
    assert base["steps_to_baseline"] == 50_000
    best = row(table, environment="Hopper-v5", noise=SCALE, noise_rate="0.05")
    assert best["mean"] == 145 and best["n_baseline"] == 4 and best["baseline_mean"] == 115
    assert best["improvement_percent"] == pytest.approx(100 * 30 / 115)
    assert best["difference"] == 30
    # Only the actual division and that with the two 130s exchanged are so good
    assert best["p"] == pytest.approx(2 * 2 / 70)
    assert best["steps_to_baseline"] == 40_000  # 0.8 * 145 = 116 >= 115
    bad = row(table, environment="Pusher-v5", noise=SCALE, noise_rate="0.20")
    assert bad["improvement_percent"] == pytest.approx(100 * (-55 + 40) / 40)  # over |baseline|
    assert bad["std"] == pytest.approx(np.sqrt(4 * 25 / 3))
    assert np.isnan(bad["steps_to_baseline"])


def test_the_baseline_reaches_its_own_final_mean():
    """The mean of one test's returns and of a row of a table may round differently."""
    rising = np.arange(4)[:, None, None] * 1000
    curves = rising + np.random.default_rng(1).normal(0, 100, (4, 10, 100))
    for e in range(100):
        final_mean, _, _ = analysis.statistics.mean_std(curves[-1][:, e])
        assert (
            analysis.statistics.steps_to_reach(curves[..., e], [10, 20, 30, 40], final_mean) == 40
        )


def test_best_by_hand(sweep):
    table = sweep.tables["best"]
    assert list(table.columns) == analysis.tables.COLUMNS["best"]
    assert len(table) == 2
    pusher = row(table, environment="Pusher-v5")
    assert (pusher["noise"], pusher["noise_rate"]) == (SCALE, "0.05")
    assert (pusher["n_baseline"], pusher["n"], pusher["chosen_from"]) == (4, 4, 3)
    assert (pusher["baseline_mean"], pusher["noisy_mean"]) == (-40, -25)
    assert pusher["baseline_std"] == pytest.approx(np.sqrt(200 / 3))
    assert pusher["noisy_std"] == pytest.approx(np.sqrt(100 / 3))
    assert pusher["improvement_percent"] == pytest.approx(37.5)
    # -30 -20 -30 -20 against -50 -40 -30 -40: one of the three -30 is in the baseline, whichever
    assert pusher["difference"] == 15 and pusher["p"] == pytest.approx(2 * 3 / 70)
    # The others' are 2 / 70 (the noise that ends at -80) and 2 * 3 / 70 (as here, mirrored)
    assert pusher["p_adjusted"] == pytest.approx(2 * 3 / 70)


def test_consistent_by_hand(sweep):
    good, bad = sweep.tables["consistent"], sweep.tables["consistently_worse"]
    percents = [100 * 30 / 115, 37.5]
    best = row(good, noise=SCALE, noise_rate="0.05")
    assert len(good) == 1 and best["algorithm"] == "SAC"
    assert (best["percent_of_environments"], best["environments"], best["n"]) == (100, 2, 4)
    assert best["average_improvement_percent"] == pytest.approx(np.mean(percents))
    assert best["std_improvement_percent"] == pytest.approx(abs(np.diff(percents)[0]) / np.sqrt(2))
    worst = row(bad, noise=ENDING)  # SCALE at 0.2 matches Hopper's baseline: 50 %, in neither table
    assert len(bad) == 1 and worst["percent_of_environments"] == 0
    assert worst["average_improvement_percent"] == pytest.approx((-90 / 1.15 - 100) / 2)
    assert worst["fails_at_every_rate"] == "yes"
    together = row(sweep.tables["statistics"], scope="all", noise=ENDING)
    assert worst[["p", "p_adjusted"]].equals(together[["p", "p_adjusted"]])
    assert f"Worse at every rate that was tried: {ENDING} (SAC)" in read(
        sweep, "consistently_worse.md"
    )


def test_consistent_is_80_percent_or_more_best_first():
    shares = {
        "a": (80, 1),
        "b": (79.9, 9),
        "c": (100, 0.5),
        "d": (0.1, 9),
        "e": (80, 2),
        "f": (0, -9),
    }
    names = ("noise", "percent_of_environments", "average_improvement_percent")
    rows = [dict(zip(names, (noise, *v), strict=True)) for noise, v in shares.items()]
    study = {"algorithm": "SAC", "exp_name": "", "phase": ""}
    rows = [study | {"environments": 5} | row for row in rows]
    rows.append(rows[2] | {"noise": "in one environment only", "environments": 1})
    table = pd.DataFrame(rows, columns=analysis.tables.COLUMNS["consistency"])
    good, bad = analysis.tables.split_consistency(table)
    assert list(good["noise"]) == ["c", "e", "a"] and list(bad["noise"]) == ["f"]


def test_fails_at_every_rate_needs_every_rate(tmp_path):
    for seed, (noise, rate, final) in enumerate(
        [((), (), 10), (SCALE, 0.1, 5), (SCALE, 0.2, 20), (ENDING, 0.1, 5), (ENDING, 0.2, 9)]
    ):
        for env in ("Hopper-v5", "Walker2d-v5"):
            write_run(tmp_path / "runs", [final], env=env, noise=noise, rate=rate, seed=seed)
    table = run(tmp_path)["consistently_worse"]
    assert dict(zip(table["noise"], table["fails_at_every_rate"], strict=True)) == {
        SCALE: "no",
        ENDING: "yes",
    }


@pytest.mark.parametrize("same", [0.0, -7.3])
def test_an_environment_without_any_difference_makes_no_noise_consistent(same, tmp_path):
    for seed in range(1, 6):
        for env, final in (("Hopper-v5", 100 + seed), *((f"Equal{i}-v0", same) for i in range(4))):
            write_run(tmp_path / "runs", [final], env=env, seed=seed)
            noisy = final if env.startswith("Equal") else final - 60
            write_run(tmp_path / "runs", [noisy], env=env, noise=SCALE, rate=0.1, seed=seed)
    tables = run(tmp_path)
    assert tables["consistent"].empty and tables["consistently_worse"].empty  # one is left
    best = row(tables["best"], environment="Equal0-v0")
    assert best["difference"] == 0 and np.isnan(best["improvement_percent"])


def test_early_performance_by_hand(sweep):
    table = sweep.tables["early_performance"]
    assert list(table.columns) == analysis.tables.COLUMNS["early_performance"]
    assert set(table["steps_millions"]) == {0.01, 0.02, 0.03, 0.04, 0.05}  # fifths of a short run
    where = {"environment": "Pusher-v5", "noise": SCALE, "steps_millions": 0.03}
    assert set(table[(table[list(where)] == pd.Series(where)).all(axis=1)]["noise_rate"]) == {
        "0.00",
        "0.05",
        "0.20",
    }
    early = row(table, noise_rate="0.05", **where)  # 2 final (1 - 0.6) + 0.6 final = 1.4 final
    assert early["mean"] == pytest.approx(-25 * 1.4) and early["n"] == 4
    assert early["std"] == pytest.approx(1.4 * np.sqrt(100 / 3))
    base = row(table, noise_rate="0.00", **where)
    assert base["mean"] == pytest.approx(-40 * 1.4)


def test_early_performance_of_long_runs_is_every_200_000_steps(tmp_path):
    write_run(tmp_path / "runs", range(24), every=50_000)
    write_run(tmp_path / "runs", range(24), every=50_000, noise=SCALE, rate=0.5)
    table = run(tmp_path)["early_performance"].query("noise_rate == '0.50'")
    assert list(table["steps_millions"]) == [0.2, 0.4, 0.6, 0.8, 1.0, 1.2]
    assert list(table["mean"]) == [3, 7, 11, 15, 19, 23]
    assert table["std"].isna().all()  # one seed has no standard deviation


def test_early_performance_needs_a_run_with_noise(tmp_path):
    for env in ("Hopper-v5", "Pusher-v5"):
        write_run(tmp_path / "runs", range(5), env=env)
    write_run(tmp_path / "runs", range(5), env="Pusher-v5", noise=SCALE, rate=0.5)
    table = run(tmp_path)["early_performance"]
    assert set(table["environment"]) == {"Pusher-v5"} and len(table) == 10


def test_statistics_by_hand(sweep):
    table = sweep.tables["statistics"]
    assert list(table.columns) == analysis.tables.COLUMNS["statistics"]
    base = row(table, environment="Hopper-v5", noise="")
    assert (base["n"], base["iqm"]) == (4, 115) and np.isnan(base["p"])  # IQM: mean of 110 and 120
    even = row(table, environment="Hopper-v5", noise=SCALE, noise_rate="0.20")
    assert even["iqm"] == 107.5 and (even["n"], even["n_baseline"], even["environments"]) == (
        4,
        4,
        1,
    )
    assert even["iqm_change_percent"] == pytest.approx(100 * (107.5 - 115) / 115)
    assert even["difference"] == even["difference_percent"] == 0 == even["t"] and even["p"] == 1
    # 90 wins 0, 100 wins 0.5, 115 wins 2, 155 wins 4 of 4: 6.5 of 16
    assert even["probability_of_improvement"] == pytest.approx(6.5 / 16)
    assert even["verdict"] == "no clear difference"
    worst = row(table, environment="Hopper-v5", noise=ENDING)
    assert worst["probability_of_improvement"] == 0 and worst["probability_low"] == 0
    assert (
        0 < worst["probability_high"] < 0.5
    )  # certain about the order of four, not about the rest
    assert worst["verdict"] == "perhaps worse" and worst["comparisons"] == 3
    assert worst["difference"] == 25 - 115 and np.isnan(worst["difference_low"])  # four seeds
    spread = np.sqrt(500 / 3)  # of both
    assert worst["pooled_std"] == pytest.approx(spread)
    assert worst["effect_size"] == pytest.approx(-90 / spread)
    assert worst["t"] == pytest.approx(-90 / (spread / np.sqrt(2)))
    assert worst["p"] == pytest.approx(2 / 70) == worst["smallest_p"]  # C(8, 4) = 70
    # Hopper's family of three: 2/70 (ENDING), 4/70 and 1
    assert worst["p_adjusted"] == pytest.approx(3 * 2 / 70) == worst["smallest_p_adjusted"]
    both = row(table, scope="all", noise=ENDING)
    assert both["environments"] == 2 and both["n"] == 4
    assert np.isnan(both["iqm"]) and np.isnan(both["difference"])
    assert both["effect_size"] == pytest.approx(np.mean([-90 / spread, -40 / np.sqrt(100 / 3)]))
    assert both["difference_percent"] == pytest.approx(np.mean([-90 / 1.15, -100]))
    scores = [100 * (r - 115) / 115 for r in (10, 20, 30, 40)] + [-100] * 4
    assert both["iqm_change_percent"] == pytest.approx(np.mean(sorted(scores)[2:6]))
    assert both["p"] == pytest.approx(2 / 70**2) == both["smallest_p"]


def test_names_of_environments_say_nothing_about_a_row(tmp_path):
    """They may begin with "all", and no environment is left out of the aggregate."""
    for env in ("allegro-v0", "allegro_gym:Hand-v0", "PusherHard-v0"):
        for seed in range(3):
            write_run(tmp_path / "runs", [100 + seed], env=env, seed=seed)
            write_run(tmp_path / "runs", [130 + seed], env=env, seed=seed, noise=SCALE, rate=0.1)
    table = run(tmp_path)["statistics"]
    table = table[table["p"].notna()]
    assert list(zip(table["scope"], table["environment"], strict=True)) == [
        ("environment", "PusherHard-v0"),
        ("environment", "allegro-v0"),
        ("environment", "allegro_gym:Hand-v0"),
        ("all", ""),
    ]
    assert table["environments"].tolist() == [1, 1, 1, 3]
    assert set(table["verdict"]) == {"no clear difference", "better"}  # better: all together
    printed = (tmp_path / "results/report.html").read_text()
    assert f"SAC on 3 environments together with {SCALE}" in printed
    assert f"SAC on allegro_gym:Hand-v0 with {SCALE}" in printed


def test_an_unfinished_run_renames_no_other(tmp_path):
    for seed in range(3):
        write_run(tmp_path / "runs", [100 + seed], seed=seed)
        write_run(tmp_path / "runs", [130 + seed], seed=seed, noise=SCALE, rate=0.1)
    write_run(tmp_path / "runs", [1], env="Hopper-v9", finished=False)
    write_run(tmp_path / "runs", [1], gamma=0.5, finished=False, folder="other__1")
    tables = run(tmp_path)
    assert set(tables["statistics"]["phase"]) == {""}
    assert f"SAC on Hopper-v5 with {SCALE}" in (tmp_path / "results/report.html").read_text()
    assert list(tables["missing"]["status"]).count("unfinished") == 2


def test_several_noises_are_one_configuration(tmp_path):
    write_run(tmp_path / "runs", [10])
    write_run(tmp_path / "runs", [20], noise=(ENDING, SCALE), rate=(0.05, 0.125))
    best = run(tmp_path)["best"].iloc[0]
    assert best["noise"] == f"{ENDING} + {SCALE}" and best["noise_rate"] == "0.05 + 0.125"


def test_seeds_are_replicates_and_episodes_are_not(tmp_path):
    for seed, final in enumerate([1, 2, 4]):
        write_run(tmp_path / "runs", [final], seed=seed, spread=1000)
    base = run(tmp_path)["summary_SAC"].iloc[0]
    assert base["n"] == 3 and base["std"] == pytest.approx(np.std([1, 2, 4], ddof=1))


def test_papers_sign_convention_and_data():
    paper = RESULTS / "paper"
    best = pd.read_csv(paper / "best.csv")
    ours = 100 * (best["noisy_mean"] - best["baseline_mean"]) / best["baseline_mean"].abs()
    np.testing.assert_allclose(
        ours, best["improvement_percent"], atol=0.35
    )  # means have one decimal
    assert len(best) == 15 and {"noise", "noise_as_run"} <= set(best)
    for name, ours in (("consistent", "consistency"), ("consistently_worse", "consistency")):
        columns = set(pd.read_csv(paper / f"{name}.csv")) - {"noise_as_run"}
        assert columns <= set(analysis.tables.COLUMNS[ours])
    columns = set(pd.read_csv(paper / "early_performance_sac.csv")) - {"noise_as_run"}
    assert columns <= set(analysis.tables.COLUMNS["early_performance"])
    assert set(best) - {"noise_as_run"} <= set(analysis.tables.COLUMNS["best"])


# ------------------------------------------------------------------------------------- statistics

# Inputs (5 x 3, 5 x 3 and 7 x 3) and outputs recorded from rliable 1.2.0.
X = [[100, 109, 91.8], [73.3, 86.4, 70.3], [101.8, 140.2, 85.2], [81.4, 114.7, 110.7]]
X = np.array([*X, [103.2, 72.1, 99.1]])
Y = [[101.8, 49.7, 76.3], [33, 51.3, 91.8], [82.9, 52, 98.1], [94.7, 84.4, 14.5]]
Y = np.array([*Y, [73.8, 88.5, 93.4]])
Z = [[44.1, 75.7, 60.6], [65.7, 121.8, 65.8], [89, 116.5, 72.5], [86.6, 93.3, 91.9]]
Z = np.array([*Z, [53.2, 92.3, 130.8], [43.6, 115.8, 93.6], [70.8, 150, 112.9]])


def test_iqm_is_rliables():
    recorded = [(X, 95.32222222222222), (Y, 77.15555555555555), (Z, 85.85454545454544)]
    for scores, iqm in [*recorded, (Z[:, :1], 64.08)]:
        assert analysis.statistics.iqm(scores.ravel()) == pytest.approx(iqm, rel=1e-12)
        assert analysis.statistics.bootstrap_iqm(scores)[0] == pytest.approx(iqm, rel=1e-12)


def test_probability_of_improvement_is_rliables():
    recorded = [(X, Y, 0.72), (Y, X, 0.28), (X, Z, 0.5904761904761905), (X, X, 0.5)]
    for x, y, probability in [*recorded, (X[:, :1], Z[:, :1], 0.8857142857142857)]:
        p, low, high = analysis.statistics.probability_of_improvement(x, y)
        assert p == pytest.approx(probability, rel=1e-12)
        assert 0 <= low < p < high <= 1


def test_a_missing_run_is_not_a_score():
    padded = np.vstack([X, np.full((1, 3), NAN)])
    assert analysis.statistics.bootstrap_iqm(padded, Y) == analysis.statistics.bootstrap_iqm(X, Y)
    assert analysis.statistics.probability_of_improvement(
        padded, Y
    ) == analysis.statistics.probability_of_improvement(X, Y)
    assert analysis.statistics.compare(padded, Y) == pytest.approx(
        analysis.statistics.compare(X, Y), nan_ok=True
    )


@pytest.mark.parametrize(("shift", "envs"), [(0, 1), (1.5, 1), (2.5, 1), (0, 5), (1.5, 5)])
def test_coverage_of_the_probability_of_improvement(shift, envs):
    rng = np.random.default_rng(1)
    truth, inside, trials = stats.norm.cdf(shift / np.sqrt(2)), 0, 400
    for _ in range(trials):
        x, y = rng.normal(shift, 1, (5, envs)), rng.normal(0, 1, (5, envs))
        _, low, high = analysis.statistics.probability_of_improvement(x, y)
        inside += low - 1e-12 <= truth <= high + 1e-12
    assert inside / trials >= 0.9


def test_benjamini_hochberg_by_hand_and_its_limit():
    rows = [{"p": p} for p in (0.01, 0.04, 0.03, 0.2, NAN)]
    table = pd.DataFrame(rows, columns=analysis.tables.COLUMNS["statistics"])
    table[["algorithm", "scope", "environment"]] = "SAC", "environment", "Hopper-v5"
    table["smallest_p"], table["n_baseline"], table["t"] = 0.01, 5, 1.0
    table = analysis.tables.adjust(table)
    expected = [0.04, 0.04 * 4 / 3, 0.04 * 4 / 3, 0.2]
    np.testing.assert_allclose(table["p_adjusted"][:4].astype(float), expected)
    assert np.isnan(table["p_adjusted"][4])
    assert (table["smallest_p_adjusted"][:4] == 0.04).all()


def test_five_against_five_cannot_reach_significance_alone_among_90(tmp_path):
    rng = np.random.default_rng(0)
    noisy = [Configuration((f"N({i})",), ((0.05, 0.05),)) for i in range(90)]
    returns = {config: rng.normal(0, 1, (1, 5, 1)) for config in noisy}
    returns = {BASELINE: rng.normal(1000, 1, (1, 5, 1))} | returns  # all lose every pair
    study = analysis.runs.Study(
        "SAC", "", "", ["Hopper-v5"], [1, 2, 3, 4, 5], np.array([1]), returns
    )
    table = analysis.tables.judge([study])
    assert table["p"].iloc[1] == pytest.approx(2 / 252)
    assert table["smallest_p_adjusted"].iloc[1] == pytest.approx(90 * 2 / 252)
    (note,) = analysis.tables.family_notes(table)
    assert note == (
        "SAC, Hopper-v5: with 5 seeds and 90 comparisons no difference alone can be significant "
        "after the correction (smallest possible p: 0.0079, corrected 0.71)."
    )


def test_two_seeds_have_no_interval(tmp_path):
    for seed in (1, 2):
        write_run(tmp_path / "runs", [10 + seed], seed=seed)
        write_run(tmp_path / "runs", [20 + seed], seed=seed, noise=SCALE, rate=0.5)
    table = run(tmp_path)["statistics"]
    assert list(table["n"]) == [2, 2] and table["iqm"].notna().all()
    intervals = table.filter(regex="_(low|high)$")
    assert intervals.shape[1] == 8 and intervals.isna().all(axis=None)
    assert table["verdict"].iloc[1] == "no clear difference"
    assert table["smallest_p"].iloc[1] == pytest.approx(1 / 3)


# ---------------------------------------------------------------------- which runs count, and where


def read(sweep, name):
    return (sweep.path / "results" / name).read_text()


@pytest.mark.slow
def test_shuffling_the_run_folders_changes_nothing(sweep, tmp_path):
    small_sweep(tmp_path / "runs", order=-1)
    run(tmp_path, drawn=True)
    for path in sorted((sweep.path / "results").glob("*")):
        assert path.read_bytes() == (tmp_path / "results" / path.name).read_bytes(), path.name


@pytest.mark.slow
def test_a_second_analysis_gives_the_same_bytes(sweep):
    command = [sys.executable, analyze.__file__, "--runs-dir", "runs", "--out", "again", "--latex"]
    env = os.environ | {"PYTHONHASHSEED": "7"}
    done = subprocess.run(
        command, cwd=sweep.path, env=env, capture_output=True, text=True, check=True
    )
    assert "HalfCheetah" not in done.stdout and "RandomUniformScaleReward(0.5, 1.5)" in done.stdout
    first, second = sweep.path / "results", sweep.path / "again"
    names = sorted(path.name for path in first.iterdir())
    assert names == sorted(path.name for path in second.iterdir())
    kinds = {Path(name).suffix for name in names}
    assert kinds == {".csv", ".md", ".tex", ".svg", ".pdf", ".html"}
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


CORRUPTIONS = {
    "half a line": lambda text: text[:-9],
    "no newline at the end": lambda text: text[:-1],
    "a short line": lambda text: text.replace(",1000\n", "\n", 1),
    "a word": lambda text: text.replace(",1000\n", ",many\n", 1),
    "nan": lambda text: re.sub(r"(?m)^(10000,0,)[^,]*", r"\1nan", text),
    "a missing episode": lambda text: re.sub(r"(?m)^20000,1,.*\n", "", text),
    "one episode twice": lambda text: text.replace("\n20000,1,", "\n20000,0,"),
    "a missing evaluation at the end": lambda text: re.sub(r"(?m)^50000,.*\n", "", text),
    "an evaluation twice": lambda text: text + "".join(text.splitlines(keepends=True)[-2:]),
    "steps out of order": lambda text: text.replace("\n30000,", "\n10000,"),
    "another final return": lambda text: re.sub(r"(?m)^(50000,1,)[^,]*", r"\g<1>7.5", text),
    "no header": lambda text: text.split("\n", 1)[1],
    "only a header": lambda text: text.split("\n", 1)[0] + "\n",
    "nothing": lambda text: "",
    "binary": lambda text: text.replace("1000", "\x00"),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corrupt_evaluations_are_reported_and_left_out(name, tmp_path):
    for seed in (1, 2, 3):
        folder = write_run(tmp_path, [10, 20, 30, 40, 50.0 + seed], seed=seed)
    text = (folder / "eval.csv").read_text()
    assert CORRUPTIONS[name](text) != text
    (folder / "eval.csv").write_text(CORRUPTIONS[name](text))
    runs = analysis.runs.read_runs(tmp_path)
    assert list(runs["status"]) == ["finished", "finished", "corrupt"]
    assert runs["reason"].iloc[2].count("\n") == 0 and len(runs["reason"].iloc[2]) > 10
    (study,), _ = analysis.runs.make_studies(runs)
    assert study.final(BASELINE).ravel().tolist() == [51, 52]
    assert analysis.runs.missing_runs(runs).empty  # it is there, only broken


@pytest.mark.parametrize("name", ["config.json", "result.json"])
@pytest.mark.parametrize("text", ["", "{", "[]", "null", "{}", None])
def test_corrupt_json_is_reported_and_left_out(name, text, tmp_path):
    write_run(tmp_path, [1.0], seed=1)
    folder = write_run(tmp_path, [2.0], seed=2)
    (folder / name).unlink() if text is None else (folder / name).write_text(text)
    runs = analysis.runs.read_runs(tmp_path)
    expected = "unfinished" if (name, text) == ("result.json", None) else "corrupt"
    assert list(runs["status"]) == ["finished", expected]


def test_unfinished_missing_and_duplicate_runs_are_listed(tmp_path, capsys):
    root = tmp_path / "runs"
    small_sweep(root)
    args = {"env": "Pusher-v5", "noise": SCALE, "rate": 0.05}
    shutil.rmtree(root / f"Pusher-v5__SAC__{SCALE}+0.05__2")
    shutil.rmtree(root / f"Pusher-v5__SAC__{SCALE}+0.05__3")
    write_run(root, [-1, -1, -1, -1, 1e6], seed=3, finished=False, **args)
    write_run(root, [-1, -1, -1, -1, 1e6], seed=4, folder="copy", **args)
    (root / "Pusher-v5__empty").mkdir()  # no run
    (root / "logs").mkdir()
    (root / "a file").write_text("")
    tables = run(tmp_path)
    missing = tables["missing"].set_index("status")
    assert sorted(missing.index) == ["duplicate", "missing", "unfinished"]
    assert missing.loc["missing", "seeds"] == 2 and missing.loc["missing", "noise"] == SCALE
    assert missing.loc["unfinished", "seeds"] == 3
    assert missing.loc["unfinished", "reason"] == "no result.json"
    noisy = row(tables["summary_SAC"], environment="Pusher-v5", noise=SCALE, noise_rate="0.05")
    assert noisy["n"] == 2  # seeds 1 and 4
    printed = capsys.readouterr().out
    assert "WARNING: Runs left out: 3 (" in printed and "copy" in printed
    html = (tmp_path / "results/report.html").read_text()
    assert "Runs left out: 3 (" in html and "1 missing" in html


def test_runs_left_out_have_one_row_per_configuration(tmp_path):
    for seed in (1, 2, 3, 5, 6, 8):
        finished = seed in (1, 8)
        write_run(tmp_path, [10], seed=seed, finished=finished, noise=SCALE, rate=0.5)
    write_run(tmp_path, [10], seed=9, folder="damaged__1")
    write_run(tmp_path, [10], seed=9, folder="damaged__2")
    for name in ("damaged__1", "damaged__2"):
        (tmp_path / name / "config.json").write_text("{")
    table, number = analysis.runs.left_out(analysis.runs.read_runs(tmp_path))
    assert table[["status", "noise", "seeds"]].fillna("").to_numpy().tolist() == [
        ["unfinished", SCALE, "2-3, 5-6"],
        ["corrupt", "", ""],
        ["corrupt", "", ""],
        ["missing", "", "1-3, 5-6, 8"],  # the baseline
    ]
    assert number == {"unfinished": 4, "corrupt": 2, "missing": 6}
    assert list(table["run"])[1:3] == ["damaged__1", "damaged__2"]
    assert "3 more" in table["run"].iloc[0]


def test_more_seeds_for_the_baseline_or_for_one_noise_are_nothing_missing(tmp_path):
    for seed in range(1, 6):
        write_run(tmp_path, [10], seed=seed)
        if seed <= 3:
            write_run(tmp_path, [10], seed=seed, noise=SCALE, rate=0.5)
            write_run(tmp_path, [10], seed=seed, noise=SCALE, rate=0.2)
        write_run(tmp_path, [10], seed=seed, noise=ENDING, rate=0.5)
    assert analysis.runs.missing_runs(analysis.runs.read_runs(tmp_path)).empty
    write_run(tmp_path, [10], seed=4, noise=SCALE, rate=0.2)  # now two of three noises have it
    missing = analysis.runs.missing_runs(analysis.runs.read_runs(tmp_path))
    assert missing[["noise_rate", "seed"]].to_numpy().tolist() == [["0.50", 4]]


def test_only_the_older_versions_of_an_environment_are_labelled(tmp_path):
    for env in ("Hopper-v5", "Walker2d-v9", "Walker2d-v10", "Ant", "Ant-v4", f"Day-v{'9' * 20}"):
        write_run(tmp_path, [10], env=env)
    runs = analysis.runs.read_runs(tmp_path).set_index("environment")["phase"]
    assert runs["Walker2d-v9"] == "environments v9"
    assert runs["Ant"] == "environments without version"
    assert set(runs[["Hopper-v5", "Walker2d-v10", "Ant-v4"]]) == {""}
    for env in ("Grid-v0", "Maze-v0", "Maze-v1"):
        write_run(tmp_path, [10], env=env)
    runs = analysis.runs.read_runs(tmp_path).set_index("environment")["phase"]
    assert runs["Grid-v0"] == "" and runs["Maze-v0"] == "environments v0"


def test_a_noise_is_not_missing_where_nobody_tried_it(tmp_path):
    for seed in (1, 2):
        write_run(tmp_path, [10], env="Hopper-v5", seed=seed)
    write_run(tmp_path, [10], env="Hopper-v5", seed=1, noise=SCALE, rate=0.5)
    write_run(tmp_path, [10], env="Pusher-v5", seed=2, noise=ENDING, rate=0.1)
    missing = analysis.runs.missing_runs(analysis.runs.read_runs(tmp_path))
    assert missing[["environment", "noise", "seed"]].to_numpy().tolist() == [
        ["Hopper-v5", SCALE, 2],
        ["Pusher-v5", "", 1],
        ["Pusher-v5", "", 2],
        ["Pusher-v5", ENDING, 1],
    ]


def test_a_missing_baseline_is_said(tmp_path, capsys):
    write_run(tmp_path / "runs", [10], noise=SCALE, rate=0.5)
    tables = run(tmp_path)
    assert tables["best"].empty and tables["consistent"].empty
    assert tables["summary_SAC"]["improvement_percent"].isna().all()
    assert tables["missing"]["noise"].tolist() == [""]
    assert "no finished baseline on Hopper-v5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "study"),
    [
        ({"env": "Hopper-v4"}, ("SAC", "sac_continuous_noisy", "environments v4")),
        ({"exp_name": "other"}, ("SAC", "other", "")),
        ({"algorithm": "TD3"}, ("TD3", "td3_continuous_noisy", "")),
    ],
)
def test_studies_never_share_a_row(change, study, tmp_path):
    for seed in (1, 2):
        write_run(tmp_path / "runs", [10], seed=seed, folder=f"a{seed}")
        write_run(tmp_path / "runs", [99], seed=seed, folder=f"b{seed}", **change)
        write_run(tmp_path / "runs", [50], seed=seed, folder=f"c{seed}", noise=SCALE, rate=0.1)
    tables = run(tmp_path)
    summary = pd.concat([t for name, t in tables.items() if name.startswith("summary_")])
    assert list(summary["n"]) == [2, 2, 2] and sorted(summary["std"]) == [0, 0, 0]
    other = row(summary, **dict(zip(analysis.runs.STUDY, study, strict=True)))
    assert other["mean"] == 99 and np.isnan(other["improvement_percent"])
    noisy = row(summary, noise=SCALE)
    assert noisy["baseline_mean"] == 10
    assert tuple(noisy[analysis.runs.STUDY]) == ("SAC", "sac_continuous_noisy", "")
    assert "all" not in set(tables["statistics"]["scope"])


def test_paths_threads_and_evaluation_steps_do_not_split_rows(tmp_path, capsys):
    write_run(tmp_path / "runs", [1, 2, 3, 4], seed=1)
    write_run(tmp_path / "runs", [6, 8], seed=2, every=20_000, torch_threads=4, cuda=True)
    write_run(tmp_path / "runs", [1, 2, 3, 5], seed=3, runs_dir="x", versions={"mujoco": "3.14.0"})
    runs = analysis.runs.read_runs(tmp_path / "runs")
    (study,), notes = analysis.runs.make_studies(runs)
    notes += analysis.runs.version_notes(runs)
    apart = runs["environment"].where(runs["seed"] != 3, "Other-v0")  # in no row with the others
    assert analysis.runs.version_notes(runs.assign(environment=apart)) == []
    assert study.algorithm == "SAC" and study.steps.tolist() == [20_000, 40_000]
    assert study.returns[BASELINE][:, :, 0].tolist() == [[2, 6, 2], [4, 8, 5]]
    assert "cut to those that all share, 2 of up to 4" in notes[0]
    assert (
        "some rows average runs with different mujoco" in notes[1] and "3.14.0 (n = 1)" in notes[1]
    )
    run(tmp_path)
    printed = capsys.readouterr().out
    assert notes[0] in printed and notes[0] in (tmp_path / "results/report.html").read_text()


def test_changed_code_is_another_commit(tmp_path):
    commit = "0123456789abcdef0123456789abcdef01234567"
    for seed, changed in ((1, ""), (2, "-dirty")):
        write_run(tmp_path, [1], seed=seed, folder=f"a{seed}")
        path = tmp_path / f"a{seed}/config.json"
        config = json.loads(path.read_text()) | {"git_commit": commit + changed}
        path.write_text(json.dumps(config))
    [note] = analysis.runs.version_notes(analysis.runs.read_runs(tmp_path))
    assert (
        "some rows average runs of different code versions" in note
        and "0123456789-dirty (n = 1)" in note
    )


def test_what_an_earlier_analysis_left_is_said(tmp_path, capsys):
    write_run(tmp_path / "runs", [1])
    run(tmp_path)
    assert "did not write" not in capsys.readouterr().out
    for name in ("summary_TD3.csv", "curves_TD3_no_noise.svg", "README.md"):
        (tmp_path / "results" / name).touch()
    main(analyze.Args(runs_dir=tmp_path / "runs", out=tmp_path / "results"))
    # run() has written LaTeX, too, and this analysis has not
    [left] = re.findall("files that this analysis did not write: (.*)\n", capsys.readouterr().out)
    assert {"curves_TD3_no_noise.svg", "summary_TD3.csv", "best.tex"} <= set(left.split(", "))
    assert not {"README.md", "best.csv", "best.md"} & set(left.split(", "))


# ------------------------------------------------------------------------------ comparing, drawing


def test_baselines_alone_stand_beside_the_papers(tmp_path):
    write_run(tmp_path / "runs", [10])
    tables = run(tmp_path, compare=RESULTS / "paper")
    base = row(tables["compare_best"], algorithm="SAC", environment="Hopper-v5", noise="")
    assert base["mean"] == 10 and base["paper_mean"] == 2928
    assert len(tables["compare_consistent"]) == 29


def test_compare_sets_the_paper_beside_ours(tmp_path):
    rng = np.random.default_rng(0)
    mixup = "RandomMixupObservation(0.5, recursive=True)"
    for seed in range(5):
        for config in ({}, {"noise": mixup, "rate": 0.05}, {"noise": SCALE, "rate": 0.05}):
            curve = 3000 + 500 * rng.normal(size=100)
            write_run(tmp_path / "runs", curve, env="Hopper-v5", seed=seed, **config)
    tables = run(tmp_path, compare=RESULTS / "paper")
    summary, table = tables["summary_SAC"], tables["compare_best"]
    ours = row(summary, noise=mixup)
    both = row(table, environment="Hopper-v5", noise=mixup)
    assert both["n"] == 5 and both["mean"] == pytest.approx(ours["mean"])
    assert both["paper_mean"] == 3597.2 and both["paper_std"] == 164.6
    error = np.sqrt(ours["std"] ** 2 / 5 + 164.6**2 / 5)
    assert both["difference_se"] == pytest.approx((ours["mean"] - 3597.2) / error)
    base = row(table, environment="Hopper-v5", noise="")
    assert base["paper_mean"] == 2928
    assert table[table["noise"] == SCALE].query("algorithm == 'SAC'")["paper_mean"].notna().all()
    other = row(table, algorithm="PPO", environment="Walker2d-v2", noise_rate="0.05")
    assert np.isnan(other["mean"]) and other["paper_mean"] == 3424.6
    early = tables["compare_early_performance"]
    half = row(early, environment="Hopper-v5", noise_rate="0.05", steps_millions=0.4)
    assert half["paper_mean"] == 2863 and half["n"] == 5 and np.isfinite(half["difference_se"])
    assert len(early) == 75  # the paper's rows
    assert len(tables["compare_consistent"]) == 29
    assert "v2" in (tmp_path / "results/compare_best.md").read_text()


@pytest.mark.slow
def test_a_difference_needs_equal_steps(tmp_path):
    """Short runs and runs of v4 stand beside the paper's; short ones are not scored."""
    for seed in range(3):
        for config in ({}, {"noise": SCALE, "rate": 0.05}):
            more = {"seed": seed, "every": 200_000, **config}
            final = 9 + seed if config else 10 + seed  # worse on v5
            for env in ("Hopper", "HalfCheetah"):
                write_run(tmp_path / "runs", 5 * [final], env=f"{env}-v5", **more)
                write_run(tmp_path / "runs", 5 * [12 + seed], env=f"{env}-v4", **more)
            write_run(tmp_path / "runs", [final], env="Walker2d-v5", exp_name="short", **more)
    tables = run(tmp_path, compare=RESULTS / "paper")
    best = tables["compare_best"].set_index(["exp_name", "environment", "noise"]).sort_index()
    whole = "sac_continuous_noisy"
    assert np.isfinite(best.loc[(whole, "Hopper-v5", ""), "difference_se"])
    assert best.loc[("short", "Walker2d-v5", ""), "mean"] == 11
    assert np.isnan(best.loc[("short", "Walker2d-v5", ""), "difference_se"])
    early = tables["compare_early_performance"]
    early = early[(early["exp_name"] == "short") & (early["steps_millions"] == 0.2)]
    assert len(early) == 2 and early["difference_se"].notna().all()
    table = tables["compare_consistent"]  # the paper lists this noise: SAC, 100 %
    table = table[(table["noise"] == SCALE) & (table["noise_rate"] == "0.05")]
    changes = table.set_index(["exp_name", "phase"])["average_improvement_percent"]
    assert changes[whole, ""] < 0 == changes[whole, "environments v4"]


def drawn_of(runs_dir):
    """Return {name: Drawing} of the figures of a folder of runs."""
    studies, _ = analysis.runs.make_studies(analysis.runs.read_runs(runs_dir))
    drawn = analysis.figures.figures(studies, analysis.tables.make_tables(studies))
    return {drawing.name: drawing for drawing in drawn}


def test_effects_have_in_every_environment_the_rows_that_were_tried_there(tmp_path):
    """A filled mark in the colour of a clear verdict, a hollow grey one for the others."""
    for seed in range(1, 6):
        write_run(tmp_path, [100 + seed], env="Ant-v5", seed=seed)  # no noise, no panel
        for env, noise, factor in (("Hopper-v5", SCALE, 1.5), ("Walker2d-v5", ENDING, 0.5)):
            write_run(tmp_path, [100 + seed], env=env, seed=seed)
            write_run(tmp_path, [factor * (100 + seed)], env=env, seed=seed, noise=noise, rate=0.1)
            write_run(tmp_path, [100 + seed], env=env, seed=seed, noise=noise, rate=0.2)
    drawing = drawn_of(tmp_path)["effects_SAC"]
    figure, caption = drawing.draw(), drawing.caption
    assert [ax.get_title() for ax in figure.axes] == ["Hopper-v5", "Walker2d-v5"]
    labels = [[text.get_text() for text in ax.get_yticklabels()] for ax in figure.axes]
    tried = [SCALE.replace("(", "\n("), ENDING]
    assert labels == [[f"{noise}, {rate}" for rate in ("0.10", "0.20")] for noise in tried]
    assert "Filled marks are clear verdicts." in caption
    looks = [
        {
            line.get_ydata()[0]: line.get_markerfacecolor()
            for line in ax.lines
            if line.get_marker() == "o"
        }
        for ax in figure.axes
    ]
    better, worse = analysis.style.BETTER, analysis.style.WORSE
    assert looks == [{0: better, 1: "white"}, {0: worse, 1: "white"}]
    assert [text.get_text() for text in figure.axes[0].texts] == ["5", "5", "n"]


def test_an_infinite_effect_has_the_strongest_colour():
    ax, grid = analysis.effects.Figure().subplots(), pd.DataFrame([[np.inf, 1.0], [NAN, -2.0]])
    dots = grid.isna() & False
    image = analysis.effects.heatmap(ax, grid, 2.0, "{:+.1f}".format, dots, 6)
    shown = image.get_array()
    assert shown.tolist() == [[2.0, 1.0], [None, -2.0]]
    assert [text.get_text() for text in ax.texts] == ["+inf", "+1.0", "-2.0"]


def test_the_id_of_an_environment_fits_above_its_panel():
    ax = analysis.effects.Figure(figsize=(3, 3)).subplots()
    analysis.style.set_title(ax, "my_company_robotics.envs:WarehousePickAndPlaceDense-v12", 3)
    assert ax.get_title() == "WarehousePickAndPlaceDense-v12" and ax.title.get_fontsize() == 9
    analysis.style.set_title(ax, "A" * 60, 3)
    assert ax.title.get_fontsize() < 9


def test_effects_of_many_configurations_are_a_heatmap(tmp_path):
    rates = [0.01 * i for i in range(1, analysis.effects.MOST_IN_FOREST + 2)]
    for seed in range(1, 8):
        write_run(tmp_path, [100], seed=seed)
        for i, rate in enumerate(rates):
            effect = {0: 30 + seed, 1: -30 - seed}.get(i, 0)
            write_run(tmp_path, [100 + effect], seed=seed, noise=SCALE, rate=rate)
    drawing = drawn_of(tmp_path)["effects_SAC"]
    figure, caption = drawing.draw(), drawing.caption
    [image] = figure.axes[0].images
    assert image.get_array().shape == (1, len(rates)) and image.get_clim() == (-34, 34)
    assert image.cmap(0.5)[:3] == pytest.approx((1, 1, 1), abs=0.01)  # white at zero
    assert "end at \u00b1 34 %" in caption
    dots = [line.get_xdata()[0] for line in figure.axes[0].lines]
    assert [round(x - 0.36) for x in dots] == [0, 1]  # better, worse


def test_odd_sweeps_are_analysed_too(tmp_path):
    """A label longer than a file name may be, and no formula."""
    name = r"$\frac$" + 30 * "a_long_name_"
    write_run(tmp_path / "runs", [1.0], folder="b", exp_name=name)
    write_run(tmp_path / "runs", [1.0], folder="c", noise=SCALE, rate=0.1, exp_name=name)
    write_run(tmp_path / "runs", [1.0], folder="d")
    write_run(tmp_path / "runs", [1.0], folder="e", noise=SCALE, rate=0.1)
    run(tmp_path, drawn=True)
    assert len(list((tmp_path / "results").glob("curves_*.svg"))) == 2


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """Three environments: returns without noise of 100, of exactly 0, and of nearly 0."""
    path = tmp_path_factory.mktemp("sparse")
    finals = {"Hopper-v5": (100, 120, 90), "Maze-v0": (0, 0, -1), "Car-v0": (1e-6, -20, 1e-6)}
    for env, (baseline, better, worse) in finals.items():
        for seed in range(1, 6):
            spread = {"Hopper-v5": seed, "Maze-v0": 0, "Car-v0": 1e-6 * (seed - 4)}[env]
            config = {"env": env, "seed": seed}
            write_run(path / "runs", [baseline + spread], **config)
            write_run(path / "runs", [better + seed / 10], noise=SCALE, rate=0.1, **config)
            write_run(path / "runs", [worse - seed / 10], noise=ENDING, rate=0.1, **config)
    return SimpleNamespace(path=path, tables=run(path, drawn=True))


def test_an_environment_whose_baseline_is_zero_is_in_every_table(sparse):
    best = sparse.tables["best"].set_index("environment")
    assert best["noise"].to_dict() == {"Hopper-v5": SCALE, "Maze-v0": SCALE, "Car-v0": ENDING}
    assert best["difference"].round(2).to_dict() == {
        "Hopper-v5": 17.3,
        "Maze-v0": 0.3,
        "Car-v0": -0.3,
    }
    assert best["improvement_percent"].notna().to_dict() == {
        "Hopper-v5": True,
        "Maze-v0": False,
        "Car-v0": False,
    }
    assert best["p_luck"].notna().all()
    [bad] = sparse.tables["consistently_worse"].to_dict("records")
    assert (bad["noise"], bad["environments"], bad["percent_of_environments"]) == (ENDING, 3, 0)
    assert bad["without_percent"] == "Car-v0, Maze-v0"
    assert bad["average_improvement_percent"] == pytest.approx(100 * (89.7 / 103 - 1))
    assert sparse.tables["consistent"].empty  # worse in one of three
    statistics = sparse.tables["statistics"]
    every = row(statistics, scope="all", noise=ENDING)
    assert every["environments"] == 3 and np.isnan(every["difference_percent"])
    assert every["verdict"] == "worse" and every["effect_size"] < -1
    zero = row(statistics, environment="Maze-v0", noise=ENDING)
    assert zero["verdict"] == "worse" and zero["difference"] == pytest.approx(-1.3)
    assert np.isnan(zero["iqm_change_percent"]) and zero["probability_of_improvement"] == 0


def test_numbers_near_zero_are_readable_everywhere(sparse):
    """In text, Markdown, LaTeX, figures and the report: no percentage of nothing, no "0.0"."""
    out = sparse.path / "results"
    why = "No percentage on Car-v0 and Maze-v0: the mean return without noise is not clearly"
    assert why in (out / "best.md").read_text() and why in (out / "report.html").read_text()
    for name in ("best.md", "best.tex", "summary_SAC.md", "statistics.md", "statistics.tex"):
        text = (out / name).read_text()
        assert not re.search(r"[0-9]{6}", text.replace(",", "")), name
        assert "nan" not in text and "inf" not in text
    assert "-0.30 [-0.50, -0.10]" in (out / "best.md").read_text()  # Car-v0
    effects = drawn_of(sparse.path / "runs")["effects_SAC"].draw()
    assert [ax.get_title() for ax in effects.axes] == ["Car-v0", "Hopper-v5", "Maze-v0"]
    marks = [line.get_xdata()[0] for line in effects.axes[2].lines if line.get_marker() == "o"]
    assert marks == pytest.approx([-1.3, 0.3])


def test_figures_have_labels_units_and_n(sweep):
    studies, _ = analysis.runs.make_studies(analysis.runs.read_runs(sweep.path / "runs"))
    tables = analysis.tables.make_tables(studies)
    drawings = {drawing.name: drawing for drawing in analysis.figures.figures(studies, tables)}
    assert set(drawings) == {
        "effects_SAC",
        "best_curves_SAC",
        "curves_SAC_RandomEarlyTermination_50",
        "curves_SAC_RandomUniformScaleReward_0.5_1.5",
    }
    curves = drawings["curves_SAC_RandomUniformScaleReward_0.5_1.5"].draw()
    assert [text.get_text() for text in curves.legends[0].get_texts()] == [
        "no noise (n = 4)",
        "rate 0.05 (n = 4)",
        "rate 0.20 (n = 4)",
    ]
    hopper, pusher = curves.axes
    assert hopper.get_title() == "Hopper-v5" and hopper.get_xlabel() == "training steps (thousands)"
    assert "return" in hopper.get_ylabel()
    assert hopper.lines[1].get_ydata().tolist() == pytest.approx([29, 58, 87, 116, 145])
    assert len({(line.get_linestyle(), line.get_marker()) for line in hopper.lines}) == 3
    band = pusher.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() == pytest.approx(-40 * 1.8 - 1.8 * np.sqrt(200 / 3))  # one sample std

    [study] = studies  # an environment without this noise has no panel
    for config, returns in study.returns.items():
        returns[:, :, 0] = np.nan if config.noise == ENDING else 1.0
    fig = analysis.figures.curves_figure(study, ENDING)
    assert [ax.get_title() for ax in fig.axes] == ["Pusher-v5"]
    # nor has a rate that was not tried, or the baseline of a search, a line
    study.returns[Configuration.parse(SCALE, 0.05)][:, :, 0] = np.nan
    study.returns[BASELINE][:] = np.nan
    fig = analysis.figures.curves_figure(study, SCALE)
    legend = [text.get_text() for text in fig.legends[0].get_texts()]
    assert legend == ["rate 0.05 (n = 4)", "rate 0.20 (n = 4)"] and len(fig.axes) == 2
    fig.axes[0].set_ylim(-12_000, -11_000)
    fig.draw_without_rendering()
    assert fig.axes[0].yaxis.label.get_window_extent().x0 >= 0
    assert "black" not in {line.get_color() for line in fig.axes[0].lines}


def test_ablation_bars_stand_side_by_side(tmp_path):
    other = "RandomUniformScaleReward(0.8, 1.2)"
    for seed in (1, 2):
        write_run(tmp_path, [10 * seed], seed=seed)
        write_run(tmp_path, [20 * seed], seed=seed, noise=SCALE, rate=0.05)
        write_run(tmp_path, [30 * seed], seed=seed, noise=other, rate=0.05)
        write_run(tmp_path, [40 * seed], seed=seed, noise=other, rate=0.5)
    figure = drawn_of(tmp_path)["parameters_SAC_RandomUniformScaleReward"].draw()
    (ax,) = figure.axes
    heights = [bar.get_height() for bar in ax.patches]
    np.testing.assert_equal(heights, [15, 30, NAN, 45, 60])
    assert [text.get_text() for text in ax.get_xticklabels()] == ["none", "0.05", "0.50"]
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["no noise (n = 2)", f"{SCALE} (n = 2)", f"{other} (n = 2)"]


def test_ablation_bars_of_a_module_with_an_underscore_have_a_legend(tmp_path):
    noises = ["_mine:Foo(1)", "_mine:Foo(2)"]
    for noise, seed in product(noises, (1, 2)):
        write_run(tmp_path, [10 * seed], seed=seed, noise=noise, rate=0.5)
    figure = drawn_of(tmp_path)["parameters_SAC__mine_Foo"].draw()
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == [f"{noise} (n = 2)" for noise in noises]


def test_ablation_bars_of_a_search_show_no_baseline(tmp_path):
    other = "RandomUniformScaleReward(0.8, 1.2)"
    for noise, seed in product((SCALE, other), (1, 2)):
        write_run(tmp_path, [10 * seed], seed=seed, noise=noise, rate=0.5)
    drawing = drawn_of(tmp_path)["parameters_SAC_RandomUniformScaleReward"]
    figure = drawing.draw()
    (ax,) = figure.axes
    assert [text.get_text() for text in ax.get_xticklabels()] == ["0.50"] and len(ax.patches) == 2
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == [f"{SCALE} (n = 2)", f"{other} (n = 2)"] and "dotted" not in drawing.caption


def test_markdown_and_latex_tables(sweep):
    markdown, latex = read(sweep, "best.md"), read(sweep, "best.tex")
    assert "115 \u00b1 13 " in markdown and "+30 (+26 %)" in markdown
    assert r"115 $\pm$ 13 " in latex and r"\caption{" in latex
    assert latex.count(r"\begin{longtable}") == latex.count(r"\end{longtable}") == 1
    assert r"{longtable}{}" not in read(sweep, "consistent.tex")  # which has no rows
    body = re.sub(r"\\[%&_#]", "", latex)
    assert "%" not in body and "_" not in body and latex.isascii()


def test_numbers_that_are_shown_as_one_have_the_digits_of_their_spread():
    """That is half of an interval, or else a standard deviation."""
    numbers = {"difference": [12.345, 12.345, NAN], "difference_low": [11.111, NAN, NAN]}
    numbers |= {"difference_high": [13.579, NAN, NAN], "pooled_std": [0.1, 123.0, NAN]}
    numbers |= {"baseline_mean": [12.345, 12.345, NAN], "baseline_std": [0.123, NAN, NAN]}
    table = analysis.formatting.Table("", pd.DataFrame(numbers), "", "", only_csv=("pooled_std",))
    text = analysis.formatting.shown(table)
    assert "pooled std" not in text
    assert list(text["difference"]) == ["12.3 [11.1, 13.6]", "12", "\u2013"]
    assert list(text["no noise"]) == ["12.35 \u00b1 0.12", "12.35 \u00b1 \u2013", "\u2013"]


@pytest.mark.parametrize("number, width", [(1, 5.2), (2, 8), (3, 10), (5, 10)])
def test_a_figure_is_as_wide_as_its_panels_need(number, width):
    what = list("ABCDE"[:number]), ["no noise"], "return", "steps"
    figure, axes, _ = analysis.figures.panels(*what)
    assert figure.get_figwidth() == width and len(axes) == number


# ------------------------------------------------------------------------------------ command line


@pytest.mark.parametrize(
    "case", ["no folder", "no runs", "none finished", "no paper", "not the paper"]
)
def test_nothing_to_analyze_is_an_error(case, tmp_path, capsys):
    if case != "no folder":
        (tmp_path / "runs").mkdir()
    if case == "none finished":
        write_run(tmp_path / "runs", [1], finished=False)
    if case.endswith("paper"):
        write_run(tmp_path / "runs", [1])
    compare = {"no paper": tmp_path / "nowhere", "not the paper": tmp_path / "other"}.get(case)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/best.csv").write_text("algorithm,noise\nSAC,x\n")
    with pytest.raises(SystemExit) as error:
        run(tmp_path, compare=compare)
    printed = capsys.readouterr()
    assert error.value.code == 2 and not (tmp_path / "results").exists()
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1
    assert ("unfinished" in printed.out) == (case == "none finished")


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path, capsys):
    write_run(tmp_path / "runs", [1])
    (tmp_path / "results").write_text("a file")
    with pytest.raises(SystemExit) as error:
        run(tmp_path)
    printed = capsys.readouterr().err
    assert error.value.code == 2 and printed.startswith("error: --out: ")
    assert printed.count("\n") == 1 and (tmp_path / "results").read_text() == "a file"


def test_results_go_beside_the_runs(tmp_path):
    write_run(tmp_path / "runs", [1])
    main(analyze.Args(runs_dir=tmp_path / "runs"))
    assert (tmp_path / "runs/results/report.html").exists()
    main(analyze.Args(runs_dir=tmp_path / "runs"))  # its own results are renewed
    with pytest.raises(SystemExit):
        main(analyze.Args(runs_dir=tmp_path / "runs", out=tmp_path / "results/../runs"))
    assert not (tmp_path / "runs/best.csv").exists()


def test_runs_one_folder_deeper_are_pointed_to(tmp_path, capsys):
    write_run(tmp_path / "runs/demo", [1])
    with pytest.raises(SystemExit):
        main(analyze.Args(runs_dir=tmp_path / "runs"))
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(tmp_path / "runs/demo") in error
    assert not (tmp_path / "runs/results").exists()


@pytest.mark.slow
def test_a_reader_that_stops_early_is_no_error(tmp_path):
    write_run(tmp_path / "runs", [1])
    command = f"{sys.executable} {analyze.__file__} --runs-dir {tmp_path}/runs"
    # The reader is gone before the first line is printed, so the pipe is broken for certain.
    script = f"set -o pipefail; {command} | true"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert done.stderr == "" and done.returncode == 0


@pytest.mark.parametrize("width", [70, 80, 100, 140])
def test_what_is_printed_fits_the_terminal(width, tmp_path, capsys, monkeypatch):
    long = "RandomNormalNoisyObservation(1.0)"
    for seed in range(1, 4):
        write_run(tmp_path, [1.0, seed], seed=seed)
        write_run(tmp_path, [1.0, seed], noise=long, rate=1.0, seed=seed)
    write_run(tmp_path, [1.0, 5.0], noise=long, rate=1.0, seed=4, finished=False)
    monkeypatch.setattr(analyze, "terminal_width", lambda: width)
    monkeypatch.chdir(tmp_path)
    main(analyze.Args(runs_dir=Path(".")))
    lines = capsys.readouterr().out.splitlines()
    assert width - 20 < max(map(len, lines)) <= width
    assert lines[0].startswith("SAC: 1 noise in 1 environment: 0 better, 0 worse, 1 no clear")
    [head] = [line for line in lines if line.startswith("algorithm,  ")]  # wrapped before the noise
    assert lines[lines.index(head) + 1].strip() == "environment"
    assert ("difference" in head) == (width > 70) and ("luck" in head) == (width > 100)
    assert lines[-1] == "Open results/report.html"


@pytest.mark.slow
def test_a_file_gets_whole_lines(tmp_path):
    """`grep`, and `head -n 1` of the demo, take lines for sentences."""
    for seed in range(1, 5):
        write_run(tmp_path, [1.0, seed], seed=seed)
        write_run(tmp_path, [1.0, seed], noise=SCALE, rate=0.5, seed=seed)
    command = [sys.executable, analyze.__file__, "--runs-dir", tmp_path]
    first = subprocess.run(command, capture_output=True, text=True).stdout.splitlines()[0]
    assert len(first) > 120 and first.endswith(".")


def test_one_seed_is_no_plural(tmp_path, capsys):
    write_run(tmp_path, [1.0, 2.0])
    write_run(tmp_path, [1.0, 2.0], noise=SCALE, rate=0.5)
    main(analyze.Args(runs_dir=tmp_path))
    printed = capsys.readouterr().out
    assert "SAC, Hopper-v5: with 1 seed no difference can be significant" in printed
    for text in (printed, (tmp_path / "results" / "report.html").read_text()):
        assert not re.search(r"\b1 (seed|noise|run|comparison)s\b", text)


def test_one_baseline_run_is_enough_for_a_report(tmp_path, capsys):
    write_run(tmp_path / "runs", [1.0, 2.0])
    tables = run(tmp_path, drawn=True)
    assert tables["best"].empty and row(tables["summary_SAC"], n=1)["mean"] == 2
    assert (tmp_path / "results/curves_SAC_no_noise.svg").exists()
    assert "Finished runs: 1." in capsys.readouterr().out


def test_committed_figures_are_those_that_a_page_shows():
    pages = [RESULTS.parent / "README.md", *RESULTS.glob("*.md"), *RESULTS.parent.glob("docs/*.md")]
    shown = re.findall(r"!\[[^]]*\]\([^)]*figures/([^)]*)\)", "".join(p.read_text() for p in pages))
    assert {path.name for path in (RESULTS / "figures").iterdir()} == set(shown)


def test_committed_runs_had_the_noise_that_their_names_say():
    """Each wrapper acted as often as a binomial sample at its rate would, up to 4 deviations."""
    folders = sorted((RESULTS / "data/runs").iterdir())
    assert folders
    for folder in folders:
        args = json.loads((folder / "config.json").read_text())["args"]
        result = json.loads((folder / "result.json").read_text())
        names = [text.partition("(")[0] for text in args["noise"]]
        assert list(result["noise_applied"]) == names, folder
        counts = result["noise_applied"].values()
        for rate, (applied, calls) in zip(args["noise_rate"], counts, strict=True):
            deviation = (calls * rate * (1 - rate)) ** 0.5
            assert abs(applied - calls * rate) <= 4 * deviation, (folder, applied, calls)


@pytest.mark.slow
def test_help_shows_a_command_and_every_option():
    command = [sys.executable, analyze.__file__, "--help"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "python analyze.py --runs-dir runs/demo --out somewhere" in text
    assert all(option in text for option in ("--runs-dir", "--out", "--compare"))
