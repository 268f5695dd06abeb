"""Robustness in analyze.py: fabricated runs with known returns, tables computed by hand."""

import gzip
import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from sweeps import row, run, write_run

import analysis.figures
import analysis.robustness
from analysis.runs import finished, read_runs
from noisy_wrappers import Configuration

SENSOR = "RandomNormalNoisyObservation(0.1)"
PUSH = "RandomNormalNoisyAction(0.3)"
REWARD = "RandomNormalNoisyReward(1.0)"
ENDING = "RandomEarlyTermination(50)"
OFFSETS = np.arange(-9, 10, 2)  # of ten episodes from their mean

# Training configuration -> test condition -> mean return of seeds 1 to 4, on Hopper. C is 100.
HOPPER = {
    ("", 0.0): {
        ("", "0.0"): [98, 100, 100, 102],
        (SENSOR, "0.2"): [80, 80, 80, 80],
        (SENSOR, "1.0"): [40, 40, 40, 40],
        (PUSH, "1.0"): [61, 62, 63, 64],
        (REWARD, "1.0"): [0, 0, 0, 0],
        (ENDING, "1.0"): [0, 0, 0, 0],
        (f"{SENSOR} + {PUSH}", "0.2 + 1.0"): [50, 50, 50, 50],
    },
    (PUSH, 1.0): {
        ("", "0.0"): [90, 90, 90, 90],
        (SENSOR, "0.2"): [86, 87, 88, 89],
        (SENSOR, "1.0"): [60, 60, 60, 60],
        (PUSH, "1.0"): [95, 95, 95, 95],
        (REWARD, "1.0"): [70, 70, 70, 70],
        (ENDING, "1.0"): [70, 70, 70, 70],
        (f"{SENSOR} + {PUSH}", "0.2 + 1.0"): [70, 70, 70, 70],
    },
    (SENSOR, 0.2): {
        ("", "0.0"): [110, 110, 110, 110],
        (SENSOR, "0.2"): [105, 105, 105, 105],
        (SENSOR, "1.0"): [70, 70, 70, 70],
        (PUSH, "1.0"): [56, 57, 58, 59],
    },
}


def write_tests(root, table, env, seeds=(1, 2, 3, 4)):
    """Write runs with a robustness.csv of ten episodes under every condition."""
    for (noise, rate), conditions in table.items():
        for i, seed in enumerate(seeds):
            config = {"noise": noise, "rate": rate} if noise else {}
            folder = write_run(root, [100.0], "PPO", env, seed=seed, **config)
            lines = ["noise,noise_rate,episode,episodic_return,episodic_length\n"]
            for (tested, at), means in conditions.items():
                for episode, offset in enumerate(OFFSETS):
                    quoted = f'"{tested}"' if tested else ""
                    lines.append(f"{quoted},{at},{episode},{means[i] + offset},1000\n")
            (folder / "robustness.csv").write_text("".join(lines))


def test_score_and_conditions_by_hand(tmp_path, capsys):
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    tables = run(tmp_path)
    scores = tables["robustness_score"]
    assert list(scores.columns) == analysis.robustness.SCORE_COLUMNS and len(scores) == 2

    push = row(scores, noise=PUSH)  # on the sensor noise alone: ((86 .. 89) - 100 + 60 - 100) / 2
    assert push["environment"] == "Hopper-v5" and push["conditions"] == 2
    assert (push["n"], push["n_baseline"]) == (4, 4)
    assert push["score_percent"] == pytest.approx(np.mean([-27, -26.5, -26, -25.5]))
    assert push["baseline_score_percent"] == pytest.approx(-40)  # (80 - 100 + 40 - 100) / 2
    assert push["difference"] == push["difference_percent"] == pytest.approx(13.75)
    assert np.isnan(push["difference_low"])  # four seeds
    assert push["p"] == pytest.approx(2 / 70)  # C(8, 4) = 70
    assert push["smallest_p"] == pytest.approx(2 / 70)
    assert push["p_holm"] == pytest.approx(2 * 2 / 70)
    assert push["clean_change_percent"] == pytest.approx(-10)

    sensor = row(scores, noise=SENSOR)  # its wrapper was in training, so the action noise alone
    assert sensor["conditions"] == 1 and sensor["score_percent"] == pytest.approx(57.5 - 100)
    assert sensor["baseline_score_percent"] == pytest.approx(62.5 - 100)
    assert sensor["p"] == pytest.approx(2 / 70) and sensor["clean_change_percent"] == 10

    table = tables["robustness"]
    same = row(table, noise=PUSH, test_noise=PUSH)
    assert same["tested_on"] == "the same noise" and same["mean"] == 95 and same["n"] == 4
    assert same["change_percent"] == pytest.approx(100 * (95 - 62.5) / 62.5)
    wrapper = row(table, noise=SENSOR, test_noise=SENSOR, test_rate="1.00")
    assert wrapper["tested_on"] == "the same wrapper"
    assert wrapper["change_percent"] == pytest.approx(75)
    both = row(table, noise=PUSH, test_noise=f"{SENSOR} + {PUSH}")
    assert both["tested_on"] == "the same wrapper" and both["test_rate"] == "0.20 + 1.00"
    new = table[(table["noise"] == PUSH) & (table["test_noise"] == SENSOR)]
    assert set(new["tested_on"]) == {"new noise"}
    assert new["std"].tolist() == pytest.approx([np.std([1, 2, 3, 4], ddof=1), 0])
    clean = table[(table["noise"] == "") & (table["test_noise"].isna())].iloc[0]
    assert clean["tested_on"] == "clean" and clean["mean"] == 100
    assert np.isnan(clean["change_percent"])

    text = capsys.readouterr().out
    assert (
        f"PPO on Hopper-v5, trained with {PUSH} at rate 1.00: no clear difference in robustness"
        in text
    )
    assert "p = 0.029, Holm 0.057" in text and "perhaps" not in text
    page = (tmp_path / "results/report.html").read_text()
    assert "Primary figure" in page and "at rate 1.00: no clear difference in robustness" in page


@pytest.mark.parametrize(
    ("noise", "counts"),
    [
        ("RandomDynamics(0.7, 0.7)", True),
        ("RandomActionDelay(2)", True),
        ("RandomDynamics(0.7, 0.7) + RandomActionDelay(2)", True),
        (ENDING, False),
        (REWARD, False),
        (f"{ENDING} + RandomDynamics(0.7, 0.7)", False),
        ("RandomDynamics(1.3, 1.3)", False),  # of the training's wrapper
    ],
)
def test_physics_and_delays_count_and_what_changes_no_behaviour_does_not(noise, counts):
    trained = "RandomDynamics(0.7, 1.3)" if "1.3" in noise else PUSH
    rate = " + ".join(["1.0"] * (noise.count("+") + 1))
    config = Configuration.parse(trained, "1.0")
    condition = Configuration.parse(noise, rate)
    assert analysis.robustness.is_unseen(condition, config) == counts


def test_tests_elsewhere_never_mix_with_those_at_home(tmp_path):
    """They are rows of their own, and change nothing of the others."""
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    home = run(tmp_path)
    for path in (tmp_path / "runs").glob("*/robustness.csv"):
        header, *lines = path.read_text().splitlines()
        there = [
            ",0.0,0,0.5,7,Heavy-v0",
            '"RandomNormalNoisyObservation(0.1)",0.2,0,0.5,7,Heavy-v0',
        ]
        lines = [f"{header},environment", *(f"{line}," for line in lines), *there]
        path.write_text("\n".join(lines) + "\n")
    both = run(tmp_path)
    for name in ("robustness", "robustness_score"):
        elsewhere = both[name]["environment"].str.contains("Heavy")
        pd.testing.assert_frame_equal(both[name][~elsewhere].reset_index(drop=True), home[name])
    rows = both["robustness"]
    rows = rows[rows["environment"] == "Hopper-v5, tested in Heavy-v0"]
    assert len(rows) == 2 * len(HOPPER) and set(rows["mean"]) == {0.5}
    assert both["robustness_together"].empty


def test_environments_count_equally_and_the_test_is_stratified(tmp_path):
    few = {config: HOPPER[config] for config in (("", 0.0), (PUSH, 1.0))}
    pusher = {
        ("", 0.0): {("", "0.0"): [-50] * 3, (SENSOR, "0.2"): [-100, -101, -102]},
        (PUSH, 1.0): {("", "0.0"): [-60] * 3, (SENSOR, "0.2"): [-75, -76, -77]},
    }
    write_tests(tmp_path / "runs", few, "Hopper-v5")
    write_tests(tmp_path / "runs", pusher, "Pusher-v5", seeds=(1, 2, 3))
    tables = run(tmp_path)
    scores, [every] = tables["robustness_score"], tables["robustness_together"].iloc
    assert list(scores["environment"]) == ["Hopper-v5", "Pusher-v5"]
    one = scores.iloc[1]
    assert one["score_percent"] == pytest.approx(100 * (-76 + 50) / 50)  # -52
    assert one["baseline_score_percent"] == pytest.approx(-102)
    assert every["score_percent"] == pytest.approx((-26.25 - 52) / 2)
    assert np.isnan(every["difference"])  # in two units
    assert every["difference_percent"] == pytest.approx((13.75 + 50) / 2)
    assert every["p"] == pytest.approx(2 / (70 * 20)) == every["p_holm"]
    assert every["clean_change_percent"] == pytest.approx((-10 - 20) / 2)
    assert every["n"] == 3
    assert scores["p_holm"].isna().all()  # these are secondary


def test_an_environment_with_one_seed_does_not_hide_the_others(tmp_path, capsys):
    clean, weak, strong = ([100, 101, 99, 100], [50, 51, 52, 53], [80, 81, 82, 83])
    table = {("", 0.0): {("", "0.0"): clean, (SENSOR, "1.0"): weak}}
    table |= {(PUSH, 1.0): {("", "0.0"): clean, (SENSOR, "1.0"): strong}}
    full, single = (1, 2, 3, 4), (1,)
    for env, seeds in (("A-v0", full), ("B-v0", full), ("C-v0", single)):
        write_tests(tmp_path / "three/runs", table, env, seeds)
    [average] = run(tmp_path / "three")["robustness_together"].iloc
    assert average["p_holm"] == average["p"] < 0.01 and average["n"] == 4
    for env, seeds in (("A-v0", full), ("B-v0", single)):
        write_tests(tmp_path / "two/runs", table, env, seeds)
    scores = run(tmp_path / "two")["robustness_score"]
    assert list(scores["environment"][scores["p_holm"].notna()]) == ["A-v0"]
    assert "on 2 of 3 environments together, trained with" in capsys.readouterr().out


def test_sentences_say_what_is_excluded(tmp_path, capsys):
    alike = {("", 0.0): HOPPER["", 0.0], (PUSH, 1.0): dict(HOPPER["", 0.0])}
    for table in alike.values():
        for condition, values in table.items():
            table[condition] = [*values, values[0]]
    alike[PUSH, 1.0][SENSOR, "0.2"] = [78, 79, 81, 82, 80]
    write_tests(tmp_path / "runs", alike, "Hopper-v5", (1, 2, 3, 4, 5))
    run(tmp_path, out="five")
    half = np.std([78, 79, 81, 82, 80], ddof=1) / 2 / np.sqrt(5) * stats.t.ppf(0.975, 4)
    limit = f"; excluded: a gain of more than {half:.2f}, a loss of more than {half:.2f}."
    assert limit in capsys.readouterr().out
    for folder in (tmp_path / "runs").glob(f"*{PUSH}*__[345]"):
        shutil.rmtree(folder)
    run(tmp_path, out="two")
    assert "2 seeds against 5" in capsys.readouterr().out


def test_conditions_that_a_run_lacks_do_not_count(tmp_path):
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    path = next((tmp_path / "runs").glob(f"*{PUSH}*__2")) / "robustness.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if f'"{SENSOR}",1.0' not in line))
    push = row(run(tmp_path)["robustness_score"], noise=PUSH)
    assert push["conditions"] == 1 and push["score_percent"] == pytest.approx(87.5 - 100)
    assert push["baseline_score_percent"] == pytest.approx(-20)


def test_tests_are_compared_over_the_same_episodes(tmp_path, capsys):
    """Episode i begins alike in all tests, so more episodes are other ones."""
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    shorter = [path for path in (tmp_path / "runs").rglob("robustness.csv") if PUSH in str(path)]
    for path in shorter:
        lines = path.read_text().splitlines(keepends=True)
        path.write_text(
            "".join(line for line in lines if not re.search(r",[4-9],[^,]+,1000", line))
        )
    push = row(run(tmp_path)["robustness_score"], noise=PUSH)
    assert len(shorter) == 4 and push["difference"] == pytest.approx((87.5 + 60) / 2 - 60)
    assert (
        "note: PPO on Hopper-v5: tests have 4 to 10 episodes; the first 4 count, which begin alike "
        "(evaluate.py --episodes 10 plays the others)"
    ) in capsys.readouterr().out


@pytest.mark.slow
def test_compressed_damaged_and_unfinished_runs(tmp_path, capsys):
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    first = run(tmp_path, out="plain")
    for path in (tmp_path / "runs").glob("*/robustness.csv"):
        with gzip.open(f"{path}.gz", "wb") as file:
            file.write(path.read_bytes())
        path.unlink()
    second = run(tmp_path, out="packed")
    pd.testing.assert_frame_equal(first["robustness"], second["robustness"])
    capsys.readouterr()

    damaged = next((tmp_path / "runs").glob(f"*{PUSH}*__1"))
    (damaged / "robustness.csv").write_text("noise,rate\n")
    bad_disk = next((tmp_path / "runs").glob(f"*{SENSOR}*__1")) / "robustness.csv.gz"
    packed = bytearray(bad_disk.read_bytes())
    packed[60:63] = bytes(255 - byte for byte in packed[60:63])
    bad_disk.write_bytes(packed)
    unfinished = next((tmp_path / "runs").glob(f"*{PUSH}*__2"))
    (unfinished / "result.json").unlink()
    tables = run(tmp_path, out="fewer")
    assert row(tables["robustness_score"], noise=PUSH)["n"] == 2
    printed = capsys.readouterr().out
    assert f"{damaged.name}: robustness.csv is left out: unexpected header" in printed
    assert f"{bad_disk.parent.name}: robustness.csv.gz is left out: Error -3" in printed
    for path in (tmp_path / "runs").glob("*baseline*"):
        shutil.rmtree(path)
    assert run(tmp_path, out="none")["robustness_score"].empty  # nothing to compare with


def test_heatmap(tmp_path):
    table = {config: dict(conditions) for config, conditions in HOPPER.items()}
    for conditions in table.values():
        conditions[SENSOR, "0.5"] = [50, 50, 50, 50]
    write_tests(tmp_path, table, "Hopper-v5")
    found, notes = analysis.robustness.read_robustness(finished(read_runs(tmp_path)))
    tables, _ = analysis.robustness.analyse_robustness(found)
    drawn = analysis.figures.robustness_figures(tables["robustness"].frame)
    drawn = {drawing.name: drawing for drawing in drawn}
    [heatmap] = drawn
    assert heatmap == "robustness_heatmap_PPO_Hopper-v5"
    [note] = notes
    assert note == (
        "PPO on Hopper-v5: 4 of 12 tested runs lack some of the 8 test conditions; a condition "
        "counts where all runs that are compared have it"
    )

    ax = drawn[heatmap].draw().axes[0]
    rows = [label.get_text().replace("\n", "") for label in ax.get_yticklabels()]
    columns = [label.get_text().replace("\n", "") for label in ax.get_xticklabels()]
    assert rows == ["no noise", f"{PUSH}, 1.00", f"{SENSOR}, 0.20"]
    assert columns[0] == "clean" and f"{SENSOR}, 0.20" in columns
    numbers = {text.get_position(): text.get_text() for text in ax.texts}
    assert numbers[columns.index(f"{SENSOR}, 0.20"), 1] == "-12"  # 87.5, of 100
    assert numbers[columns.index("clean"), 2] == "+10"
    dots = {tuple(np.round(line.get_xydata()[0] + (-0.36, 0.28)).astype(int)) for line in ax.lines}
    same = {(columns.index(f"{PUSH}, 1.00"), 1), (columns.index(f"{SENSOR}, 0.20"), 2)}
    assert dots == same and "A dot marks" in drawn[heatmap].caption


def test_robustness_of_another_experiment_is_apart(tmp_path):
    write_tests(tmp_path, {("", 0.0): HOPPER["", 0.0]}, "Hopper-v5")
    write_tests(tmp_path, {(PUSH, 1.0): HOPPER[PUSH, 1.0]}, "Hopper-v5")
    for path in tmp_path.glob(f"*{PUSH}*/config.json"):
        config = json.loads(path.read_text())
        config["args"]["exp_name"] = "other"
        path.write_text(json.dumps(config))
    found, _ = analysis.robustness.read_robustness(finished(read_runs(tmp_path)))
    tables, sentences = analysis.robustness.analyse_robustness(found)
    assert tables["robustness_score"].frame.empty and not sentences
    assert set(found["exp_name"]) == {"ppo_continuous_noisy", "other"}


def test_a_clean_return_of_zero_is_compared_in_units_of_the_return(tmp_path, capsys):
    zero = {
        config: {
            condition: [value - 100 * (condition == ("", "0.0")) for value in values]
            for condition, values in conditions.items()
        }
        for config, conditions in HOPPER.items()
    }
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    write_tests(tmp_path / "runs", zero, "Maze-v0")
    tables = run(tmp_path, drawn=True)
    push = tables["robustness_score"].query("noise == @PUSH").set_index("environment")
    together = row(tables["robustness_together"], noise=PUSH)
    assert push.loc["Maze-v0", "difference"] == push.loc["Hopper-v5", "difference"] == 13.75
    assert push.loc["Maze-v0", "p"] == push.loc["Hopper-v5", "p"]
    assert together["p"] == pytest.approx(2 / 70**2) and np.isnan(together["score_percent"])
    scores = push.filter(regex="percent$")
    assert scores.loc["Maze-v0"].isna().all()
    assert scores.loc["Hopper-v5"].notna().all()
    text = capsys.readouterr().out
    assert f"all environments together, trained with {PUSH} at rate 1.00: more robust" in text
    assert (tmp_path / "results/robustness_heatmap_PPO_Maze-v0.svg").exists()
