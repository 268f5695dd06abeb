"""Reading a folder of runs: which runs count, what is in no table, and why."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from sweeps import ENDING, SCALE, row, run, write_pairs, write_run

from analysis.runs import finished, in_short, left_out, missing_runs, read_runs
from analysis.studies import make_studies, version_notes
from noisy_wrappers import BASELINE

BEGUN = "# 2026-01-01 00:00:00 host: python ppo_continuous_noisy.py\n"
NEW = {"versions": {"noisy_wrappers": "0.4.1"}}


def status_of(entries, status):
    """Return {seed: reason} of the runs with a status."""
    return {entry.run.seed: entry.reason for entry in entries if entry.status == status}


# --------------------------------------------------------------------------------- what is left out


def test_every_run_left_out_has_its_own_reason(tmp_path):
    """People see one row for each configuration and status."""
    for seed in (1, 2, 3, 5, 6, 8):
        finished = seed in (1, 8)
        write_run(tmp_path, [10], seed=seed, finished=finished, noise=SCALE, rate=0.5)
    for name in ("damaged__1", "damaged__2"):
        write_run(tmp_path, [10], seed=9, folder=name)
        (tmp_path / name / "config.json").write_text("{" * len(name))
    (tmp_path / "damaged__1/config.json").write_text("[]")
    folder = write_run(tmp_path, [10], seed=4, noise=SCALE, rate=0.5)
    (folder / "eval.csv").write_text("damaged")  # which run it is can be read
    table = left_out(read_runs(tmp_path))
    assert table["status"].value_counts().to_dict() == {"unfinished": 4, "corrupt": 3, "missing": 7}
    assert (table["reason"] != "").all() and table["run"].nunique() == 8
    short = in_short(table)
    assert short[["status", "noise", "seeds"]].fillna("").to_numpy().tolist() == [
        ["unfinished", SCALE, "2-3, 5-6"],
        ["corrupt", SCALE, "4"],
        ["corrupt", "", ""],
        ["corrupt", "", ""],
        ["missing", "", "1-6, 8"],  # the baseline
    ]
    assert "3 more" in short["run"].iloc[0]


def test_runs_that_failed_are_listed_also_without_a_folder(tmp_path):
    for phase in ("", "search", "confirmation"):
        (tmp_path / phase / "logs").mkdir(parents=True)
    (tmp_path / "logs/a__1.log").write_text(f"{BEGUN}error: no\n# 2026 host: exit=2\n")
    text = f"{BEGUN}KeyError: 'x'\n# 2026 host: exit=1\n"
    (tmp_path / "search/logs/a__2.log").write_text(text)
    for code in (0, 130, 143):  # finished or stopped; its folder was moved or deleted afterwards
        (tmp_path / f"logs/a__{code}.log").write_text(f"{BEGUN}x\n# now host: exit={code}\n")
    (tmp_path / "logs/a__run.log").write_text(f"{BEGUN}compiling ...\n")  # it is starting
    folder = write_run(tmp_path, [1], finished=False)  # this one had a folder
    (tmp_path / f"logs/{folder.name}.log").write_text(text)
    table = left_out(read_runs(tmp_path))
    assert table[["status", "run", "reason"]].to_numpy().tolist() == [
        ["failed", folder.name, "KeyError: 'x'"],
        ["failed", "a__1", "error: no"],
        ["failed", "search/a__2", "KeyError: 'x'"],
    ]


def test_more_seeds_for_the_baseline_or_for_one_noise_are_nothing_missing(tmp_path):
    """Nor is a noise where nobody tried it."""
    for seed in range(1, 6):
        write_run(tmp_path, [10], seed=seed)
        write_run(tmp_path, [10], seed=seed, noise=ENDING, rate=0.5)
        if seed <= 3:
            write_run(tmp_path, [10], seed=seed, noise=SCALE, rate=0.5)
            write_run(tmp_path, [10], seed=seed, noise=SCALE, rate=0.2)
        write_run(tmp_path / "other", [10], seed=seed, noise=ENDING, rate=0.5)
        write_run(tmp_path / "other", [10], seed=100 + seed)  # --baseline-seeds
    assert not missing_runs(read_runs(tmp_path / "other"))
    shutil.rmtree(tmp_path / "other")
    assert not missing_runs(read_runs(tmp_path))
    write_run(tmp_path, [10], seed=4, noise=SCALE, rate=0.2)  # now two of three noises have it
    write_run(tmp_path, [10], env="Pusher-v5", seed=2, noise=ENDING, rate=0.1)
    missing = [entry.run for entry in missing_runs(read_runs(tmp_path))]
    hopper = [run for run in missing if run.environment == "Hopper-v5"]
    assert [(run.configuration.noise_rate, run.seed) for run in hopper] == [("0.50", 4)]
    assert {run.configuration.noise for run in missing if run not in hopper} == {"", ENDING}


def test_a_choice_that_stops_early_in_one_environment_is_complete(tmp_path, capsys):
    for env, last in (("Hopper-v5", 1010), ("Pusher-v5", 1025)):
        for seed in range(1001, last + 1):
            write_run(tmp_path / "runs/confirmation", [seed], env=env, seed=seed)
            noise = {"noise": SCALE, "rate": 0.1}
            write_run(tmp_path / "runs/confirmation", [seed + 9], env=env, seed=seed, **noise)
    write_run(tmp_path / "runs/search", [1], seed=1, finished=False, noise=SCALE, rate=0.1)
    (tmp_path / "runs/search/begun").mkdir()
    (tmp_path / "runs/search/begun/.lock").touch()  # no config.json yet
    run(tmp_path)
    assert "not complete" not in capsys.readouterr().out
    assert left_out(read_runs(tmp_path / "runs"))["status"].tolist() == 2 * ["unfinished"]


@pytest.mark.parametrize("status", ["different", "corrupt"])
def test_a_run_that_is_left_out_is_not_missing_besides(status, tmp_path):
    """The name of its folder tells which run it is."""
    more = {"test_noise": [ENDING], "test_noise_rate": [0.5], "env_kwargs": ["mode:1"]}
    end = "__Hopper-v5_mode=1__sac_continuous_noisy__tests_p0.5_EarlyTermination_50"
    begun = {(): "baseline_s{}", SCALE: "p0.5_s{}_UniformScaleReward_0.5_1.5"}
    begun[ENDING] = "p0.5_s{}_EarlyTermination_50"
    for noise, name in begun.items():
        for seed in (1, 2, 3):
            options = more | {"gamma": 0.9 if (noise, seed) == (SCALE, 2) else 0.99}
            options |= {"noise": noise, "rate": 0.5 if noise else ()}
            folder = write_run(tmp_path, [10], seed=seed, **options)
            folder = folder.rename(tmp_path / f"{name.format(seed)}{end}")
            if status == "corrupt" and (noise, seed) == (SCALE, 2):
                (folder / "config.json").write_text("{")
    assert left_out(read_runs(tmp_path))["status"].tolist() == [status]


# ------------------------------------------------------------------------------- what is one study


@pytest.mark.parametrize("change", [{"exp_name": "other"}, {"algorithm": "MY_REDQ"}])
def test_studies_never_share_a_row(change, tmp_path):
    for seed in (1, 2):
        write_run(tmp_path / "runs", [10], seed=seed, folder=f"a{seed}")
        write_run(tmp_path / "runs", [99], seed=seed, folder=f"b{seed}", **change)
        write_run(tmp_path / "runs", [50], seed=seed, folder=f"c{seed}", noise=SCALE, rate=0.1)
    tables = run(tmp_path)
    summary = pd.concat([t for name, t in tables.items() if name.startswith("summary_")])
    assert list(summary["n"]) == [2, 2, 2] and sorted(summary["std"]) == [0, 0, 0]
    [(name, value)] = change.items()
    other = row(summary, **{name: value})
    assert other["mean"] == 99 and np.isnan(other["difference_percent"])
    assert row(summary, noise=SCALE)["baseline_mean"] == 10


def test_the_order_of_the_environments_arguments_does_not_matter(tmp_path):
    for seed, kwargs in enumerate((["a:1", "b:2"], ["b:2", "a:1"], ["a:1", "b:2"]), start=1):
        write_run(tmp_path, [10], seed=seed, env_kwargs=kwargs)
    runs = finished(read_runs(tmp_path))
    assert len(runs) == 3 and {one.tested for one in runs} == {"with a:1, b:2"}


def test_the_most_frequent_arguments_of_an_exp_name_are_its_study(tmp_path, capsys):
    for seed in (1, 2, 3):
        write_run(tmp_path / "runs", [10, 20], seed=seed)
        write_run(tmp_path / "runs", [20, 30], seed=seed, noise=SCALE, rate=0.1)
    write_run(tmp_path / "runs", [5], seed=4, gamma=0.9, env="Pusher-v5")  # a short trial
    write_run(tmp_path / "runs", [5], seed=5, gamma=0.9, exp_name="trial")
    write_run(tmp_path / "runs", [5], seed=6, gamma=0.9, finished=False)
    entries = read_runs(tmp_path / "runs")
    [reason] = status_of(entries, "different").values()
    assert "gamma is 0.9, not 0.99" in reason and "total_timesteps is 10000, not 20000" in reason
    studies, _ = make_studies(entries)
    assert [study.name for study in studies] == ["SAC", "SAC [trial]"]
    assert reason in set(run(tmp_path)["missing"]["reason"])
    said = capsys.readouterr().out
    assert "Runs that count: 7. SAC: 6 runs of" in said and "1 different" in said


def test_an_argument_that_a_run_of_0_3_lacks_is_no_difference(tmp_path):
    more = [{}, {}, {}, {"new": 1}, {"new": 1}, {"new": 2}]
    more += [{"newer": None, "new": 1}, {"newer": 3}]
    for seed, args in enumerate(more):
        write_run(tmp_path, [10], seed=seed, **args)
    found = status_of(read_runs(tmp_path), "different")
    assert {seed: text.split(" as")[0] for seed, text in found.items()} == {
        5: "new is 2, not 1",
        7: "newer is 3, not None",
    }


def test_an_argument_that_a_run_lacks_had_the_default_that_others_name(tmp_path):
    """Also where most runs have another value; tuples are lists, text and None are values."""
    layers = NEW | {"defaults": {"layer_norm": False, "sizes": [256, 256]}}
    own = {"layer_norm": True, "sizes": [256, 256], "name": None}
    for seed in (1, 2, 3):
        write_run(tmp_path, [10], seed=seed, config=layers, **own)
    write_run(tmp_path, [10], seed=4, config=NEW)  # before there was the option
    write_run(tmp_path, [10], seed=5, config=layers, **own | {"layer_norm": False})
    found = status_of(read_runs(tmp_path), "different")
    assert found.keys() == {4, 5}
    assert found[4].startswith("layer_norm is False, not True")


def test_runs_of_two_releases_are_never_pooled(tmp_path, capsys):
    """Nor do unfinished runs and copies count."""
    for seed in (1, 2, 3):
        write_run(tmp_path / "runs", [10], seed=seed, config=NEW)
    write_run(tmp_path / "runs", [99], seed=3, config=NEW, folder="z copy")
    write_run(tmp_path / "runs", [99], seed=5, config=NEW, finished=False)
    write_run(tmp_path / "runs", [99], seed=4)
    assert list(status_of(read_runs(tmp_path / "runs"), "different")) == [4]
    tables = run(tmp_path)
    assert tables["summary_SAC"][["n", "mean"]].to_numpy().tolist() == [[3, 10]]
    assert set(tables["missing"]["status"]) == {"different", "duplicate", "unfinished"}
    assert "release is 0.3, not 0.4 (numbers differ)" in capsys.readouterr().out


def test_where_runs_were_tested_is_said_and_tells_studies_apart(tmp_path, capsys):
    tested = {"test_noise": ["RandomActionDelay(1)"], "test_noise_rate": [1.0]}
    root = tmp_path / "runs"
    write_pairs(root, range(101, 106), range(201, 206), **tested)
    write_run(root, [1.0], seed=9, test_noise=[], test_noise_rate=[])
    tables = run(tmp_path)
    assert "SAC [tested under RandomActionDelay(1) at 1.0] on Hopper-v5" in capsys.readouterr().out
    assert tables["missing"]["status"].tolist().count("different") == 1
    assert "tested under RandomActionDelay(1)" in (tmp_path / "results/noises.md").read_text()


def test_versions_of_an_environment_are_environments_and_a_note_says_so(tmp_path):
    for env in ("Hopper-v4", "Hopper-v5", "Walker2d-v4"):
        write_pairs(tmp_path, [100, 101], [110, 111], env=env)
    [note] = make_studies(read_runs(tmp_path))[1]
    assert "Hopper-v4 and Hopper-v5 count as environments of their own" in note


def test_paths_threads_and_evaluation_steps_do_not_split_rows(tmp_path):
    write_run(tmp_path, [1, 2, 3, 4], seed=1)
    write_run(tmp_path, [6, 8], seed=2, every=20_000, torch_threads=4, cuda=True)
    write_run(tmp_path, [1, 2, 3, 5], seed=3, runs_dir="x")
    (study,), notes = make_studies(read_runs(tmp_path))
    assert study.algorithm == "SAC" and study.steps.tolist() == [20_000, 40_000]
    assert study.curves[BASELINE][:, :, 0].tolist() == [[2, 6, 2], [4, 8, 5]]
    assert notes == []


def test_a_run_that_ended_by_itself_counts_with_its_own_last_tests(tmp_path):
    """And extra tests at other steps stand in no curve."""
    for seed in (1, 2):
        write_run(tmp_path, [10 * seed] * 10, seed=seed)
    folder = write_run(tmp_path, [1, 2, 3, 4], seed=3, total_timesteps=100_000)
    text = (folder / "eval.csv").read_text().replace("\n40000,", "\n34567,")
    (folder / "eval.csv").write_text(text)
    (study,), notes = make_studies(read_runs(tmp_path))
    assert study.finals[BASELINE].ravel().tolist() == [10, 20, 3.5]  # 30,000 is in its last 15 %
    assert study.steps.tolist() == [10_000 * i for i in range(1, 11)]
    curve = study.curves[BASELINE][:, 2, 0]
    assert curve[:3].tolist() == [1, 2, 3] and np.isnan(curve[3:]).all()
    assert "ended by themselves before their 100,000 steps: 1 of 3, at step 34,567" in notes[0]
    write_run(tmp_path, [1], env="Pusher-v5", total_timesteps=100_000)
    assert make_studies(read_runs(tmp_path))[1][0] == notes[0]  # also by success, on Hopper alone


def test_a_noise_that_never_acted_is_noted(tmp_path):
    """As where a script learns from stored data and never steps the noisy environment."""
    for seed, counts in enumerate(([0, 0], [0, 500], [3, 500], None, "damaged")):
        folder = write_run(tmp_path, [10], seed=seed, noise=SCALE, rate=0.1)
        result = {"final_return_mean": 10.0, "noise_applied": counts and {"Scale": counts}}
        (folder / "result.json").write_text(json.dumps(result))
    notes = [note for note in make_studies(read_runs(tmp_path))[1] if "changed nothing" in note]
    assert len(notes) == 1 and "Hopper-v5: Scale changed nothing in 2 runs" in notes[0]


def test_runs_of_different_code_are_noted(tmp_path):
    one = {"git_commit": 40 * "1", "script_sha256": 64 * "a", "versions": {"mujoco": "3.15.0"}}
    other = {"git_commit": 40 * "1" + "-dirty", "script_sha256": f"{64 * 'a'}, {64 * 'b'}"}
    write_run(tmp_path, [1], seed=1, config=one)
    write_run(tmp_path, [1], seed=2, config=other | {"versions": {"mujoco": "3.14.0"}})
    entries = read_runs(tmp_path)
    said = ("1111111111-dirty (n = 1)", "mujoco: 3.14.0 (n = 1)", "bbbb (n = 1)")
    for note, text in zip(version_notes(entries), said, strict=True):
        assert text in note
    assert make_studies(entries)[0][0].finals[BASELINE].shape == (2, 1)  # both count
