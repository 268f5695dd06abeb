"""Robustness in analyze.py: fabricated runs with known returns, tables computed by hand."""

import gzip
import json
import re

import numpy as np
import pandas as pd
import pytest
from sweeps import row, run, write_run

from analysis.folders import RETURN
from analysis.heatmap import heatmaps
from analysis.matrices import matrices
from analysis.robustness import analyse_robustness, is_clean, read_robustness
from analysis.runs import finished, read_runs
from noisy_wrappers import BASELINE, Configuration, split_noises

SENSOR = "RandomNormalNoisyObservation(0.1)"
PUSH = "RandomNormalNoisyAction(0.3)"
REWARD = "RandomNormalNoisyReward(1.0)"
CLEAN = ("", "0.0")
OFFSETS = np.arange(-9, 10, 2)  # of ten episodes from their mean

# Training configuration -> test condition -> mean return of seeds 1 to 4, on Hopper. C is 100.
HOPPER = {
    ("", 0.0): {
        ("", "0.0"): [98, 100, 100, 102],
        (SENSOR, "0.2"): [80, 80, 80, 80],
        (SENSOR, "1.0"): [40, 40, 40, 40],
        (PUSH, "1.0"): [61, 62, 63, 64],
        (REWARD, "1.0"): [98, 100, 100, 102],  # returns are those before noise
        (f"{SENSOR} + {PUSH}", "0.2 + 1.0"): [60, 60, 60, 60],
    },
    (PUSH, 1.0): {
        ("", "0.0"): [90, 90, 90, 90],
        (SENSOR, "0.2"): [86, 87, 88, 89],
        (SENSOR, "1.0"): [60, 60, 60, 60],
        (PUSH, "1.0"): [95, 95, 95, 95],
        (REWARD, "1.0"): [90, 90, 90, 90],
        (f"{SENSOR} + {PUSH}", "0.2 + 1.0"): [75, 75, 75, 75],
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
    assert len(scores) == 2

    push = row(scores, noise=PUSH)  # not under its own noise, nor under that of rewards
    assert push["environment"] == "Hopper-v5"
    assert (push["conditions"], push["conditions_tested"]) == (3, 5)
    assert (push["n"], push["n_baseline"]) == (4, 4)
    # ((86 .. 89) + 60 + 75) / 3 against (80 + 40 + 60) / 3, of a clean 100
    assert push["score_percent"] == pytest.approx(222.5 / 3 - 100)
    assert push["baseline_score_percent"] == pytest.approx(60 - 100)
    assert push["difference"] == pytest.approx(222.5 / 3 - 60)
    assert push["difference"] == pytest.approx(push["difference_percent"])
    assert np.isnan(push["difference_low"])  # four seeds
    assert push["p"] == push["smallest_p"] == pytest.approx(2 / 70)  # C(8, 4) = 70
    assert push["p_holm"] == pytest.approx(2 * 2 / 70)
    assert push["clean_change_percent"] == pytest.approx(-10)

    sensor = row(scores, noise=SENSOR)  # at another rate, and the action noise
    assert sensor["conditions"] == 2 and sensor["score_percent"] == pytest.approx(127.5 / 2 - 100)
    assert sensor["baseline_score_percent"] == pytest.approx(102.5 / 2 - 100)
    assert sensor["clean_change_percent"] == 10

    table = tables["robustness"]
    same = row(table, noise=PUSH, test_noise=PUSH)
    assert same["tested_on"] == "the same noise" and same["mean"] == 95 and same["n"] == 4
    assert same["change_percent"] == pytest.approx(100 * (95 - 62.5) / 62.5)
    wrapper = row(table, noise=SENSOR, test_noise=SENSOR, test_rate="1.00")
    assert wrapper["tested_on"] == "the same wrapper"
    both = row(table, noise=PUSH, test_noise=f"{SENSOR} + {PUSH}")
    assert both["tested_on"] == "the same wrapper" and both["test_rate"] == "0.20 + 1.00"
    new = table[(table["noise"] == PUSH) & (table["test_noise"] == SENSOR)]
    assert set(new["tested_on"]) == {"new noise"}
    assert new["std"].tolist() == pytest.approx([np.std([1, 2, 3, 4], ddof=1), 0])
    clean = table[(table["noise"] == "") & (table["test_noise"].isna())].iloc[0]
    assert clean["tested_on"] == "clean" and clean["mean"] == 100

    text = capsys.readouterr().out
    assert "no clear difference under noise over 3 of 5 test conditions" in text
    few = "(smallest possible: 0.029; too few seeds for an interval)"
    assert f"p = 0.029 {few}, Holm 0.057; clean return -10 %" in text
    assert "% of the clean return without noise), p = 0.029" in text


def test_lopsided_numbers_of_seeds_have_no_verdict(tmp_path, capsys):
    """As for returns: of a noise with several rates from 1.6 times the seeds on, else from 2.6."""
    returns = {CLEAN: [100 + i for i in range(9)], (PUSH, "1.0"): [50 + i for i in range(9)]}
    noisy = {CLEAN: [100 + i for i in range(5)], (PUSH, "1.0"): [80 + i for i in range(5)]}
    write_tests(tmp_path / "runs", {("", 0.0): returns}, "Hopper-v5", range(1, 10))
    write_tests(tmp_path / "runs", {(SENSOR, 0.2): noisy}, "Hopper-v5", range(1, 6))
    alone = row(run(tmp_path)["robustness_score"], noise=SENSOR)
    assert alone["p"] < 0.01 and "returns more under noise over" in capsys.readouterr().out
    write_tests(tmp_path / "runs", {(SENSOR, 0.1): noisy}, "Hopper-v5", range(1, 6))
    scores = run(tmp_path)["robustness_score"]
    untested = scores[["p", "p_holm", "detectable"]].isna()
    assert untested.all(axis=None) and scores["difference_low"].notna().all()
    out = capsys.readouterr().out
    said = "no verdict with 5/9 seeds, which would be wrong too often, over 1 of 1 test condition"
    assert out.count(said) == 2 and "Borderline" not in out
    fewer = {("", 0.0): returns, (SENSOR, 0.2): noisy, (SENSOR, 0.1): noisy}
    write_tests(tmp_path / "runs", fewer, "Maze-v0", range(1, 6))
    run(tmp_path)
    assert capsys.readouterr().out.count("no verdict with 5/5 to 9 seeds, which") == 2


def test_environments_without_any_difference_are_not_averaged(tmp_path, capsys):
    for env, gain in (("Hopper-v5", 20), ("Maze-v0", 0), ("Maze-v1", 0)):
        for config, mean in ((("", 0.0), 0), ((SENSOR, 0.2), gain)):
            returns = [mean + (i / 10 if gain else 0) for i in range(6)]
            tests = {CLEAN: returns, (PUSH, "1.0"): returns}
            write_tests(tmp_path / "runs", {config: tests}, env, range(1, 7))
    assert run(tmp_path)["robustness_together"].empty
    assert "Hopper-v5, trained with RandomNormalNoisyObservation" in capsys.readouterr().out


def test_the_search_of_a_choice_has_no_baseline_to_play(tmp_path, capsys):
    noisy = {(SENSOR, 0.2): {CLEAN: [9], (PUSH, "1.0"): [8]}}
    write_tests(tmp_path / "runs/search", noisy, "Hopper-v5", [1])
    write_tests(tmp_path / "runs/confirmation", {("", 0.0): {CLEAN: [9]}}, "Hopper-v5", [1001])
    run(tmp_path)
    assert "plays what is missing" not in capsys.readouterr().out


def test_tests_elsewhere_never_mix_with_those_at_home(tmp_path):
    """They are rows of their own, and change nothing of the others."""
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    home = run(tmp_path)
    for path in (tmp_path / "runs").glob("*/robustness.csv"):
        header, *lines = path.read_text().splitlines()
        there = [",0.0,0,0.5,7,Heavy-v0", f'"{SENSOR}",0.2,0,0.5,7,Heavy-v0']
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
    assert scores["score_percent"][1] == pytest.approx(100 * (-76 + 50) / 50)  # -52
    assert scores["baseline_score_percent"][1] == pytest.approx(-102)
    assert every["score_percent"] == pytest.approx((222.5 / 3 - 100 - 52) / 2)
    assert np.isnan(every["difference"])  # in two units
    assert every["difference_percent"] == pytest.approx((222.5 / 3 - 60 + 50) / 2)
    assert every["p"] == pytest.approx(2 / (70 * 20)) == every["p_holm"]
    assert every["clean_change_percent"] == pytest.approx((-10 - 20) / 2)
    assert (every["n"], every["conditions"], every["conditions_tested"]) == (3, 4, 6)
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
    assert "on 2 of 3 environments together, trained with" in capsys.readouterr().out
    for env, seeds in (("A-v0", full), ("B-v0", single)):
        write_tests(tmp_path / "two/runs", table, env, seeds)
    scores = run(tmp_path / "two")["robustness_score"]
    assert list(scores["environment"][scores["p_holm"].notna()]) == ["A-v0"]


def test_conditions_and_episodes_that_a_run_lacks_do_not_count(tmp_path, capsys):
    """Episode i begins alike in all tests, so more episodes are other ones."""
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    first, *others = sorted((tmp_path / "runs").glob(f"*{PUSH}*/robustness.csv"))
    lines = first.read_text().splitlines(keepends=True)
    first.write_text("".join(line for line in lines if not line.startswith(f'"{SENSOR}",1.0')))
    push = row(run(tmp_path)["robustness_score"], noise=PUSH)
    assert push["conditions"] == 2 and push["difference"] == (87.5 + 75) / 2 - (80 + 60) / 2
    assert "lack some of the 6 test conditions" in capsys.readouterr().out
    for path in (first, *others):
        lines = path.read_text().splitlines(keepends=True)
        first_four = [line for line in lines if not re.search(r",[4-9],[^,]+,1000", line)]
        path.write_text("".join(first_four))
    again = row(run(tmp_path)["robustness_score"], noise=PUSH)
    assert again["difference"] == push["difference"]  # all means are lower by as much
    assert "the first 4 count, which begin alike" in capsys.readouterr().out


def test_damaged_and_unfinished_runs(tmp_path, capsys):
    """They do not count."""
    write_tests(tmp_path / "runs", HOPPER, "Hopper-v5")
    damaged, unfinished, *_ = (tmp_path / "runs").glob(f"*{PUSH}*")
    path = damaged / "robustness.csv"
    packed = bytearray(gzip.compress(path.read_bytes()))
    packed[60:63] = bytes(255 - byte for byte in packed[60:63])
    (damaged / "robustness.csv.gz").write_bytes(packed)
    path.unlink()
    (unfinished / "result.json").unlink()
    assert row(run(tmp_path)["robustness_score"], noise=PUSH)["n"] == 2
    said = f"{damaged.name} has no tests of robustness: robustness.csv.gz: "
    assert said in capsys.readouterr().out


def test_policies_that_nothing_is_compared_with_are_told(tmp_path):
    write_tests(tmp_path, HOPPER, "Hopper-v5")
    write_tests(tmp_path, HOPPER, "A-v0")
    for path in tmp_path.glob("A-v0*baseline*/robustness.csv"):
        path.unlink()
    _, sentences = tables_of(tmp_path)
    assert "PPO on A-v0: 2 training configurations not compared" in sentences[-1]


def tables_of(runs_dir):
    """Return the tables of the tests of a folder of runs, and their sentences."""
    found, _ = read_robustness(finished(read_runs(runs_dir)))
    return analyse_robustness(found)


def test_heatmap(tmp_path):
    write_tests(tmp_path, HOPPER, "Hopper-v5")
    tables, _ = tables_of(tmp_path)
    [(*_, draw)] = heatmaps(tables["robustness"].frame, RETURN)
    ax = draw().axes[0]
    rows = [label.get_text().replace("\n", "") for label in ax.get_yticklabels()]
    columns = [label.get_text().replace("\n", "") for label in ax.get_xticklabels()]
    assert rows == ["no noise", f"{PUSH}, 1.00", f"{SENSOR}, 0.20"]
    assert columns[0] == "clean" and f"{SENSOR}, 0.20" in columns
    numbers = {text.get_position(): text.get_text() for text in ax.texts}
    assert numbers[columns.index(f"{SENSOR}, 0.20"), 1] == "-12"  # 87.5, of 100
    assert numbers[columns.index("clean"), 2] == "+10"
    dots = {tuple(np.round(line.get_xydata()[0] + (-0.36, 0.28)).astype(int)) for line in ax.lines}
    same = {(columns.index(f"{PUSH}, 1.00"), 1), (columns.index(f"{SENSOR}, 0.20"), 2)}
    assert dots == same


def test_robustness_of_another_experiment_is_apart(tmp_path):
    write_tests(tmp_path, {config: HOPPER[config] for config in (("", 0.0), (PUSH, 1.0))}, "A-v0")
    for path in tmp_path.glob(f"*{PUSH}*/config.json"):
        config = json.loads(path.read_text())
        config["args"]["exp_name"] = "other"
        path.write_text(json.dumps(config))
    tables, sentences = tables_of(tmp_path)
    assert tables["robustness_score"].frame.empty and "evaluate.py" in sentences[0]
    assert set(tables["robustness"].frame["exp_name"]) == {"ppo_continuous_noisy", "other"}


def test_a_clean_return_of_zero_is_compared_in_units_of_the_return(tmp_path):
    """Without the tests under noise on rewards, which would be no clean ones then."""
    table = {c: {t: v for t, v in HOPPER[c].items() if t[0] != REWARD} for c in HOPPER}
    zero = {
        config: {test: np.array(values) - 100 * (test == CLEAN) for test, values in tests.items()}
        for config, tests in table.items()
    }
    write_tests(tmp_path / "runs", table, "Hopper-v5")
    write_tests(tmp_path / "runs", zero, "Maze-v0")
    tables = run(tmp_path)
    push = tables["robustness_score"].query("noise == @PUSH").set_index("environment")
    assert push.loc["Maze-v0", "difference"] == push.loc["Hopper-v5", "difference"]
    assert push.loc["Maze-v0", "p"] == push.loc["Hopper-v5", "p"]
    scores = push.filter(regex="percent$")
    assert scores.loc["Maze-v0"].isna().all() and scores.loc["Hopper-v5"].notna().all()
    together = row(tables["robustness_together"], noise=PUSH)
    assert together["p"] == pytest.approx(2 / 70**2) and np.isnan(together["score_percent"])


# Two noises with one number each

MASS, FIELD = "RandomDynamics({0}, {0})", "fields=('dof_damping',)"


def conditions(*noises, rate=1.0):
    return [Configuration.read(split_noises(noise), [rate]) for noise in noises]


def test_conditions_of_two_noises_are_a_matrix_with_the_single_ones_as_edges():
    pairs = [(mass, delay) for mass in (0.7, 1.3) for delay in (2, 1)]
    inner = [f"{MASS.format(mass)} + RandomActionDelay({delay})" for mass, delay in pairs[:-1]]
    single = ["RandomActionDelay(1)", "RandomActionDelay(4)", MASS.format(1.3), SENSOR]
    single += ["RandomDynamics(0.7, 1.3)", f"RandomDynamics(0.7, 0.7, {FIELD})"]
    [matrix] = matrices([BASELINE, *conditions(*inner, *single)])
    assert matrix.name == "RandomDynamics(x, x) + RandomActionDelay(y)"
    values = {condition: str(condition) for condition in matrix.cells.values()}
    frame = matrix.frame(values)
    assert list(frame.index) == ["none", "x = 0.7", "x = 1.3"]
    assert list(frame.columns) == ["none", "y = 1", "y = 2", "y = 4"]
    text = "RandomDynamics(1.3, 1.3) + RandomActionDelay(2) at 1.0 + 1.0"
    assert frame.loc["x = 1.3", "y = 2"] == text and frame.loc["none", "none"] == "no noise"
    assert frame.loc["none", "y = 4"] == "RandomActionDelay(4) at 1.0"
    assert len(values) == 7  # three pairs, three alone, the clean one


def test_matrices_are_told_apart_by_rates_and_by_arguments_with_names():
    damping = f"RandomDynamics({{0}}, {{0}}, {FIELD})"
    noises = [f"{MASS.format(x)} + {damping.format(y)}" for x in (1, 2) for y in (1, 3)]
    half = conditions(*noises, rate=0.5)
    [first, second] = matrices([*conditions(*noises), *half])
    assert first.name == f"RandomDynamics(x, x) + RandomDynamics(y, y, {FIELD})"
    assert second.noises[0] == "RandomDynamics(x, x) at rate 0.5"
    assert set(second.cells.values()) == set(half)
    one_delay = [f"{MASS.format(x)} + RandomActionDelay(1)" for x in (1, 2, 3)]
    ranges = [f"RandomDynamics(0.5, {x}) + RandomActionDelay({x})" for x in (1, 2)]
    assert matrices(conditions(*one_delay, *ranges)) == []


def test_heatmap_of_a_matrix(tmp_path):
    means = {}  # 10 * mass - delay; twice that where masses were random in training
    for mass in (0, 1, 2):
        for delay in (0, 1, 2):
            parts = [MASS.format(mass)] * (mass > 0) + [f"RandomActionDelay({delay})"] * (delay > 0)
            rates = " + ".join(["1.0"] * len(parts)) or "0.0"
            means[" + ".join(parts), rates] = [10 * mass - delay] * 2
    means.pop((f"{MASS.format(2)} + RandomActionDelay(2)", "1.0 + 1.0"))
    twice = {test: [2 * value for value in values] for test, values in means.items()}
    table = {("", 0.0): means, ("RandomDynamics(0.5, 2.0)", 1.0): twice}
    write_tests(tmp_path, table, "Hopper-v5", (1, 2))
    tables, _ = tables_of(tmp_path)
    _, (*_, draw) = heatmaps(tables["robustness"].frame, RETURN)
    *panels, _ = draw(6.75).axes
    for ax, factor in zip(panels, (1, 2), strict=True):
        shown = ax.images[0].get_array().filled(np.nan)
        expected = factor * (10.0 * np.arange(3)[:, None] - np.arange(3))
        expected[2, 2] = np.nan
        np.testing.assert_array_equal(shown, expected)
        assert ax.images[0].get_clim() == (-4, 40)


def test_a_harmless_noise_is_a_test_condition():
    """Where all episodes end alike it looks like the clean test, and is none."""
    harmless = Configuration.read([PUSH], [1.0])
    assert not is_clean(harmless) and is_clean(Configuration())
    assert not is_clean(Configuration.read(["RandomEarlyTermination(50)"], [1.0]))
    assert is_clean(Configuration.read(["RandomNormalNoisyReward(1.0)"], [1.0]))
    assert not is_clean(Configuration(("mine:OfRewards(1)",), ((1.0, 1.0),)))
