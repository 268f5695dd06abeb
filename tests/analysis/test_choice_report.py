"""What analyze.py says of noise that was chosen, that changes during training, or that combines."""

import json
import subprocess

import numpy as np
import pandas as pd
import pytest
from test_analyze import ENDING, SCALE, row, run, write_run

import analysis.figures
import analysis.formatting
import analysis.runs
import analysis.tables
import evaluate

PUSH = "RandomNormalNoisyAction(0.3)"
HEADER = "algorithm,environment,phase,round,noise,noise_rate,seeds,score,survives\n"


def write_choice(root, env="Hopper-v5", seeds=range(1001, 1006), gain=30.0):
    """Runs of a search in two rounds, which flatters its winner, and of a confirmation."""
    for noise, n, final in ((SCALE, 3, 900.0), (ENDING, 1, 100.0)):
        for seed in range(1, n + 1):
            write_run(root / "search", [final + seed], "PPO", env, noise, 1.0, seed)
    fresh = root / "confirmation"
    for seed in seeds:
        write_run(fresh, [100.0 + seed - 1000], "PPO", env, seed=seed)
        write_run(fresh, [100.0 + gain + seed - 1000], "PPO", env, SCALE, 1.0, seed)
    lines = [
        f'PPO,{env},search,1,"{SCALE}",1.0,1,901.0,yes\n',
        f'PPO,{env},search,1,"{ENDING}",1.0,1,101.0,no\n',
        f"PPO,{env},confirmation,,,0.0,5,103.0,\n",
        f'PPO,{env},confirmation,,"{SCALE}",1.0,5,133.0,yes\n',
    ]
    path = root / "choice.csv"
    path.write_text((path.read_text() if path.exists() else HEADER) + "".join(lines))


def test_search_and_confirmation_are_never_mixed(tmp_path, capsys):
    write_choice(tmp_path / "runs")
    tables = run(tmp_path)
    summary = tables["summary_PPO"]
    search, fresh = "search", "confirmation"
    assert row(summary, phase=search, noise=SCALE)[["n", "mean"]].tolist() == [3, 902]
    confirmed = row(summary, phase=fresh, noise=SCALE)
    assert confirmed[["n", "mean", "n_baseline", "baseline_mean"]].tolist() == [5, 133, 5, 103]
    assert np.isnan(row(summary, phase=search, noise=SCALE)["improvement_percent"])
    # Only the confirmation is judged: five against five that are all higher.
    for name in ("statistics", "best"):
        assert set(tables[name]["phase"]) == {fresh}
    assert row(tables["statistics"], noise=SCALE)["p"] == pytest.approx(2 / 252)
    printed = capsys.readouterr().out
    found = f"PPO [confirmation] on Hopper-v5 with {SCALE} at rate 1.00 is better than no noise: "
    assert f"{found}+30.0 [27.7, 32.3] (+29 %), p = 0.0079" in printed
    assert "no finished baseline" not in printed and tables["missing"].empty
    choice = tables["choice"]
    assert choice["survives"].fillna("").tolist() == ["yes", "no", "", "yes"]
    assert choice["noise_rate"].tolist() == ["1.00", "1.00", "0.00", "1.00"]
    page = (tmp_path / "results/report.html").read_text()
    assert "Choice of a noise" in page and page.index('id="choice"') < page.index('id="best"')


def test_confirmations_are_one_family_of_holms(tmp_path):
    for env in ("Hopper-v5", "Pusher-v5", "Walker2d-v5"):
        write_choice(tmp_path / "runs", env, gain=0.5 if env == "Pusher-v5" else 30.0)
    table = run(tmp_path)["statistics"]
    table = table[table["p"].notna()].set_index("environment")
    assert set(table.index) == {"Hopper-v5", "Pusher-v5", "Walker2d-v5"}  # nor all of them
    p = 2 / 252
    assert table.loc["Hopper-v5", "p_adjusted"] == pytest.approx(3 * p)
    assert table.loc["Walker2d-v5", "p_adjusted"] == pytest.approx(3 * p)  # never below another
    assert table.loc["Pusher-v5", "p_adjusted"] == pytest.approx(table.loc["Pusher-v5", "p"])
    assert set(table["comparisons"]) == {3}


def test_the_phases_are_folders_and_high_seeds_are_seeds(tmp_path):
    """A choice that is not finished has no choice.csv."""
    write_choice(tmp_path / "runs")
    (tmp_path / "runs/choice.csv").unlink()
    for seed in (1, 1001):
        write_run(tmp_path / "runs", [5.0], "PPO", "Pusher-v5", seed=seed)
    tables = run(tmp_path)
    summary = tables["summary_PPO"].groupby("phase")["n"].agg(list).to_dict()
    assert summary == {"": [2], "search": [1, 3], "confirmation": [5, 5]}
    assert "choice" not in tables


def test_the_flat_folder_of_an_earlier_version_is_refused_with_the_commands(tmp_path, capsys):
    """After them, the tables are those of a choice that was never flat."""
    root = tmp_path / "my runs"
    write_choice(root)
    expected = run(tmp_path, "my runs")
    for phase in ("search", "confirmation"):
        for i, folder in enumerate(sorted((root / phase).iterdir())):
            seed = json.loads((folder / "config.json").read_text())["args"]["seed"]
            folder.rename(root / f"p1.0_s{seed}_A{phase[0]}{i}__Hopper-v5__ppo")
        (root / phase).rmdir()
    capsys.readouterr()
    with pytest.raises(SystemExit) as error:
        run(tmp_path, "my runs")
    printed = capsys.readouterr().err
    assert error.value.code == 2 and printed.count("\n") == 1 and printed.count("mv ") == 2
    command = printed.partition("now: ")[2]
    subprocess.run(command, shell=True, check=True, executable="/bin/bash")
    for name, table in run(tmp_path, "my runs", "again").items():
        if name != "missing":
            pd.testing.assert_frame_equal(table, expected[name])


def test_other_sweeps_in_the_folder_of_a_choice_stay_as_they_are(tmp_path):
    write_choice(tmp_path / "runs")
    for algorithm, env in (("PPO", "Pusher-v5"), ("SAC", "Hopper-v5")):
        for seed in (1, 2, 3):
            write_run(tmp_path / "runs", [100.0 + seed], algorithm, env, seed=seed)
            write_run(tmp_path / "runs", [110.0 + seed], algorithm, env, SCALE, 1.0, seed)
    tables = run(tmp_path)
    found = tables["statistics"].query("scope == 'environment'")
    assert set(zip(found["algorithm"], found["phase"], found["environment"], strict=True)) == {
        ("PPO", "confirmation", "Hopper-v5"),
        ("PPO", "", "Pusher-v5"),
        ("SAC", "", "Hopper-v5"),
    }


def test_a_choice_in_a_folder_of_its_own_disturbs_no_other_sweep(tmp_path):
    for seed in (1, 2, 3):
        write_run(tmp_path / "runs", [100.0 + seed], "PPO", seed=seed)
        write_run(tmp_path / "runs", [110.0 + seed], "PPO", noise=SCALE, rate=1.0, seed=seed)
    before = [run.folder for run in evaluate.find_runs([tmp_path / "runs"])[0]]
    tables = run(tmp_path)
    write_choice(tmp_path / "runs/choose")
    assert [run.folder for run in evaluate.find_runs([tmp_path / "runs"])[0]] == before
    again = run(tmp_path, out="again")
    assert tables.keys() == again.keys() and "choice" not in again
    for name, table in tables.items():
        pd.testing.assert_frame_equal(table, again[name])


def test_a_damaged_choice_is_one_line(tmp_path, capsys):
    write_choice(tmp_path / "runs")
    (tmp_path / "runs/choice.csv").write_text("algorithm,phase\n")
    with pytest.raises(SystemExit) as error:
        run(tmp_path)
    printed = capsys.readouterr().err
    assert error.value.code == 2 and printed.count("\n") == 1 and "choice.csv" in printed
    assert not (tmp_path / "results").exists()


def test_rates_that_change_are_read_sorted_and_shown(tmp_path):
    for rate in (1.0, "1.0:0.0", 0.05, "0.0:1.0"):
        for seed in (1, 2, 3):
            write_run(tmp_path / "runs", [10 + seed], seed=seed, noise=SCALE, rate=rate)
            write_run(tmp_path / "runs", [12 + seed], seed=seed, noise=PUSH, rate=rate)
    both = {"noise": (PUSH, SCALE), "rate": (0.5, "1.0:0.0")}
    for seed in (1, 2, 3):
        write_run(tmp_path / "runs", [10], seed=seed)
        write_run(tmp_path / "runs", [20], seed=seed, **both)
    tables = run(tmp_path)
    rates = tables["summary_SAC"].query("noise == @PUSH")["noise_rate"].tolist()
    assert rates == ["0.00 to 1.00", "0.05", "1.00 to 0.00", "1.00"]
    combined = row(tables["summary_SAC"], noise=f"{PUSH} + {SCALE}")
    assert combined["noise_rate"] == "0.50 + 1.00 to 0.00"
    studies, _ = analysis.runs.make_studies(analysis.runs.read_runs(tmp_path / "runs"))
    figures = analysis.figures.figures(studies, analysis.tables.make_tables(studies))
    drawn = {drawing.name: drawing.draw() for drawing in figures}
    lines = [text.get_text() for text in drawn["effects_SAC"].axes[0].get_yticklabels()]
    lines = [line.replace("\n(", "(") for line in lines]  # broken where there is little room
    changing = [f"{PUSH}, {rate}" for rate in ("0.00 to 1.00", "0.05", "1.00 to 0.00", "1.00")]
    assert lines[:4] == changing and f"{PUSH} +\n{SCALE}, 0.50 +\n1.00 to 0.00" in lines
    legend = drawn[f"curves_SAC_{analysis.formatting.slug(PUSH)}"].legends[0].get_texts()
    named = [text.get_text().partition(" (")[0] for text in legend]
    assert named == ["no noise", *(f"rate {rate}" for rate in rates)]


def test_figures_of_experiments_with_similar_names_have_names_of_their_own(tmp_path):
    for name in ("lr 1", "lr_1"):
        for seed in (1, 2):
            more = {"seed": seed, "exp_name": name}
            write_run(tmp_path, [10], folder=f"{name}-{seed}", **more)
            write_run(tmp_path, [9], folder=f"{name}-{seed}-p", noise=PUSH, rate=0.1, **more)
    studies, _ = analysis.runs.make_studies(analysis.runs.read_runs(tmp_path))
    figures = analysis.figures.figures(studies, analysis.tables.make_tables(studies))
    names = {drawing.name for drawing in figures}
    assert len(figures) == len(names) and {"effects_SAC_lr_1", "effects_SAC_lr_1_again"} <= names
