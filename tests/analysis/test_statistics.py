"""The statistics of analyze.py: known answers, SciPy's answers, and how often they are wrong."""

import re
from itertools import combinations
from math import nan, sqrt

import numpy as np
import pytest
import simulate_choose
from scipy import stats
from sweeps import ROOT

from analysis import permutation, statistics
from analysis.power import detectable_shift
from analysis.verdicts import MOST_RATIO_OF_RATES, is_lopsided

DOCS = ROOT / "docs/statistics.md"
NAN, INF = float("nan"), float("inf")


def stacked(*environments):
    """Put samples of several environments side by side: (seeds x envs), NaN where there is none."""
    table = np.full((max(map(len, environments)), len(environments)), NAN)
    for e, values in enumerate(environments):
        table[: len(values), e] = values
    return table


def cells_of(page, line):
    """Return the numbers in the cells of a table's line that begins so."""
    [cells] = re.findall(rf"^\| {line} \| (.*) \|$", page, re.MULTILINE)
    return [float(cell.rstrip(" %")) for cell in cells.split(" | ")]


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
    monkeypatch.setattr(permutation, "MOST_PARTITIONS", 60)
    permutation.partitions.cache_clear()
    drawn = [statistics.permutation_t(*case) for case in cases]
    far = statistics.permutation_t(a + 100, b)
    permutation.partitions.cache_clear()
    ps = [p for _, p, _ in drawn]
    assert ps != exact and ps == pytest.approx(exact, rel=0.1)
    assert far[1:] == (2e-5, 2e-5)  # the actual one and its opposite, never zero


# ------------------------------------------------------------------------------------- comparisons


def test_a_comparison_by_hand():
    x, y = np.array([12.0, 13, 14, 15, 16]), np.array([8.0, 9, 11, 12, 10, 10])
    found = statistics.compare(x, y)
    welch = stats.ttest_ind(x, y, equal_var=False)
    assert (found.n, found.n_baseline, found.difference) == (5, 6, 4)
    limits = found.difference_low, found.difference_high
    assert limits == pytest.approx(welch.confidence_interval(0.95))
    assert found.t == pytest.approx(4 / sqrt(2.5 / 5 + 2 / 6))
    assert found.difference_percent == pytest.approx(40)
    look = statistics.compare(x, y, level=0.001)  # of a sequence: the repeated interval
    limits = look.difference_low, look.difference_high
    assert limits == pytest.approx(welch.confidence_interval(0.999)) and look.p == found.p
    assert (look.percent_low, look.percent_high) == statistics.fieller(x, y, 0.001)
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
    x, y = np.full(5, 0.95), np.full(10, 0.95)
    assert statistics.compare(x, y)[4:7] == (0, 0, 0)  # the difference and its interval
    two = statistics.compare(np.full((3, 2), [0.95, 0.7]), np.full((5, 2), [0.95, 0.7]))
    assert (two.effect_size, two.t, two.p) == (0, 0, 1)
    assert np.isnan(statistics.exact(np.nan, x))


def test_over_environments_effects_are_averaged_and_percent_where_all_have_it():
    x, y = stacked([3.0, 4, 5], [20.0, 40]), stacked([1.0, 2, 3], [10.0, 20, 30, 40])
    found = statistics.compare(x, y)
    effects = 2 / 1, 5 / np.sqrt((200 + 500 / 3) / 2)
    assert found.effect_size == pytest.approx(np.mean(effects)) and np.isnan(found.difference)
    assert (found.environments, found.n, found.n_baseline, found.n_baseline_most) == (2, 2, 3, 4)
    assert np.isnan(found.difference_percent)  # the interval of 1, 2, 3 includes zero
    found = statistics.compare(x[:, 1:] + 90, y[:, 1:] + 90)
    assert found.difference_percent == pytest.approx(100 * 5 / 115)


# ------------------------------------------------------------------------------------- percentages


@pytest.mark.parametrize(
    ("baseline", "others", "percent"),
    [
        ([100, 110, 120], [], 10 / 1.1),
        ([-100, -110, -120], [], 10 / 1.1),
        ([1e-9, 1.1e-9, 1.2e-9], [], 10 / 1.1e-11),  # tiny, but clearly not zero
        ([0.5, 0.6, 0.7], [0.9, 1.0], 10 / 0.006),  # returns between 0 and 1
        ([0, 0, 0], [], NAN),
        ([-1e-6, 2e-6, 1e-6], [], NAN),
        ([1, 2, 30], [], NAN),
        ([5.0], [], 200),
        ([5, 15], [], 100),
        ([-5, 15], [], NAN),
        ([], [1.0], NAN),
        # Clearly not zero, but small beside what the returns span
        ([-1e-5, -1.1e-5, -1.2e-5], [92.0], NAN),
        ([9.9, 10, 10.1], [109.8], 100),
        ([9.9, 10, 10.1], [110.1], NAN),
        ([-9.9, -10, -10.1], [-110.1], NAN),
    ],
)
def test_percent_stands_where_the_baseline_is_large(baseline, others, percent):
    found = statistics.percent_of(10, np.array(baseline, float), others)
    assert found == pytest.approx(percent, nan_ok=True)


def test_fiellers_limits_by_hand():
    """mean x = 16, variance 10 / 5; mean y = 10, variance 2.5 / 5.

    At the ratio 1.6 the variances are 2 and 1.28, so there are 3.28^2 / (4 / 4 + 1.6384 / 4) =
    7.632 degrees of freedom, for which t = 2.32539 and t^2 = 5.40743. The limits of the ratio are
    (160 +- sqrt(160^2 - (256 - 2 t^2) (100 - t^2 / 2))) / (100 - t^2 / 2)
    = (160 +- sqrt(25600 - 245.18514 * 97.29628)) / 97.29628 = (160 +- 41.7618) / 97.29628.
    """
    x, y = np.array([12.0, 14, 16, 18, 20]), np.array([8.0, 9, 10, 11, 12])
    limits = 100 * ((160 - 41.7618) / 97.29628 - 1), 100 * ((160 + 41.7618) / 97.29628 - 1)
    assert statistics.fieller(x, y) == pytest.approx(limits, abs=0.01)
    assert statistics.fieller(-x, -y) == pytest.approx((-limits[1], -limits[0]), abs=0.01)
    found = statistics.compare(x, y)
    assert (found.percent_low, found.percent_high) == statistics.fieller(x, y)
    # An exact baseline: Welch's limits in percent of it
    low, high = stats.ttest_1samp(x, 0).confidence_interval(0.95)
    exact = statistics.fieller(x, np.full(5, 10.0))
    assert exact == pytest.approx((10 * low - 100, 10 * high - 100))


def test_two_intervals_never_disagree_about_zero():
    """Their degrees of freedom differ: Fieller's would be from 9.9 to 320 %."""
    x, y = np.array([46.4, 260.6, 170.2, 247.2, 154.0]), np.array([76.8, 66, 89.8, 87.7, 41.9])
    found = statistics.compare(x, y)
    assert statistics.fieller(x, y)[0] > 0 > found.difference_low
    assert np.isnan([found.percent_low, found.percent_high]).all() and found.difference_percent > 99


def test_fiellers_interval_is_cut_or_does_not_exist():
    x, y = np.array([0.1, 0.2, 4.0]), np.array([8.0, 12, 10, 11])
    assert statistics.fieller(x, y)[0] == -100  # positive returns
    assert statistics.fieller(x - 1, y)[0] < -100
    unbounded, nearly = np.array([1.0, 30, 5, 2, 3]), np.array([10.0, 18.5, 1, 5, 8])
    assert np.isnan(statistics.fieller(y, unbounded)).all()
    assert np.isnan(statistics.fieller(y, nearly)).all()  # it would reach beyond 1,000 %
    assert np.isnan(statistics.fieller(x, np.array([-1.0, 1.0]))).all()


# ------------------------------------------------------------------------------- rates of success


def test_seeds_that_all_succeed_are_no_proof():
    """(50 + 1) / (50 + 2) of the episodes, with one success and one failure more."""
    x, y = np.full(5, 100.0), np.full(5, 0.0)
    _, error, low, high = statistics.contrast([x, x], [1, -1], episodes=10)
    assert error == pytest.approx(100 * sqrt(2 * 51 / 52 * 1 / 52 / 52))
    assert low < 0 < high
    found = statistics.compare(x, y, episodes=10)
    assert found.difference_low < 100 == found.difference_high  # no more than 100 points
    assert np.isnan(found.difference_percent)
    assert found.effect_size == pytest.approx(100 / (error * sqrt(5 / 2)))  # not infinite
    spread = np.array([20.0, 50, 80, 90, 10])  # the seeds' own variance is larger
    assert statistics.variance_of_mean(spread, 10) == spread.var(ddof=1) / 5


@pytest.mark.slow
def test_coverage_of_success_is_what_the_page_says():
    rng = np.random.default_rng(0)

    def alike(rate, n):
        return 10.0 * rng.binomial(10, rate, n)

    def spread(rate, n):  # as if five episodes of a seed decided for all
        return 10.0 * rng.binomial(10, rng.beta(5 * rate, 5 - 5 * rate, n))

    page = DOCS.read_text()
    for name, draw in (("alike", alike), ("differ", spread)):
        for with_noise, without in ((0.97, 0.97), (0.99, 0.9), (0.97, 0.8)):
            cells = []
            for n in (3, 5, 10):
                inside = 0
                for _ in range(1000):
                    samples = draw(with_noise, n), draw(without, n)
                    _, _, low, high = statistics.contrast(samples, [1, -1], episodes=10)
                    inside += low - 1e-9 <= 100 * (with_noise - without) <= high + 1e-9
                cells.append(inside / 10)
            line = f"{name} \\| {100 * with_noise:.0f} % and {100 * without:.0f} %"
            assert cells_of(page, line) == pytest.approx(cells, abs=2), line


# ------------------------------------------------------------------------------ what a run returns


@pytest.mark.parametrize(
    ("steps", "values", "expected"),
    [
        ([100], [7], 7),
        (range(10, 101, 10), range(10), 8.5),  # those at 90 and 100
        (range(5, 101, 5), range(20), 18),  # 90, 95, 100: 85 is not in the last 15 %
        ([10, 50, 100], [1, 2, 3], 3),
        ([10, 33, 36, 40], [1, 2, 3, 4], 3.5),  # ended by itself at 40
    ],
)
def test_a_run_counts_with_its_last_tests(steps, values, expected):
    found = statistics.final_value(np.array(steps), np.array(values, float))
    assert found == pytest.approx(expected)


def test_a_curve_reaches_a_target_with_the_runs_that_are_there():
    curves = np.array([[1.0, 3], [4, 6], [9, nan]])
    assert statistics.steps_to_reach(curves, [10, 20, 30], 5) == 20
    assert statistics.steps_to_reach(curves, [10, 20, 30], 9) == 30
    assert np.isnan(statistics.steps_to_reach(curves, [10, 20, 30], 10))


# ------------------------------------------------------------------------------------------- power


def divisions(n, m, rng):
    """Return all divisions into n and m values, or 999 random ones where there are many."""
    few = n + m <= 10
    return permutation.partitions(n, m) if few else permutation.random_partitions(n, m, 999, rng)


@pytest.mark.parametrize(("n", "m"), [(4, 4), (3, 5), (5, 5), (10, 5), (10, 10), (40, 40)])
def test_the_detectable_shift_is_found_in_80_percent_of_the_cases(n, m):
    rng = np.random.default_rng(3)
    chosen = divisions(n, m, rng)
    values = rng.standard_normal((n + m, 1500))
    values[:n] += statistics.detectable_shift(n, m)
    above, _ = permutation.tails(permutation.welch_t(values, chosen))
    assert (2 * above <= 0.05 + 1e-12).mean() == pytest.approx(0.8, abs=0.035)


def test_what_no_number_of_seeds_can_show():
    assert np.isnan(detectable_shift(3, 3))  # the smallest possible p is 0.1
    assert np.isnan(detectable_shift(4, 4, 0.02))


def test_holm_by_hand():
    np.testing.assert_allclose(statistics.holm([0.04, 0.01, 0.03]), [0.06, 0.03, 0.06])
    np.testing.assert_allclose(statistics.holm([0.6, 0.7]), [1, 1])


# -------------------------------------------------------------------- simulations of the comparison


# Both with mean 0 and standard deviation 1
RETURNS = {"normal": simulate_choose.normal, "low peak": simulate_choose.failing}


def simulated(n, m, draw, spread, draws=2000):
    """Percent of comparisons of equal means, n against m, with p <= 0.05; coverage of intervals."""
    rng = np.random.default_rng(n)
    values = np.concatenate([spread * draw(rng, (n, draws)), draw(rng, (m, draws))])
    shares = permutation.tails(permutation.welch_t(values, divisions(n, m, rng)))
    x, y = values[:n], values[n:]
    variances = [z.var(axis=0, ddof=1) / len(z) for z in (x, y)]
    _, half = statistics.satterthwaite(variances, np.array([[n], [m]]))
    covered = abs(x.mean(axis=0) - y.mean(axis=0)) <= half
    return 100 * (2 * np.minimum(*shares) <= 0.05 + 1e-12).mean(), 100 * covered.mean()


@pytest.mark.slow
def test_level_and_coverage_are_those_that_the_page_says():
    page = DOCS.read_text()
    for name, draw in RETURNS.items():
        for spread in (1, 2):
            found = [simulated(n, n, draw, spread) for n in (5, 10, 25)]
            levels, coverages = zip(*found, strict=True)
            said = cells_of(page, f"{name} \\| x {spread}")
            assert said == pytest.approx([*levels, *coverages], abs=0.6), (name, spread)


def rare_peak(rng, shape):
    """One run in ten lies ten widths above the others."""
    returns = rng.normal(0, 1, shape) + np.where(rng.random(shape) < 0.1, 10, 0)
    return (returns - 1) / np.sqrt(1 + 100 * 0.1 * 0.9)


UNEQUAL = [(3, 10), (5, 8), (5, 13), (5, 25), (5, 50), (10, 50), (30, 50)]


@pytest.mark.slow
def test_levels_of_unequal_numbers_of_seeds_are_those_that_the_page_says():
    """And no verdict is given on a single rate where they are highest."""
    page = DOCS.read_text()
    for name, draw in (RETURNS | {"rare peak": rare_peak}).items():
        found = [simulated(n, m, draw, spread=2)[0] for n, m in UNEQUAL]
        assert cells_of(page, f"{name} \\| x 2 unequal") == pytest.approx(found, abs=1), name
    judged = [pair for pair in UNEQUAL if not is_lopsided(*pair, MOST_RATIO_OF_RATES)]
    assert judged == [(5, 8), (30, 50)]
