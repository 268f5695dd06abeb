"""The study's numbers by hand, its rules with known answers, its tables from the committed runs."""

import io
import json
import re
from collections import Counter

import numpy as np
import pandas as pd
import pytest
import sweeps
from scipy import stats

from analysis.permutation import permutation_t
from analysis.statistics import fieller
from results import recompute
from results.study import __main__, claims, compare, paper, picture, returns

NOISE = "RandomNormalNoisyReward(1.0)"
SCALE = "RandomUniformScaleReward(0.5, 1.5)"


def write_run(folder, test, noise="", rate=1.0, seed=1, env_id="Hopper-v5"):
    """Write what the study reads of a run: tests of 0 and `test` at steps 10 and 20."""
    noises = {"noise": noise, "rate": rate} if noise else {}
    more = {"seed": seed, "env": env_id, "every": 10, "folder": f"{noise}-{rate}-{seed}-{env_id}"}
    path = sweeps.write_run(folder, [0.0, test], "PPO", **noises, **more)
    result = {"final_return_mean": test, "train_return_mean_last_100": 0.0}
    (path / "result.json").write_text(json.dumps(result))
    return path


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Return a folder that the study takes for results/data."""
    monkeypatch.setattr(returns, "DATA", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("tests", "claimed", "of", "expected"),
    [
        ([], 1, all, "not tested"),
        ([(3, 0.05)], 1, all, "confirmed"),
        ([(-3, 0.01)], 1, all, "contradicted"),
        ([(3, 0.01), (1, 0.5)], 1, all, "undecided"),
        ([(3, 0.01), (-1, 0.01)], 1, all, "contradicted"),
        ([(3, 0.01), (-1, 0.01)], 1, any, "confirmed"),
        ([(-3, 0.01), (-1, 0.5)], 1, any, "undecided"),
        ([(-3, 0.01), (-1, 0.01)], 1, any, "contradicted"),
        ([(3, float("nan"))], 1, all, "undecided"),
    ],
)
def test_verdicts_have_known_answers(tests, claimed, of, expected):
    assert compare.judge_claim(tests, claimed, of) == expected


def test_the_rule_of_the_plans():
    cases = [(1, 0.05), (-1, 0.05), (-1, 0.06)]
    assert [compare.in_words(*case) for case in cases] == ["helps", "harms", "undecided"]


def test_a_row_says_whether_the_papers_value_is_covered():
    effect = [(20.4, 0.01)]
    row = claims.row("c", "page", -5, (20.4, -5.2, 30), effect, "5 + 5", after=True)
    assert list(row.values()) == [
        "c*",
        "-5 %",
        "+20 % [-5, 30]",
        "yes",
        "confirmed",
        "[5 + 5][page]",
    ]
    row = claims.row("c", "page", 31, (20.4, -5.2, 30), effect, "5 + 5")
    assert row["covered"] == "no"
    row = claims.row("c", "page", 5, (10.0, np.nan, np.nan), [(10, 0.5)], "5 + 5")
    assert (row["ours [95 %]"], row["covered"]) == ("+10 %", "–")  # no interval exists


def test_separated_samples_have_the_smallest_p_possible():
    x, y = np.array([5.0, 6, 7, 9]), np.array([1.0, 2, 3, 4.5])
    assert compare.permutation_p(x, y) == pytest.approx(2 / 70)
    assert compare.mann_whitney_p(x, y) == pytest.approx(2 / 70)
    assert compare.joint_p([(x, y)]) == pytest.approx(2 / 70, abs=0.002)
    assert compare.joint_p([(x[:3], y[:3]), (x[1:], y[1:])]) == pytest.approx(2 / 400, abs=0.001)
    assert compare.joint_p([(x, y), (y, x)]) == pytest.approx(1)


def test_a_comparison_by_hand():
    x, y = np.array([-3.0, -5, -4]), np.array([-8.0, -12, -10, -10])
    found = compare.compare(x, y, compare.mann_whitney_p)
    interval = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    assert (found["n"], found["mean"], found["sd"]) == (3, -4, 1)
    assert (found["n_without"], found["mean_without"]) == (4, -10)
    assert found["difference"] == 6 and found["difference_percent"] == pytest.approx(60)
    assert (found["low"], found["high"]) == pytest.approx(tuple(interval))
    assert (found["low_percent"], found["high_percent"]) == fieller(x, y)
    assert found["p"] == pytest.approx(2 / 35)


def test_the_average_change_has_fiellers_interval_and_the_declared_test():
    """Over environments the distances of the limits add up as the sides of a right angle do."""
    x, y = np.array([3.0, 5, 4, 9]), np.array([8.0, 12, 10])
    change, low, high, p = compare.average_change([(x, y)])
    assert [change, low, high] == pytest.approx([-47.5, *fieller(x, y)])
    assert p == pytest.approx(stats.ttest_ind(x, y, equal_var=False).pvalue)  # Welch's
    twice = compare.average_change([(x, y), (x, y)])
    expected = [change, change - (change - low) / np.sqrt(2), change + (high - change) / np.sqrt(2)]
    assert twice[:3] == pytest.approx(expected)


def test_no_average_of_positive_returns_is_below_minus_100_percent():
    x, y = np.array([0.1, 0.2, 4.0]), np.array([8.0, 12, 10, 11])
    assert compare.average_change([(x, y)])[1] == -100


def test_a_set_is_compared_by_environment_and_together(data):
    for seed in range(1, 5):
        for env_id in ("Hopper-v5", "Pusher-v5"):
            write_run(data / "set", 100.0 + seed, seed=seed, env_id=env_id)
            write_run(data / "set", 50.0 + seed, NOISE, seed=seed, env_id=env_id)
        write_run(data / "set", 7.0, seed=seed, env_id="Humanoid-v5")  # no noise: no row
    write_run(data / "set", 1e6, NOISE, seed=5)  # no whole seed
    table = compare.comparisons(returns.read_returns("set")).set_index("environment")
    assert list(table.index) == ["Hopper", "Pusher", "together"]
    assert list(table["n"])[:2] == [4, 4] and table["difference"]["Hopper"] == -50
    assert table["p"]["Pusher"] == pytest.approx(2 / 70)
    assert table["holm"]["Pusher"] == pytest.approx(4 / 70)
    assert list(table["verdict"]) == ["undecided", "undecided", "harms"]
    assert table["difference_percent"]["together"] == pytest.approx(-50 / 1.025)


def test_reading_runs(data):
    write_run(data / "a", 3.0, NOISE, rate=0.01)
    write_run(data / "a", 4.0, seed=2)
    write_run(data / "b", 4.0, seed=2)
    write_run(data / "b", 5.0, seed=3)
    runs = returns.read_returns("a", "b")
    assert len(runs) == 4 and set(runs["algorithm"]) == {"PPO"}
    once = returns.each_run_once(runs)
    assert list(returns.select(once, "PPO", "Hopper")) == [4, 5]
    assert list(returns.select(once, "PPO", "Hopper", NOISE, "0.01")) == [3]
    assert list(returns.read_returns("a", step=10)["test"]) == [0, 0]


@pytest.mark.slow
def test_the_study_agrees_with_the_finished_one():
    """Another program computed the finished tables: its p, intervals and percent are here."""
    table = pd.read_csv(returns.RESULTS / "tables/early_termination.csv", index_col=0)
    row = table.loc["terminated at 50, none: fresh seeds 11 to 30"]
    runs = returns.read_returns("runs").query("11 <= seed <= 30")
    noise = "RandomEarlyTermination(50)", "1.0"
    samples = (returns.select(runs, "PPO", "Pusher", *config) for config in (noise, ()))
    found = compare.compare(*samples, compare.mann_whitney_p)
    assert f"{found['difference_percent']:+.1f} %" == row["change"]
    assert "{difference:+.1f} [{low:.1f}, {high:.1f}]".format(**found) == row["difference [95 %]"]
    assert f"{found['p']:.2g}" == f"{row['p']:.2g}"


@pytest.mark.slow
def test_committed_tables_are_those_of_the_committed_runs():
    for name, table in __main__.tables().items():
        computed = pd.read_csv(io.StringIO(__main__.as_csv(table)))
        committed = pd.read_csv(returns.RESULTS / f"tables/{name}.csv")
        pd.testing.assert_frame_equal(computed, committed, rtol=1e-3, atol=0.1, obj=name)


def test_the_papers_tables_stand_beside_ours(tmp_path):
    """Rows match by noise as run; a difference needs equal steps."""
    mixup = "RandomMixupObservation(0.5, recursive=True)"
    rng = np.random.default_rng(0)
    for seed in range(5):
        for config in ({}, {"noise": mixup, "rate": 0.05}, {"noise": SCALE, "rate": 0.05}):
            curve = 3000 + 500 * rng.normal(size=100)
            sweeps.write_run(tmp_path, curve, env="Hopper-v5", seed=seed, **config)
        sweeps.write_run(tmp_path, [5.0] * 5, env="Walker2d-v5", exp_name="short", seed=seed)
    tables = paper.tables_of(tmp_path)
    both = sweeps.row(tables["best"], environment="Hopper-v5", noise=mixup)
    assert (both["n"], both["paper_mean"], both["paper_std"]) == (5, 3597.2, 164.6)
    error = np.sqrt(both["std"] ** 2 / 5 + 164.6**2 / 5)
    assert both["difference_se"] == pytest.approx((both["mean"] - 3597.2) / error)
    short = sweeps.row(tables["best"], environment="Walker2d-v5", exp_name="short", noise="")
    assert short["mean"] == 5 and np.isnan(short["difference_se"])
    early = tables["early_performance"]
    half = sweeps.row(early, environment="Hopper-v5", noise_rate="0.05", steps_millions=0.4)
    assert half["paper_mean"] == 2863 and half["n"] == 5 and np.isfinite(half["difference_se"])
    assert len(early) == 75 and len(tables["consistent"]) == 29  # the paper's rows


def runs_of_a_set(n, change, spread=1.0, seed=0):
    """Return n seeds a side whose means differ by exactly `change` and deviate by `spread`."""
    rng = np.random.default_rng(seed)
    rows = []
    for noise, mean in (("", 100.0), (SCALE, 100.0 + change)):
        for block in range(0, n, 10):  # so the means are exact at every look
            values = rng.normal(size=min(10, n - block))
            values = (values - values.mean()) / values.std() * spread + mean
            for i, value in enumerate(values):
                rate = "0.05" if noise else ""
                row = {"algorithm": "PPO", "environment": "Walker2d", "steps": 1_000_000}
                row |= {"noise": noise, "rate": rate, "seed": 101 + block + i, "test": value}
                rows.append(row)
    return pd.DataFrame(rows)


@pytest.mark.parametrize(
    ("n", "change", "verdicts"),
    [
        (10, 0.0, ["under way"]),  # the first look has no limit
        (10, 9.0, ["under way"]),  # and its p is never small enough: 2 / 184,756 at least
        (20, -1.5, ["under way", "harms"]),
        (20, 0.05, ["under way", "undecided"]),
        (20, 0.5, ["under way", "under way"]),
        (23, -1.5, ["under way", "harms"]),  # what comes after the decision does not count
        (30, 0.1, ["under way", "under way", "undecided"]),
        (30, 0.9, ["under way", "under way", "helps"]),
        (50, 0.39, 4 * ["under way"] + ["undecided"]),
        (50, -0.45, 4 * ["under way"] + ["harms"]),
    ],
)
def test_a_set_with_looks_ends_at_the_one_that_decides(n, change, verdicts, monkeypatch):
    """Runs of both directions: better, worse, too little hope, and going on."""
    monkeypatch.setattr(compare, "SHUFFLES", 20_000)
    runs = runs_of_a_set(n, change)
    half = runs.iloc[[0]].assign(seed=999)  # a seed with one side only
    table = compare.in_looks(pd.concat([runs, half]))
    assert list(table["verdict"]) == verdicts
    assert list(table["n"]) == [*[k for k in compare.LOOKS if k <= n], n][: len(verdicts)]
    looks = table[table["n"].isin(compare.LOOKS)]
    assert list(looks["level"]) == [compare.LOOKS[k][0] for k in looks["n"]]


def test_the_levels_of_set_e_stand_in_its_plan():
    plan = (returns.RESULTS / "plans.md").read_text().split("## E. ")[1]
    rows = [line.strip("| ").split(" | ") for line in plan.splitlines() if line.startswith("| ")]
    seeds, levels, least = rows[:3]
    assert list(map(int, seeds[1:])) == list(compare.LOOKS)
    assert [float(text) for text in levels[1:]] == [p for p, _ in compare.LOOKS.values()]
    assert [float(text) for text in least[2:5]] == [t for _, t in compare.LOOKS.values()][1:4]


def test_a_set_of_several_environments_is_compared_as_analyze_does(data):
    """One verdict a noise, over environments; two noises are corrected for each other."""
    (data / "set").mkdir()
    assert compare.by_the_tool("set", 2, 6, 6).empty
    rng = np.random.default_rng(0)
    for env_id, level in {"Hopper-v5": 100, "Pusher-v5": -50}.items():
        for noise, change in (("", 0), (NOISE, 0), (SCALE, -9)):
            for seed in range(201, 207):
                tests = level + change + rng.normal(size=10)
                named = {"noise": noise, "rate": 1.0} if noise else {}
                sweeps.write_run(data / "set", tests, "PPO", env_id, seed=seed, **named)
    table = compare.by_the_tool("set", 2, 6, 6).set_index(["environment", "noise"])
    assert len(table) == 6 and set(table["n"]) == {6}
    assert table["verdict"]["together", SCALE] == "harms"
    assert table["verdict"]["together", NOISE] == "undecided"
    assert table["holm"]["together", SCALE] == pytest.approx(2 * table["p"]["together", SCALE])
    assert table["difference_percent"]["Hopper", SCALE] == pytest.approx(-9, abs=1)
    assert pd.isna(table["verdict"]["Hopper", SCALE])
    for planned in ((3, 6, 6), (2, 8, 6), (2, 6, 9)):
        table = compare.by_the_tool("set", *planned)
        assert set(table["verdict"].dropna()) == {"under way"}


def permutation_p_of(pairs):
    """The p of the tool's test over environments, which takes arrays with a row for each seed."""
    x, y = (np.full((8, len(pairs)), np.nan) for _ in range(2))
    for e, samples in enumerate(pairs):
        for side, values in zip((x, y), samples, strict=True):
            side[: len(values), e] = values
    return permutation_t(x, y)[1]


def test_the_second_computation_has_its_own_statistics():
    rng = np.random.default_rng(0)
    x, y = rng.normal(5, 1, 6), rng.normal(4, 2, 8)
    assert recompute.tail(2.0, 7.3) == pytest.approx(stats.t.sf(2.0, 7.3), rel=1e-6)
    assert recompute.quantile(4.2) == pytest.approx(stats.t.ppf(0.975, 4.2), rel=1e-5)
    assert recompute.fieller(x, y)[1:] == pytest.approx(fieller(x, y), rel=1e-4)
    assert recompute.mann_whitney(x, y) == pytest.approx(compare.mann_whitney_p(x, y))
    assert recompute.one(x, y) == pytest.approx(compare.permutation_p(x, y), rel=1e-9)
    assert recompute.average([(x, y)] * 2) == pytest.approx(
        compare.average_change([(x, y)] * 2)[:3], rel=1e-4
    )
    pairs = [(x, y), (x[:5], y[:5] + 1)]
    assert recompute.in_scores(pairs) == pytest.approx(permutation_p_of(pairs), rel=0.05)
    assert recompute.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_a_number_that_differs_is_found(monkeypatch):
    monkeypatch.setattr(recompute, "wrong", [])
    monkeypatch.setattr(recompute, "checked", Counter())
    row = {"a": "-1,259 [-1,769, -748]", "p": "2.8e-11", "b": "", "c": "-0 %"}
    recompute.check("t", row, "a", -1259.4, -1768.6, -748.0)
    recompute.check("t", row, "p", 2.83e-11)
    recompute.check("t", row, "b", np.nan, np.nan)
    recompute.check("t", row, "c", -0.4)
    assert recompute.wrong == []
    recompute.check("t", row, "a", -1259.4, -1767.0, -748.0)
    recompute.check("t", row, "p", 2.87e-11)
    recompute.check("t", row, "b", 1.0)
    assert len(recompute.wrong) == 3


@pytest.mark.slow
def test_the_tables_are_right_by_the_second_computation(capsys):
    status, out = recompute.main(), capsys.readouterr().out
    assert status == 0 and re.search(r"^0 of 1\d{3} numbers in 22 tables differ$", out, re.M), out


def test_the_picture_of_the_first_page():
    table = pd.read_csv(returns.RESULTS / "tables/claims.csv")
    table.columns = ["claim", "paper", "ours", "covered", "verdict", "runs"]
    best = picture.best_noises(table)
    gains = {name: row.paper for name, row in best.items()}
    paper = {"HalfCheetah": "+36 %", "Hopper": "+28 %", "Humanoid": "+3 %", "Pusher": "+20 %"}
    assert gains == paper | {"Walker2d": "+90 %"}
    assert best["Hopper"].claim.endswith(", fresh")


def test_the_pictures_are_those_of_the_tables(tmp_path):
    for name, fig in picture.pictures().items():
        fig.savefig(tmp_path / "drawn.svg", metadata={"Date": None})
        committed = (returns.RESULTS / f"figures/{name}.svg").read_bytes()
        assert (tmp_path / "drawn.svg").read_bytes() == committed, name
