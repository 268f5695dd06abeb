"""The study's numbers by hand, its rules with known answers, its tables from the committed runs."""

import io
import json

import numpy as np
import pandas as pd
import pytest
import sweeps
from scipy import stats

from analysis.statistics import fieller
from results.study import __main__, baselines, claims, compare, paper, physics, returns

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
        ([(3, 0.051)], 1, all, "undecided"),
        ([(-3, 0.01)], 1, all, "contradicted"),
        ([(-3, 0.01)], -1, all, "confirmed"),
        ([(3, 0.01), (1, 0.5)], 1, all, "undecided"),
        ([(3, 0.01), (1, 0.5)], 1, any, "confirmed"),
        ([(3, 0.01), (-1, 0.01)], 1, all, "contradicted"),
        ([(3, 0.01), (-1, 0.01)], 1, any, "confirmed"),
        ([(-3, 0.01), (-1, 0.5)], 1, any, "undecided"),
        ([(-3, 0.01), (-1, 0.01)], 1, any, "contradicted"),
        ([(3, float("nan"))], 1, all, "undecided"),
    ],
)
def test_verdicts_have_known_answers(tests, claimed, of, expected):
    assert compare.judge_claim(tests, claimed, of) == expected


@pytest.mark.parametrize(
    ("effect", "p", "word"),
    [(1, 0.05, "helps"), (-1, 0.05, "harms"), (-1, 0.06, "undecided")],
)
def test_the_rule_of_the_plans(effect, p, word):
    assert compare.in_words(effect, p) == word


def test_a_row_says_whether_the_papers_value_is_covered():
    effect = [(20.4, 0.01)]
    inside, outside = (
        claims.row("c", "page", paper, (20.4, -5.2, 30), effect, "5 + 5", after=True)
        for paper in (-5, 31)
    )
    assert inside == {
        "claim": "c*",
        "the paper": "-5 %",
        "ours [95 %]": "+20 % [-5, 30]",
        "covered": "yes",
        "verdict": "confirmed",
        "runs": "[5 + 5][page]",
    }
    assert outside["covered"] == "no"


def test_separated_samples_have_the_smallest_p_possible():
    x, y = np.array([5.0, 6, 7, 9]), np.array([1.0, 2, 3, 4.5])
    assert compare.permutation_p(x, y) == pytest.approx(2 / 70)
    assert compare.mann_whitney_p(x, y) == pytest.approx(2 / 70)
    assert compare.joint_p([(x, y)]) == pytest.approx(2 / 70, abs=0.002)
    assert compare.joint_p([(x[:3], y[:3]), (x[1:], y[1:])]) == pytest.approx(2 / 400, abs=0.001)
    assert compare.joint_p([(x, y), (y, x)]) == pytest.approx(1)


def test_holm_by_hand():
    assert compare.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert compare.holm([0.5, 0.9]) == pytest.approx([1, 1])


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


def write_physics(folder, env_id, training, seed, final, changed):
    """Write a run of set D: two episodes of a test, whose mean is `changed` under other physics."""
    path = write_run(folder, final, training, seed=seed, env_id=env_id)
    rows = ["noise,noise_rate,episode,episodic_return,episodic_length"]
    for test, noise in physics.NOISES.items():
        mean = changed + test - 1 if test in physics.CHANGED else final
        for episode, offset in enumerate((-1, 1)):
            rows.append(f'"{noise}",{1.0 if noise else 0.0},{episode},{mean + offset},9')
        rows.append(f'"{noise}",0.5,0,1e9,9')  # another rate: not in the plan
    (path / "robustness.csv").write_text("\n".join(rows) + "\n")
    return path


def test_physics(data, tmp_path, monkeypatch):
    """With dynamics in training, 10 less in the clean environment and 50 more in a changed one."""
    monkeypatch.setattr(physics, "ENVIRONMENTS", ["Hopper", "Pusher"])
    gains = {"": (0, 0), physics.DYNAMICS: (-10, 50)} | dict.fromkeys(physics.CHEAP, (0, 40))
    gains[physics.CHEAP[1]] = 0, 60
    assert physics.tables() == {}
    for seed in range(1, 6):
        assert physics.read_tests().empty == (seed < 3)  # one seed alone has no deviation
        for env_id, level in {"Hopper-v5": 100, "Pusher-v5": -100}.items():
            for training, (clean, changed) in gains.items():
                values = level + seed + clean, level + seed + changed
                path = write_physics(data / "physics", env_id, training, seed, *values)
    (path / "robustness.csv").unlink()  # of the last seed, in one environment: it is not whole
    tests = physics.read_tests()
    assert list(tests.index) == [(e, s) for e in ("Hopper", "Pusher") for s in range(1, 5)]

    shown = physics.by_training(tests).set_index(["environment", "trained with"])
    assert shown["clean"]["Hopper", "no noise"] == "102.5 ± 1.3" and set(shown["n"]) == {4}
    assert shown["factor 0.7"]["Pusher", physics.DYNAMICS] == "-47.8 ± 1.3"
    assert shown["changed physics"]["Pusher", physics.DYNAMICS] == "-47.5 ± 1.3"
    assert shown["delay 2"]["Hopper", physics.DYNAMICS] == "92.5 ± 1.3"

    clean, gain, more = physics.questions(tests).to_dict("records")
    assert clean["seeds"] == 4
    without = 102.5, 97.5  # |mean return| without noise
    assert clean["change_percent"] == pytest.approx(np.mean([-1000 / mean for mean in without]))
    assert gain["change_percent"] == pytest.approx(np.mean([5000 / mean for mean in without]))
    assert more["change_percent"] == pytest.approx(0)
    assert clean["p"] == pytest.approx(2 / 70**2, abs=2e-4) and more["p"] > 0.9
    assert clean["holm"] == pytest.approx(3 * clean["p"])
    assert [row["verdict"] for row in (clean, gain, more)] == ["harms", "helps", "undecided"]

    physics.draw(tests, tmp_path / "a.svg")
    physics.draw(tests, tmp_path / "b.svg")
    drawn = (tmp_path / "a.svg").read_bytes()
    assert drawn == (tmp_path / "b.svg").read_bytes()
    assert b"Hopper" in drawn and b"Pusher" in drawn and b"no noise" in drawn


@pytest.mark.slow
def test_the_study_agrees_with_the_finished_one():
    """Another program computed the finished tables: its p, standard errors and percent are here."""
    theirs = pd.read_csv(returns.RESULTS / "tables/baselines.csv")
    sac = theirs[theirs["baseline"] == "SAC on HalfCheetah-v5"].iloc[0]
    ours = baselines.sac_and_td3().query("algorithm == 'SAC' and steps == 1_000_000")
    assert list(ours["p"]) == pytest.approx([sac["paper_p"], sac["cleanrl_p"]], rel=1e-4)
    assert list(ours["se"]) == pytest.approx([sac["paper_se"], sac["cleanrl_se"]], rel=1e-4)
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


def test_an_interval_that_does_not_exist_is_left_out():
    ours = claims.row("c", "page", 5, (10.0, np.nan, np.nan), [(10, 0.5)], "5 + 5")
    assert (ours["ours [95 %]"], ours["covered"]) == ("+10 %", "–")


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


def test_set_e_is_judged_by_its_looks():
    """Numbers of plans.md: p against the look's level, then t against the limit of futility."""
    rows = [
        (10, 0.0000011, 5.0, "harms"),
        (10, 0.0072, 3.2, "under way"),
        (11, 0.0000001, 9.0, "under way"),  # no look
        (20, 0.0008, 0.29, "undecided"),
        (20, 0.0008, 0.31, "under way"),
        (30, 0.0074, 2.8, "harms"),
        (40, 0.0221, 1.29, "undecided"),
        (50, 0.0424, 2.03, "undecided"),
    ]
    table = pd.DataFrame(
        [
            {"n": n, "p": p, "difference": -t, "sd": np.sqrt(n / 2), "sd_without": np.sqrt(n / 2)}
            for n, p, t, _ in rows
        ]
    )
    verdicts = compare.in_looks(table.assign(verdict=""))["verdict"]
    assert list(verdicts) == [verdict for *_, verdict in rows]
