"""The intervals of analyze.py in simulations: how often they are wrong, and for which returns."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from analysis import statistics


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
@pytest.mark.parametrize("n", statistics.COVERAGE)
def test_coverage(n):
    """The caption of the table of statistics says these numbers."""
    measured = covered(n, ours)
    assert int(measured) == statistics.COVERAGE[n]
    assert measured >= 92
    assert int(covered(n, ours, MIXTURES)) == statistics.COVERAGE_OF_MIXTURES[n]


@pytest.mark.slow
def test_coverage_of_the_alternatives_at_five_seeds_is_lower():
    for method in ("percentile", "basic", "BCa"):
        assert covered(5, lambda samples, method=method: scipys(samples, method)) < 93
    assert covered(5, ours) > 93


@pytest.mark.slow
def test_coverage_of_the_improvement_over_environments():
    """The baseline's mean is estimated as well: taking it as known covers less than 90 %."""
    rng = np.random.default_rng(0)
    draws = list(DISTRIBUTIONS.values())
    pools = [draw(rng, 400_000) for draw in draws]
    scores = [
        statistics.improvement_percent(np.stack([1.3 * pool, pool]), pool.mean()) for pool in pools
    ]
    truth = np.subtract(*statistics.iqm(np.concatenate(scores, axis=1)))
    inside, inside_fixed, trials = 0, 0, 200
    for _ in range(trials):
        x, y = (np.stack([draw(rng, 5) for draw in draws], axis=1) for _ in range(2))
        _, low, high = statistics.bootstrap_iqm(1.3 * x, y)
        inside += low <= truth <= high
        fixed = [statistics.improvement_percent(z, y.mean(axis=0)) for z in (1.3 * x, y)]
        shift = statistics.iqm(fixed[1].ravel())
        _, low, high = statistics.bootstrap_iqm(fixed[0])
        inside_fixed += low - shift <= truth <= high - shift
    assert inside / trials >= 0.93
    assert inside_fixed / trials < 0.9


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DISTRIBUTIONS, *MIXTURES])
def test_noise_that_does_nothing_improves_nothing(name):
    """The IQM of skewed returns is not their mean; no improvement must come of that."""
    rng, draw, found = np.random.default_rng(0), (DISTRIBUTIONS | MIXTURES)[name], []
    for _ in range(200):
        found.append(
            statistics.bootstrap_iqm(draw(rng, (10, 5)), draw(rng, (10, 5)), resamples=200)
        )
    estimate, low, high = np.transpose(found)
    assert abs(estimate.mean()) < 3 * estimate.std() / np.sqrt(len(found))
    assert ((low > 0) | (high < 0)).mean() <= 0.08


def interval_without_the_baselines_seeds(x, y, resamples):
    """The usual bootstrap interval: its degrees of freedom are those of the noisy runs x (n, 1)."""
    rng = np.random.default_rng(0)
    x_drawn, y_drawn = (z[rng.integers(len(z), size=(resamples, len(z))), 0] for z in (x, y))

    def improvement(x, y):
        means = y.mean(axis=-1, keepdims=True)
        noisy, baseline = (statistics.improvement_percent(z, means) for z in (x, y))
        return statistics.iqm(noisy) - statistics.iqm(baseline)

    value = improvement(x[:, 0], y[:, 0])
    half = stats.t.ppf(0.975, len(x) - 1) * improvement(x_drawn, y_drawn).std(ddof=1)
    return value - half, value + half


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spread", "spread_baseline", "usual", "most"),
    [(500, 500, (8, 12), 7), (50, 500, (17, 23), 7)],
    ids=["alike", "wide baseline"],
)
def test_ten_noisy_seeds_do_not_make_up_for_three_of_the_baseline(
    spread, spread_baseline, usual, most
):
    """Percent of useless noises said to help or harm: 10 noisy seeds, 3 of the baseline."""
    rng, resamples, trials = np.random.default_rng(0), 300, 1000
    wrong, wrong_usual = 0, 0
    for _ in range(trials):
        x, y = rng.normal(3000, spread, (10, 1)), rng.normal(3000, spread_baseline, (3, 1))
        _, low, high = statistics.bootstrap_iqm(x, y, resamples)
        wrong += low > 0 or high < 0
        low, high = interval_without_the_baselines_seeds(x, y, resamples)
        wrong_usual += low > 0 or high < 0
    assert usual[0] <= 100 * wrong_usual / trials <= usual[1]
    assert 100 * wrong / trials <= most


def test_satterthwaites_interval_of_three_seeds_is_welchs():
    """With three seeds the IQM is the mean, so the bootstrap has a known limit: Welch's interval.

    The baseline's mean is far from zero: dividing by it then adds nothing.
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


# ---------------------------------------------------------------- the test of the mean win rate


def stacked(*environments):
    """Put samples of several environments side by side: (seeds x envs), NaN where there is none."""
    table = np.full((max(map(len, environments)), len(environments)), np.nan)
    for e, values in enumerate(environments):
        table[: len(values), e] = values
    return table


def all_mean_win_rates(*sizes):
    """Mean win rates under every order of the runs, one array entry for each order."""
    rates = np.zeros(1)
    for n, m in sizes:
        found = []
        for chosen in combinations(range(n + m), n):
            others = [i for i in range(n + m) if i not in chosen]
            found.append(statistics.wins(np.array(chosen), np.array(others)) / (n * m))
        rates = np.add.outer(rates, found).ravel()
    return rates / len(sizes)


def test_p_is_that_of_all_orders_where_environments_differ_in_their_seeds():
    rng, sizes = np.random.default_rng(0), [(2, 3), (3, 3), (2, 5)]
    null = all_mean_win_rates(*sizes)
    for _ in range(20):
        x = stacked(*(rng.normal(0.5, 1, n) for n, _ in sizes))
        y = stacked(*(rng.normal(0, 1, m) for _, m in sizes))
        rate, _, _ = statistics.probability_of_improvement(x, y)
        tails = (null <= rate + 1e-9).mean(), (null >= rate - 1e-9).mean()
        p, smallest = statistics.mann_whitney(x, y)
        assert p == pytest.approx(min(1, 2 * min(tails)))
        assert smallest == pytest.approx(2 / len(null))


@pytest.mark.slow
def test_the_direction_of_a_verdict_is_that_of_its_test():
    """0.94 of 10 against 10 are won, none of 3 against 3: the sum of U would have p = 0.0022."""
    ten = np.arange(10.0)
    x = stacked(ten + 6.2, [1.0, 2, 3])
    y = stacked(ten, [4.0, 5, 6])
    assert statistics.wins(x[:, 0], y[:, 0]) == 94
    rate, _, _ = statistics.probability_of_improvement(x, y)
    assert rate == pytest.approx(0.47)
    assert statistics.mann_whitney(x, y)[0] > 0.7
    rng = np.random.default_rng(0)
    for _ in range(200):
        sizes = rng.integers(3, 12, (3, 2))
        shift = rng.normal(0, 1.5, 3)
        x = stacked(*(rng.normal(s, 1, n) for (n, _), s in zip(sizes, shift, strict=True)))
        y = stacked(*(rng.normal(0, 1, m) for _, m in sizes))
        p, _ = statistics.mann_whitney(x, y)
        rate, _, _ = statistics.probability_of_improvement(x, y)
        if p <= 0.05:
            assert abs(rate - 0.5) > 0.1
            assert statistics.mann_whitney(y, x)[0] == pytest.approx(p, abs=0.002)


def test_more_baselines_in_one_environment_do_not_outweigh_the_others():
    five = np.arange(5.0)
    x = stacked(five, five - 10, five - 10)
    few = stacked(five - 0.5, five, five)
    many = stacked(np.repeat(five - 0.5, 10) + np.linspace(0, 0.1, 50), five, five)
    before, _ = statistics.mann_whitney(x, few)
    after, _ = statistics.mann_whitney(x, many)
    assert after <= before < 0.05


def test_random_orders_where_the_exact_distribution_is_too_large(monkeypatch):
    rng, sizes = np.random.default_rng(0), [(5, 7), (4, 9)]
    x = stacked(*(rng.normal(0, 1, n) for n, _ in sizes))
    y = stacked(*(rng.normal(0, 1, m) for _, m in sizes))
    exact, _ = statistics.mann_whitney(x, y)
    statistics.win_rate_null.cache_clear()
    monkeypatch.setattr(statistics, "MOST_VALUES", 100)
    drawn, _ = statistics.mann_whitney(x, y)
    again, _ = statistics.mann_whitney(x, y)
    far, smallest = statistics.mann_whitney(x + 100, y)
    statistics.win_rate_null.cache_clear()
    assert exact != drawn == again == pytest.approx(exact, rel=0.05)
    assert far == smallest == 2 / (1 + statistics.PERMUTATIONS)
