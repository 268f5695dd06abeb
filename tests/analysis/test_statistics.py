"""The statistics of analyze.py: known answers, SciPy's answers, and how often they are wrong."""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import simulate_choose
from scipy import stats

from analysis import statistics

DOCS = Path(__file__).parents[2] / "docs/statistics.md"
NAN, INF = float("nan"), float("inf")


def stacked(*environments):
    """Put samples of several environments side by side: (seeds x envs), NaN where there is none."""
    table = np.full((max(map(len, environments)), len(environments)), NAN)
    for e, values in enumerate(environments):
        table[: len(values), e] = values
    return table


# ---------------------------------------------------------------------------- the permutation test


@pytest.mark.parametrize(
    ("x", "y", "t", "p", "smallest"),
    [
        # The best of 20 divisions, and its mirror image
        ([4, 5, 6], [1, 2, 3], 3 / np.sqrt(2 / 3), 0.1, 0.1),
        # Two values of x lie above: as good are {4, 5, 6} and {3, 5, 6}, of 20, then twice that
        ([3, 5, 6], [1, 2, 4], None, 2 * 2 / 20, 0.1),
        # The one 2 is in x in half of the divisions, and they are all alike
        ([1, 1, 2], [1, 1, 1], 1.0, 1.0, 0.1),
        ([0.1] * 5, [0.1] * 5, 0.0, 1.0, 2 / 252),
        ([6, 6, 6], [5, 5, 5], INF, 0.1, 0.1),
        ([5, 5, 5], [6, 6, 6], -INF, 0.1, 0.1),
        ([1, 2, 3], [0], NAN, NAN, 1.0),
    ],
)
def test_known_answers(x, y, t, p, smallest):
    found = statistics.permutation_t(x, y)
    if t is not None:
        assert found[0] == pytest.approx(t, nan_ok=True)
    assert found[1:] == pytest.approx((p, smallest), nan_ok=True)


@pytest.mark.parametrize(("n", "m"), [(3, 5), (5, 5), (2, 9)])
def test_one_environment_is_scipys_test(n, m):
    """SciPy's is right where not all returns are equal, with p twice the smaller tail."""

    def t(x, y, axis):
        return stats.ttest_ind(x, y, equal_var=False, axis=axis).statistic

    rng = np.random.default_rng(n)
    for shift in (0, 1, 3):
        x, y = rng.normal(shift, 1, n), rng.normal(0, 2, m)
        settings = {"vectorized": True, "n_resamples": np.inf}
        expected = stats.permutation_test((x, y), t, **settings)
        found = statistics.permutation_t(x * 1e9 + 1e12, y * 1e9 + 1e12)  # in any units
        assert found[:2] == pytest.approx((expected.statistic, expected.pvalue), rel=1e-6)


def test_over_environments_every_one_is_divided_on_its_own():
    rng, sizes = np.random.default_rng(0), [(2, 3), (3, 4)]
    for shift in (0, 1, 3):
        x = [rng.normal(shift, 1, n) for n, _ in sizes]
        y = [rng.normal(0, 1, m) for _, m in sizes]
        null = np.zeros(1)
        for a, b in zip(x, y, strict=True):
            values, ts = np.append(a, b), []
            for chosen in combinations(range(len(values)), len(a)):
                split = values[list(chosen)], np.delete(values, chosen)
                ts.append(stats.ttest_ind(*split, equal_var=False).statistic)
            scores = stats.norm.ppf((stats.rankdata(ts) - 0.5) / len(ts))
            null = np.add.outer(null, scores).ravel()
        assert len(null) == 10 * 35
        tails = (null >= null[0] - 1e-9).mean(), (null <= null[0] + 1e-9).mean()
        t, p, smallest = statistics.permutation_t(stacked(*x), stacked(*y))
        assert t == pytest.approx(null[0] / 2) and p == pytest.approx(min(1, 2 * min(tails)))
        assert smallest == pytest.approx(2 / 350)


def test_random_divisions_where_there_are_too_many(monkeypatch):
    """In one environment, in two with the same sizes, and in two of which one has few."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.8, 1, (6, 2)), rng.normal(0, 1, (5, 2))
    cases = [(a[:, :1], b[:, :1]), (a[:4], b[:4]), (stacked(a[:2, 0], a[:, 1]), b)]
    exact = [statistics.permutation_t(*case)[1] for case in cases]
    monkeypatch.setattr(statistics, "MOST_PARTITIONS", 60)
    statistics.partitions.cache_clear()
    drawn = [statistics.permutation_t(*case) for case in cases]
    far = statistics.permutation_t(a + 100, b)
    statistics.partitions.cache_clear()
    ps = [p for _, p, _ in drawn]
    assert ps != exact and ps == pytest.approx(exact, rel=0.1)
    assert far[1:] == (2e-5, 2e-5)  # the actual one and its opposite, never zero


def test_infinite_ts_of_two_environments_cancel():
    x, y = stacked([1, 1, 1], [0, 0, 0]), stacked([0, 0, 0], [1, 1, 1])
    t, p, _ = statistics.permutation_t(x, y)
    assert t == pytest.approx(0) and p == 1
    found = statistics.compare(x, y)
    assert found.p == 1 and np.isnan(found.effect_size)


def test_an_environment_where_runs_hardly_differ_decides_no_more_than_others():
    rng = np.random.default_rng(1)
    worse = [(rng.normal(60, 10, 5), rng.normal(100, 10, 5)) for _ in range(4)]
    for spread in (0, 1e-6, 0.01):
        better = 201 + spread * rng.normal(size=5), 200 + spread * rng.normal(size=5)
        comparison = statistics.compare(
            *(stacked(*side) for side in zip(*worse, better, strict=True))
        )
        assert comparison.t < 0 and comparison.effect_size < -1
        assert comparison.p < 0.01


def test_noise_that_always_solves_what_was_never_solved_is_as_clear_as_can_be():
    x, y = stacked(*5 * [[100] * 5]), stacked(*5 * [[0] * 5])
    comparison = statistics.compare(x, y)
    assert comparison.p == comparison.smallest_p == pytest.approx(2e-5)


# ------------------------------------------------------------------------------------- comparisons


def test_a_comparison_by_hand():
    x, y = np.array([12.0, 13, 14, 15, 16]), np.array([8.0, 9, 11, 12, 10, 10])
    found = statistics.compare(x, y)
    welch = stats.ttest_ind(x, y, equal_var=False)
    assert (found.n, found.n_baseline, found.difference) == (5, 6, 4)
    assert found[5:7] == pytest.approx(welch.confidence_interval(0.95))
    assert found.difference_percent == pytest.approx(40) and found.t == pytest.approx(
        4 / np.sqrt(2.5 / 5 + 2 / 6)
    )
    assert found.effect_size == pytest.approx(4 / np.sqrt((2.5 + 2) / 2))
    # Power: the noncentral t of 9 degrees of freedom, with Welch's standard error
    shift = found.detectable / np.sqrt(2.5 / 5 + 2 / 6)
    assert stats.nct.sf(stats.t.ppf(0.975, 9), 9, shift) == pytest.approx(0.8)
    few = statistics.compare(x[:4], y)
    assert np.isnan(few.difference_low) and few.difference == 3.5
    one = statistics.compare(x[:1], y)
    assert one.difference == 2 and np.isnan([one.p, one.detectable, one.pooled_std]).all()


def test_rounding_errors_are_no_difference():
    """The means of three and of five times 0.95 differ in the last digit."""
    x, y = np.full(3, 0.95), np.full(5, 0.95)
    assert x.mean() != y.mean()
    found = statistics.compare(x, y)
    assert (found.difference, found.effect_size, found.pooled_std, found.p) == (0, 0, 0, 1)
    assert found.seeds_needed == np.inf
    x, y = np.full(5, 0.95), np.full(10, 0.95)
    assert statistics.compare(x, y)[4:7] == (0, 0, 0)  # the difference and its interval
    two = statistics.compare(np.full((3, 2), [0.95, 0.7]), np.full((5, 2), [0.95, 0.7]))
    assert (two.effect_size, two.t, two.p) == (0, 0, 1)
    assert np.isnan(statistics.exact(np.nan, x))


def test_an_iqm_that_may_be_drawn_as_zero_has_no_interval_of_its_change(recwarn):
    x, y = np.array([[0.0, 1, 1, 1, 1]] * 2).T, np.array([[0.0, 0, 1, 1, 1, 1, 1, 1]] * 2).T
    value, low, high = statistics.bootstrap_iqm(x, y)
    assert np.isfinite(value) and np.isnan([low, high]).all() and not recwarn.list


def test_over_environments_effects_are_averaged_and_percent_where_all_have_it():
    x, y = stacked([3.0, 4, 5], [20.0, 40]), stacked([1.0, 2, 3], [10.0, 20, 30, 40])
    found = statistics.compare(x, y)
    effects = 2 / 1, 5 / np.sqrt((200 + 500 / 3) / 2)
    assert found.effect_size == pytest.approx(np.mean(effects)) and np.isnan(found.difference)
    assert (found.environments, found.n, found.n_baseline, found.n_baseline_most) == (2, 2, 3, 4)
    assert np.isnan(found.difference_percent)  # the interval of 1, 2, 3 includes zero
    found = statistics.compare(x[:, 1:] + 90, y[:, 1:] + 90)
    assert found.difference_percent == pytest.approx(100 * 5 / 115)


@pytest.mark.parametrize(
    ("baseline", "percent"),
    [
        ([100, 110, 120], 10 / 1.1),
        ([-100, -110, -120], 10 / 1.1),
        ([1e-9, 1.1e-9, 1.2e-9], 10 / 1.1e-11),  # tiny, but clearly not zero
        ([0, 0, 0], NAN),
        ([-1e-6, 2e-6, 1e-6], NAN),
        ([1, 2, 30], NAN),
        ([5.0], 200),
        ([5, 15], 100),
        ([-5, 15], NAN),
        ([], NAN),
    ],
)
def test_percent_stands_where_the_baseline_is_clearly_not_zero(baseline, percent):
    found = statistics.percent_of(10, np.array(baseline, float))
    assert found == pytest.approx(percent, nan_ok=True)


# ------------------------------------------------------------------------------------------- power


@pytest.mark.parametrize(("n", "m"), [(4, 4), (3, 5), (5, 5), (10, 5), (10, 10), (40, 40)])
def test_the_detectable_shift_is_found_in_80_percent_of_the_cases(n, m):
    rng = np.random.default_rng(3)
    exact = n + m <= 10
    chosen = statistics.partitions(n, m) if exact else statistics.random_partitions(n, m, 999, rng)
    values = rng.standard_normal((n + m, 1500))
    values[:n] += statistics.detectable_shift(n, m)
    above, _ = statistics.tails(statistics.welch_t(values, chosen))
    assert (2 * above <= 0.05 + 1e-12).mean() == pytest.approx(0.8, abs=0.035)


def test_seeds_needed_is_the_first_number_that_finds_the_shift():
    assert np.isnan(statistics.detectable_shift(3, 3))  # the smallest possible p is 0.1
    assert np.isnan(statistics.detectable_shift(4, 4, 0.02))
    for shift in (3.0, 2.0, 1.2):
        n = statistics.seeds_needed(shift)
        assert statistics.detectable_shift(n, n) <= shift
        assert n == 4 or not statistics.detectable_shift(n - 1, n - 1) <= shift
    assert statistics.seeds_needed(0.3) == 176  # as G*Power's t-test
    assert statistics.seeds_needed(0) == INF


# -------------------------------------------------------------------- simulations of the comparison


def lognormal(rng, shape):
    returns = rng.lognormal(0, 0.5, shape)
    mean = np.exp(0.125)
    return (returns - mean) / (mean * np.sqrt(np.exp(0.25) - 1))


RETURNS = {  # all with mean 0 and standard deviation 1
    "normal": simulate_choose.normal,
    "lognormal": lognormal,
    "high peak": simulate_choose.high_peak,
    "low peak": simulate_choose.failing,
}


def simulated(n, draw, spread, draws=2000):
    """Percent of comparisons of equal means, n against n, with p <= 0.05; coverage of intervals."""
    rng = np.random.default_rng(n)
    values = np.concatenate([spread * draw(rng, (n, draws)), draw(rng, (n, draws))])
    chosen = statistics.random_partitions(n, n, 999, rng) if n > 5 else statistics.partitions(n, n)
    shares = statistics.tails(statistics.welch_t(values, chosen))
    x, y = values[:n], values[n:]
    variances = [z.var(axis=0, ddof=1) / n for z in (x, y)]
    _, half = statistics.satterthwaite(variances, np.full((2, 1), n))
    covered = abs(x.mean(axis=0) - y.mean(axis=0)) <= half
    return 100 * (2 * np.minimum(*shares) <= 0.05 + 1e-12).mean(), 100 * covered.mean()


@pytest.mark.slow
def test_mann_whitney_rejects_equal_means_where_the_spread_differs():
    """So it cannot test a difference of means; at a true gain it finds about as much."""
    shares = []
    for name in ("high peak", "low peak"):
        for spread in (0.5, 2):
            rng = np.random.default_rng(25)
            x, y = spread * RETURNS[name](rng, (25, 2000)), RETURNS[name](rng, (25, 2000))
            shares.append(
                100 * (stats.mannwhitneyu(x, y, method="asymptotic").pvalue <= 0.05).mean()
            )
    assert min(shares) > 12 and max(shares) < 15.5
    assert "it rejects in 13 to 15 %" in " ".join(DOCS.read_text().split())
    for draw in RETURNS.values():
        rng = np.random.default_rng(26)
        x, y = draw(rng, (25, 2000)) + 1, draw(rng, (25, 2000))
        theirs = stats.mannwhitneyu(x, y, method="asymptotic").pvalue <= 0.05
        chosen = statistics.random_partitions(25, 25, 999, rng)
        above, _ = statistics.tails(statistics.welch_t(np.concatenate([x, y]), chosen))
        assert (
            theirs.mean() - 0.06 < (2 * above <= 0.05).mean() and (2 * above <= 0.05).mean() > 0.9
        )


@pytest.mark.slow
def test_level_and_coverage_are_those_that_the_page_says():
    page = DOCS.read_text()
    for name, draw in RETURNS.items():
        for spread in (1, 0.5, 2):
            assert simulated(3, draw, spread)[0] == 0  # no p is below 0.1
            [line] = re.findall(rf"^\| {name} \| x {spread} \| (.*) \|$", page, re.MULTILINE)
            said = [float(cell.rstrip(" %")) for cell in line.split(" | ")]
            found = [simulated(n, draw, spread) for n in (5, 10, 25)]
            levels, coverages = zip(*found, strict=True)
            assert said == pytest.approx([*levels, *coverages], abs=0.6), (name, spread)


# --------------------------------------------------------------------- the interval of an IQM


def two_peaked(rng, shape, share, spread):
    """Final returns of which a share lies around 1000, the others around 3000."""
    return rng.normal(np.where(rng.random(shape) < share, 1000, 3000), spread)


DISTRIBUTIONS = {
    "normal": lambda rng, shape: rng.normal(3000, 500, shape),
    "skewed": lambda rng, shape: 2000 * rng.lognormal(0, 0.5, shape),
    "20 % low": lambda rng, shape: two_peaked(rng, shape, 0.2, 300),
}
MIXTURES = {  # the second is as narrow as the peaks of PPO on HalfCheetah
    "40 % low": lambda rng, shape: two_peaked(rng, shape, 0.4, 300),
    "40 % low, narrow": lambda rng, shape: two_peaked(rng, shape, 0.4, 100),
}


def covered(n, intervals, distributions=DISTRIBUTIONS, trials=500):
    """Percent of samples of n seeds whose interval holds the true IQM: the worst distribution."""
    worst = 100.0
    for seed, draw in enumerate(distributions.values()):
        rng = np.random.default_rng(seed)
        truth = statistics.iqm(draw(rng, 400_000))
        low, high = intervals(draw(rng, (trials, n)))
        worst = min(worst, 100 * np.mean((low <= truth) & (truth <= high)))
    return worst


def ours(samples):
    return np.array([statistics.bootstrap_iqm(sample[:, None])[1:] for sample in samples]).T


def scipys(samples, method):
    settings = {"n_resamples": 999, "method": method, "axis": -1, "rng": np.random.default_rng(0)}
    done = stats.bootstrap((samples,), lambda x, axis: stats.trim_mean(x, 0.25, axis), **settings)
    return done.confidence_interval


@pytest.mark.slow
@pytest.mark.parametrize(("n", "usual", "mixtures"), [(3, 94, 75), (5, 96, 85), (10, 95, 89)])
def test_coverage_of_the_iqm_is_what_the_page_says(n, usual, mixtures):
    assert int(covered(n, ours)) == usual
    assert int(covered(n, ours, MIXTURES)) == mixtures
    page = " ".join(DOCS.read_text().split())
    assert f"| {n} | {usual} % | {mixtures} % |" in page


@pytest.mark.slow
def test_coverage_of_the_alternatives_at_five_seeds_is_lower():
    for method in ("percentile", "basic", "BCa"):
        assert covered(5, lambda samples, method=method: scipys(samples, method)) < 93
    assert covered(5, ours) > 93


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DISTRIBUTIONS, *MIXTURES])
def test_noise_that_does_nothing_improves_nothing(name):
    """The IQM of skewed returns is not their mean; no improvement must come of that."""
    rng, draw, found = np.random.default_rng(0), (DISTRIBUTIONS | MIXTURES)[name], []
    for _ in range(200):
        found.append(
            statistics.bootstrap_iqm(draw(rng, (10, 5)), draw(rng, (10, 5)), resamples=200)
        )
    known = np.isfinite(found).all(axis=1)  # a baseline that may be zero has no percent
    estimate, low, high = np.array(found)[known].T
    assert known.mean() > 0.98
    assert abs(estimate.mean()) < 3 * estimate.std() / np.sqrt(len(estimate))
    assert ((low > 0) | (high < 0)).mean() <= 0.08


@pytest.mark.slow
@pytest.mark.parametrize("spread", [500, 50])
def test_ten_noisy_seeds_do_not_make_up_for_three_of_the_baseline(spread):
    """Percent of useless noises said to help or harm: 10 noisy seeds, 3 of the baseline.

    With degrees of freedom of the noisy seeds alone, as is usual, it is 10 and 20 %.
    """
    rng, trials, wrong = np.random.default_rng(0), 500, 0
    for _ in range(trials):
        x, y = rng.normal(3000, spread, (10, 1)), rng.normal(3000, 500, (3, 1))
        _, low, high = statistics.bootstrap_iqm(x, y, resamples=300)
        wrong += low > 0 or high < 0
    assert 100 * wrong / trials <= 7


def test_satterthwaites_interval_of_three_seeds_is_welchs():
    """With three seeds the IQM is the mean, so the bootstrap has a known limit: Welch's interval.

    The baseline's IQM is far from zero: dividing by it then adds nothing.
    """
    x, y = np.array([[10.0], [40.0], [10.0]]), np.array([[0.0], [1.0], [5.0]])
    base = 1e6
    value, low, high = statistics.bootstrap_iqm(x + base, y + base, resamples=400_000)
    welch = stats.ttest_ind(x[:, 0], y[:, 0], equal_var=False).confidence_interval(0.95)
    assert value == pytest.approx(100 * 18 / base, rel=1e-4)
    np.testing.assert_allclose([low, high], 100 * np.array(welch) / base, rtol=0.01)


def test_iqm_is_scipys():
    rng = np.random.default_rng(0)
    for n in range(1, 12):
        scores = rng.normal(size=(2, 3, n))
        expected = stats.trim_mean(scores, 0.25, axis=-1)
        np.testing.assert_allclose(statistics.iqm(scores), expected, rtol=1e-12)
        scores[0, 1, 0] = np.nan
        assert np.isnan(statistics.iqm(scores)).sum() == 1


def test_seeds_that_are_all_alike_have_an_interval_of_one_point():
    assert statistics.bootstrap_iqm(np.full((5, 1), 30.0), np.full((3, 1), 20.0)) == (
        50,
        50,
        50,
    )


def test_an_iqm_has_no_percent_of_what_may_be_zero():
    x, y = np.full((3, 2), 5.0), np.array([[10.0, -1], [11, 1], [12, 2]])
    assert np.isnan(statistics.bootstrap_iqm(x, y)).all()
    assert np.isfinite(statistics.bootstrap_iqm(x[:, :1], y[:, :1])).all()


def test_the_change_of_an_iqm_is_relative_to_the_baselines_iqm():
    """All returns are positive, so it is above -100 %, whatever the baseline's mean is."""
    x, y = np.full((5, 1), 30.0), np.array([[3000.0], [3000], [3000], [3000], [100]])
    assert statistics.bootstrap_iqm(x, y)[0] == pytest.approx(-99)
