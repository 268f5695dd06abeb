"""The pages of results: they are what their scripts write, and their numbers are right."""

import json

import ablation
import common
import data_readme
import further_tables
import future_work
import harmful
import helpful
import numpy as np
import pandas as pd
import paper_tables
import pytest
import readme
import reconstruction
import reward_scale
import robustness
from gymnasium.wrappers import NormalizeReward
from scipy import stats

from analysis.paper import read_paper, with_luck
from analysis.runs import read_runs
from analysis.statistics import detectable_shift

pytestmark = pytest.mark.slow  # they read the committed runs again

RESULTS, DATA = common.RESULTS, common.DATA


@pytest.mark.parametrize(
    ("script", "path"),
    [
        (readme, "README.md"),
        (ablation, "ablation.md"),
        (data_readme, "data/README.md"),
        (future_work, "future_work.md"),
        (reconstruction, "reconstruction.md"),
        (robustness, "robustness.md"),
    ],
)
def test_a_page_is_what_its_command_writes(script, path):
    assert (RESULTS / path).read_text() == script.page()


def test_further_tables_are_what_their_command_writes():
    for name, table in further_tables.tables().items():
        written = table.to_csv(index=False, float_format=further_tables.DIGITS)
        assert (RESULTS / f"tables/{name}.csv").read_text() == written, name


def test_further_tables_by_hand():
    """Some cells from the runs and the paper's tables themselves."""
    tables = {
        name: pd.read_csv(RESULTS / f"tables/{name}.csv", index_col=0)
        for name in ("ppo_best_noises", "paper_steps_to_baseline", "baselines")
    }
    ppo = tables["ppo_best_noises"].loc["Pusher"]
    returns = [
        [
            json.loads(path.read_text())["final_return_mean"]
            for seed in range(1, 11)
            for path in DATA.glob(f"runs/Pusher-v5__ppo_*__{noise}__{seed}/result.json")
        ]
        for noise in ("baseline", "*EarlyTermination_50_p1.0")
    ]
    assert [len(column) for column in returns] == [10, 10]
    without, noisy = np.array(returns)
    assert ppo["gain"] == pytest.approx(noisy.mean() - without.mean(), rel=1e-5)
    assert ppo["paper_gain"] == pytest.approx(57.6 - 45.9)
    spreads = without.std(ddof=1), noisy.std(ddof=1)
    assert (ppo["std_without"], ppo["std_with"]) == pytest.approx(spreads, rel=1e-5)
    assert (ppo["steps_without"], ppo["steps_with"]) == (900_000, 150_000)
    steps = tables["paper_steps_to_baseline"].loc["Walker2d-v2"]
    assert steps["p_0.00"] == 0.8 and np.isnan(steps["p_0.01"]) and steps["p_0.05"] == 0.6
    p = stats.ttest_ind_from_stats(without.mean(), spreads[0], 10, -57.6, 14.1, 10, False).pvalue
    assert tables["baselines"].loc["PPO on Pusher-v5", "paper_p"] == pytest.approx(p, rel=1e-2)


def test_an_interaction_that_would_be_seen_is_about_as_large_as_the_noises_gain():
    found = future_work.numbers()["together"]
    assert found["detectable"] == pytest.approx(found["gain"], rel=0.02)  # "about as much as"


def test_the_choice_on_the_page_is_that_of_the_runs():
    """choice.csv follows from the run folders, and the winner from its last round."""
    found = future_work.choice()
    runs = common.read_returns(DATA / "choice")
    fresh = runs[runs["seed"] > 1000]
    x, y = (fresh.loc[fresh["noise"] == noise, "test"] for noise in (found["winner"], ""))
    assert len(x) == len(y) == 10
    assert found["p"] == pytest.approx(stats.mannwhitneyu(x, y, method="exact").pvalue)
    assert found["search"]["runs"] + found["confirmation"]["runs"] == len(runs) == 61


def test_the_robustness_on_the_page_is_that_of_the_episodes():
    """Scores and their difference by hand: the noises that the policies were not trained with."""
    tables = []
    for path in (DATA / "robustness").glob("*/robustness.csv.gz"):
        environment, _, trained_with, seed = path.parent.name.split("__")
        table = pd.read_csv(path, keep_default_na=False)
        assert table.groupby(["noise", "noise_rate"]).size().tolist() == 10 * [100]
        tables.append(table.assign(environment=environment, trained_with=trained_with, seed=seed))
    assert len(tables) == 90
    episodes = pd.concat(tables)
    baseline = episodes[episodes["trained_with"] == "baseline"]
    clean = baseline[baseline["noise"] == ""].groupby("environment")["episodic_return"].mean()

    def score(policies, noises):
        tested = policies[policies["noise"].str.split("(").str[0].isin(noises)]
        returns = tested.groupby("environment")["episodic_return"].mean()
        return (100 * (returns - clean) / clean.abs()).mean()

    def ratio_of_means(policies, noises):
        tested = policies[policies["noise"].str.split("(").str[0].isin(noises)]
        own = policies[policies["noise"] == ""].groupby("environment")["episodic_return"].mean()
        means = tested.groupby("environment")["episodic_return"].mean()
        return 100 * (means / own).mean()

    def kept(policies, noises):
        tested = policies[policies["noise"].str.split("(").str[0].isin(noises)]
        policy = ["environment", "seed"]
        own = policies[policies["noise"] == ""].groupby(policy)["episodic_return"].mean()
        shares = tested.groupby(policy)["episodic_return"].mean() / own
        return 100 * shares.groupby("environment").mean().mean()

    numbers = robustness.numbers()
    found, shares = numbers["unseen"], numbers["kept"]
    dropout, observation, action = (
        "RandomDropoutObservation",
        "RandomNormalNoisyObservation",
        "RandomNormalNoisyAction",
    )
    for name, own, noises in (
        ("observation noise", observation, [action, dropout]),
        ("action noise", action, [observation, dropout]),
    ):
        noisy = episodes[episodes["trained_with"].str.startswith(own)]
        assert found[name]["score"] == pytest.approx(score(noisy, noises))
        difference = score(noisy, noises) - score(baseline, noises)
        assert found[name]["difference"] == pytest.approx(difference)
        assert shares[name]["share"] == pytest.approx(kept(noisy, noises))
        assert shares[name]["of_means"] == pytest.approx(ratio_of_means(noisy, noises))
        assert shares[name]["baseline_of_means"] == pytest.approx(ratio_of_means(baseline, noises))
        assert shares[name]["baseline_share"] == pytest.approx(kept(baseline, noises))


# ----------------------------------------------------------------------------------- statistics


def test_welch_is_scipys():
    rng = np.random.default_rng(0)
    runs = pd.DataFrame({"environment": ["a"] * 5 + ["b"] * 7, "test": rng.normal(size=12)})
    other = runs.assign(test=rng.normal(size=12))
    x, y = common.sample(runs, "test"), common.sample(other, "test")
    errors, p = common.welch(x, y)
    for i, name in enumerate("ab"):
        pair = [table.loc[table["environment"] == name, "test"] for table in (runs, other)]
        expected = stats.ttest_ind(*pair, equal_var=False)
        assert p[i] == pytest.approx(expected.pvalue)
        assert errors.iloc[i] == pytest.approx(expected.statistic)


def test_power_is_that_of_the_test():
    """Without an effect it is the level of the exact test, which is 0.043 for ten against ten."""
    assert helpful.power(0, 1, 10, 1, 10) == pytest.approx(0.043, abs=0.012)
    assert helpful.power(3, 1, 10, 1, 10) > 0.99
    assert helpful.power(50 * detectable_shift(10, 10), 50, 10, 50, 10) == pytest.approx(
        0.8, abs=0.03
    )
    assert 0.02 < helpful.power_of_levene(1, 10) < 0.06 and helpful.power_of_levene(9, 10) > 0.9


def test_digits_shown_of_a_power_are_those_of_a_million_samples():
    """Of 2,000 samples they were 0.33 and 0.36."""
    assert helpful.power_of_levene(0.5, 10) == pytest.approx(0.308, abs=0.003)
    for n in (5, 10):
        assert detectable_shift(n, n) == pytest.approx(shift_of_many_samples(n), rel=0.004)


def shift_of_many_samples(n):
    """The shift that is found with 80 % power, from the power of two shifts beside it."""
    shifts = np.array([0.99, 1.01]) * detectable_shift(n, n)
    powers = [helpful.power(shift, 1, n, 1, n) for shift in shifts]
    return np.interp(0.8, powers, shifts)


# ------------------------------------------------------------------------------- which runs count


def make_runs(seeds_of_noise, shift=0.0):
    """Runs of PPO on Pusher: seed s has the return -50 - s % 10 + 20 (+ shift from seed 11 on)."""
    rows = [
        ("PPO", "Pusher", noise, "1.00" if noise else "0.00", seed, value)
        for noise, seeds, gain in seeds_of_noise
        for seed in seeds
        for value in [-50.0 - seed % 10 + gain + (shift if noise and seed > 10 else 0)]
    ]
    names = ["algorithm", "environment", "noise", "noise_rate", "seed", "test"]
    return pd.DataFrame(rows, columns=names)


def test_fresh_seeds_are_apart_and_only_whole_sets_are_shown():
    runs = make_runs([("", range(1, 31), 0), (helpful.ENDING, range(1, 31), 20)], shift=-20)
    found = helpful.pusher(runs)
    assert set(found["p"]) == {"fixed", "fresh", "all"}
    assert found["p"]["fixed"] < 1e-4 and found["p"]["fresh"] == pytest.approx(1)
    assert found["percent"]["fixed"] == pytest.approx(100 * 20 / 54.5)
    assert found["percent"]["fresh"] == pytest.approx(0)
    incomplete = helpful.pusher(runs[runs["seed"] != 30])
    assert set(incomplete["p"]) == {"fixed"}
    truncated = make_runs([(helpful.TRUNCATING, range(1, 21), 20)])
    found = helpful.pusher(pd.concat([runs, truncated]))
    assert set(found["p"]) == {"fixed", "fresh", "all", "truncated", "ways"}
    assert found["p"]["truncated"] < 1e-4


def test_the_five_comparisons_stay_on_seeds_1_to_10():
    runs = make_runs([("", range(1, 31), 0), (helpful.ENDING, range(1, 31), 20), ("N(1)", [1], 5)])
    kept = helpful.fixed_beforehand(runs, [("Pusher", helpful.ENDING, "1.00")])
    assert set(kept["seed"]) == set(range(1, 11)) and set(kept["noise"]) == {"", helpful.ENDING}
    other = helpful.fixed_beforehand(runs, [("Hopper", helpful.ENDING, "1.00")])
    assert set(other["noise"]) == {""} and len(other) == 10


def test_the_sets_of_runs_are_whole():
    """The page names the seeds of each comparison; a run that is lost must not go unnoticed."""
    runs = common.read_returns(DATA / "runs")
    few, cheetah = common.FEW_SEEDS, [*common.FIXED_SEEDS, *helpful.CHEETAH_SEEDS]
    expected = [
        ("PPO", "HalfCheetah", "", "0.00", cheetah),
        ("TD3", "HalfCheetah", "", "0.00", few),
    ]
    expected += [("TD3", "HalfCheetah", harmful.NORMAL, rate, few) for rate in ("0.01", "1.00")]
    for noise, environments in harmful.WORSE.items():
        expected += [("PPO", environment, noise, "1.00", few) for environment in environments]
    keys = ["algorithm", "environment", "noise", "noise_rate"]
    found = runs.groupby(keys)["seed"].apply(sorted)
    for *key, seeds in expected:
        assert found[tuple(key)] == list(seeds), key


def test_worse_noises_by_hand(monkeypatch):
    """Runs of 10 become 5, 8 and 12 in three environments: changes of -50, -20 and +20 %."""
    plain_mixup = "RandomMixupObservation(0.0)"
    rows = [
        ("PPO", name, noise, rate, seed, value + seed / 1e6)
        for name, noisy in (("HalfCheetah", 5.0), ("Pusher", 8.0), ("Walker2d", 12.0))
        for noise, rate, seeds, value in (
            ("", "0.00", range(1, 11), 10.0),
            (plain_mixup, "1.00", range(1, 6), noisy),
            (plain_mixup, "0.50", range(1, 6), -1e6),
        )
        for seed in seeds
    ]
    runs = pd.DataFrame(rows, columns=list(make_runs([]).columns))
    paper = read_paper(RESULTS / "paper")
    monkeypatch.setattr(harmful, "WORSE", {plain_mixup: harmful.WORSE[plain_mixup]})
    found = harmful.worse_noises(runs, paper)
    assert found[plain_mixup]["average"] == pytest.approx(-50 / 3, abs=1e-3)
    assert found[plain_mixup]["lowest"] == ["HalfCheetah", "Pusher"]
    # U is 0 + 0 + 50 of 150: the null is the sum of three independent Mann-Whitney statistics
    draws = np.random.default_rng(0).permuted(np.tile(np.arange(15), (3 * 40_000, 1)), axis=1)
    u = (draws[:, :5, None] > draws[:, None, 5:]).sum(axis=(1, 2)).reshape(3, -1).sum(axis=0)
    assert found[plain_mixup]["p"] == pytest.approx(2 * (u <= 50).mean(), abs=0.01)
    cells = [cell.strip() for cell in found["table"].splitlines()[-1].split("|")]
    assert cells[2:9] == ["-50 %", "–", "–", "-20 %", "+20 %", "-17 ± 35 %", "–"]


def test_the_two_mixtures_by_hand():
    """-50, -20 and +20 % with a memory, 10 points less without; all weigh alike."""
    rows = [
        ("PPO", name, noise, rate, seed, 10.0 + gain + spread * (seed - 3))
        for name, change in (("HalfCheetah", -5.0), ("Pusher", -2.0), ("Walker2d", 2.0))
        for noise, rate, seeds, gain, spread in (
            ("", "0.00", range(1, 31), 0.0, 0.0),
            (harmful.MIXUP, "1.00", range(1, 6), change, 0.1),
            (harmful.PLAIN_MIXUP, "1.00", range(1, 6), change - 1, 0.2),
        )
        for seed in seeds
    ]
    paper = read_paper(RESULTS / "paper")
    found = reconstruction.mixtures(pd.DataFrame(rows, columns=list(make_runs([]).columns)), paper)
    assert found["recursive"] == pytest.approx(-50 / 3)
    assert found["plain"] == pytest.approx(-80 / 3) and found["difference"] == pytest.approx(10)
    assert found["needed"] == pytest.approx((5 * -76.4 + 80) / 2)  # the paper has -76.4 on average
    error = np.sqrt(3 * (1 + 4) * 2.5 / 5) / 3  # in percent: the variance of 1 ... 5 is 2.5
    df = 15**2 / (3 * (1 + 16) / 4)
    half = stats.t.ppf(0.975, df) * error
    assert found["low"] == pytest.approx(10 - half) and found["high"] == pytest.approx(10 + half)


def test_td3_with_noise_is_compared_on_halfcheetah_and_five_seeds():
    paper = read_paper(RESULTS / "paper")
    names = ["environment", "noise", "noise_rate", "seed", "test"]
    here, other = "HalfCheetah", "Hopper"
    rows = [(here, "", "0.00", seed, 100.0 + seed) for seed in range(1, 7)]
    rows += [(here, harmful.NORMAL, "1.00", seed, 50.0 + seed) for seed in range(1, 6)]
    rows += [(here, harmful.NORMAL, "0.01", seed, 101.5 + seed) for seed in range(1, 6)]
    rows += [(other, harmful.NORMAL, "0.01", seed, 50.0 + seed) for seed in range(1, 6)]
    found = harmful.td3(pd.DataFrame(rows, columns=names), paper)
    assert "-33 ± 15 %" in found["table"] and "-92 ± 7 %" in found["table"]
    assert found["0.01"]["percent"] == pytest.approx(100 * 1.5 / 103)
    assert found["1.00"]["percent"] == pytest.approx(100 * -50 / 103)
    assert found["1.00"]["p"] == pytest.approx(2 / 252)


def test_runs_that_end_far_above_the_rest_by_hand():
    """Of 50 runs one ends at 5,000: it is in the first ten of 20 that are drawn, or is not."""
    runs = make_runs([("", range(1, 51), 0), ("RandomUniformNoisyReward(1)", range(1, 11), 0)])
    runs["environment"], runs["test"] = "HalfCheetah", 1000 - runs["seed"] / 1e6
    runs.loc[(runs["noise"] == "") & (runs["seed"] == 3), "test"] = 5000
    found = helpful.half_cheetah(runs, 30)
    assert found["fixed"]["count"] == 1 and found["tops"] == [5000]
    assert found["fixed"]["high"] == pytest.approx(44.5, abs=0.1)  # 1 of 10, Clopper and Pearson
    assert found["percent_of_rest"] == pytest.approx(0, abs=1e-3)
    assert found["all"]["percent"] == pytest.approx(100 * (1000 / 1080 - 1), abs=1e-3)
    assert found["fresh"]["count"] == found["between"] == 0
    assert found["fresh"]["high"] == pytest.approx(100 * (1 - 0.025 ** (1 / 40)))
    assert found["luck"] == pytest.approx(100 * 10 / 50, abs=1.5)
    assert helpful.half_cheetah(runs, 41)["luck"] == 0
    for seed, value in ((11, 4000.0), (12, 3500.0), (13, 1750.0), (14, 2500.0), (15, 6000.0)):
        runs.loc[(runs["noise"] == "") & (runs["seed"] == seed), "test"] = value
    found = helpful.half_cheetah(runs, 30)  # a run above 3,000 is not between the groups as well
    assert (found["fresh"]["count"], found["between"], found["just_above"]) == (3, 2, [1750])


def test_the_interval_of_a_difference_is_scipys():
    rng = np.random.default_rng(0)
    x, y = rng.normal(5, 1, 7), rng.normal(3, 2, 4)
    samples = [
        pd.DataFrame({"mean": [a.mean()], "std": [a.std(ddof=1)], "n": [len(a)]}) for a in (x, y)
    ]
    low, high = common.welch_interval(*samples)
    expected = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    assert (low[0], high[0]) == pytest.approx((expected.low, expected.high))


def test_noise_and_baseline_of_a_seed_share_their_commit():
    """So that no change of the code can be taken for an effect, in the comparisons fixed before."""
    runs = read_runs(DATA / "runs").query("algorithm == 'PPO' and seed <= 10")
    late = runs["noise"].isin(
        [harmful.NORMAL, helpful.TRUNCATING, harmful.MIXUP, harmful.PLAIN_MIXUP]
    )
    runs = runs[~late].assign(
        commit=[
            json.loads((DATA / "runs" / run / "config.json").read_text())["git_commit"]
            for run in runs.loc[~late, "run"]
        ]
    )
    commits = runs.groupby(["environment", "seed"])["commit"]
    assert len(commits) == 50 and (commits.size() == 2).all() and (commits.nunique() == 1).all()


def test_the_luck_of_the_winners_spread():
    """The best of useless noises with ten times the spread is easily as good as the paper's."""
    paper = read_paper(RESULTS / "paper")
    alike = paper["best"].assign(noisy_std=paper["best"]["baseline_std"])
    p = with_luck(paper)[0]["best"]["p_luck"].min()
    assert paper_tables.luck_with_the_winners_spread({"best": alike})["p"] == pytest.approx(
        p, abs=0.03
    )
    wide = paper["best"].assign(noisy_std=10 * paper["best"]["baseline_std"])
    assert paper_tables.luck_with_the_winners_spread({"best": wide})["p"] > 0.9


# ---------------------------------------------------------------------- what the paper's tables say


def test_what_the_papers_tables_say_by_hand():
    paper = read_paper(RESULTS / "paper")
    found = paper_tables.rates(paper)
    assert [found[name]["count"] for name in found] == [6, 3, 14]
    assert found["best"]["p"] == pytest.approx(stats.binomtest(6, 15, 1 / 6).pvalue)
    found = reconstruction.mixture(paper)["TD3"]
    assert found["fifth"] == pytest.approx(5 * -269.8 + 400)
    assert found["std_then"] == pytest.approx((found["fifth"] + 100) / -np.sqrt(5))
    assert found["std_then"] == pytest.approx(found["std"], rel=0.01)
    kinds = paper_tables.kinds(paper)
    assert kinds["counts"]["PPO"] == {"observation": 0, "reward": 4, "dynamics": 1}
    assert kinds["fisher"] == pytest.approx({"observation": 2 / 252, "reward": 12 / 252})
    chance = paper_tables.kinds_by_chance(paper).set_index(["algorithm", "kind"])["p_at_least"]
    assert chance["PPO", "reward"] == pytest.approx(5 * (1 / 3) ** 4 * (2 / 3) + (1 / 3) ** 5)
    assert chance["TD3", "observation"] == pytest.approx((8 / 15) ** 5)
    spread = paper_tables.spread_tests(paper).set_index(["algorithm", "environment"])
    f = spread.loc[("SAC", "Humanoid-v2")]
    assert f["f_p"] == pytest.approx(2 * stats.f.cdf((129 / 1913.1) ** 2, 4, 4))
    assert f["f_p_holm"] == pytest.approx(15 * f["f_p"])
    worse = paper_tables.worse_everywhere(paper)
    assert worse["of"]["RandomNormalNoisyObservation(1.0)"] == 3 + 5 + 6
    assert (worse["at_every_rate"], worse["next"]) == (1, 5)


def test_a_noise_in_all_three_algorithms_by_luck():
    """P(consistent at one of six rates) cubed; a single rate has 6/32."""
    found = paper_tables.scaled_rewards(read_paper(RESULTS / "paper"))
    assert (6 / 32) ** 3 < found["this"] / 100 < 0.7**3
    assert found["this"] < found["any"] < 15 * found["this"]


# ------------------------------------------------------------------------------- the reward's scale


def test_the_reward_scale_is_gymnasiums(monkeypatch):
    """The sum that begins anew at termination is the one that NormalizeReward keeps."""
    monkeypatch.setattr(reward_scale, "STEPS", 250)
    kept = []

    class Recorded(NormalizeReward):
        def step(self, action):
            result = super().step(action)
            kept.append(float(self.discounted_reward[0]))
            return result

    def wrapped(env, noises, rates):
        return Recorded(reward_scale_make_noisy(env, noises, rates), gamma=reward_scale.GAMMA)

    reward_scale_make_noisy = reward_scale.make_noisy
    plain = reward_scale.discounted_returns(reward_scale.NOISES[1])
    assert plain["terminated"] == plain["any end"]
    truncated = reward_scale.discounted_returns(reward_scale.NOISES[2])
    assert truncated["any end"] == plain["any end"] != truncated["terminated"]
    monkeypatch.setattr(reward_scale, "make_noisy", wrapped)
    reward_scale.discounted_returns(reward_scale.NOISES[2])
    np.testing.assert_allclose(kept, truncated["terminated"], rtol=1e-5)
