"""IQM and probability of improvement: rliable's answers, and how often intervals are wrong."""

import numpy as np
import pytest
from scipy import stats
from sweeps import NAN, ROOT

from analysis import statistics
from analysis.iqm import bootstrap_iqm, iqm, probability_of_improvement

DOCS = ROOT / "docs/statistics.md"

# Inputs (5 x 3, 5 x 3 and 7 x 3) and outputs recorded from rliable 1.2.0.
X = [[100, 109, 91.8], [73.3, 86.4, 70.3], [101.8, 140.2, 85.2], [81.4, 114.7, 110.7]]
X = np.array([*X, [103.2, 72.1, 99.1]])
Y = [[101.8, 49.7, 76.3], [33, 51.3, 91.8], [82.9, 52, 98.1], [94.7, 84.4, 14.5]]
Y = np.array([*Y, [73.8, 88.5, 93.4]])
Z = [[44.1, 75.7, 60.6], [65.7, 121.8, 65.8], [89, 116.5, 72.5], [86.6, 93.3, 91.9]]
Z = np.array([*Z, [53.2, 92.3, 130.8], [43.6, 115.8, 93.6], [70.8, 150, 112.9]])


def test_iqm_is_rliables():
    recorded = [(X, 95.32222222222222), (Y, 77.15555555555555), (Z, 85.85454545454544)]
    for scores, value in [*recorded, (Z[:, :1], 64.08)]:
        assert iqm(scores.ravel()) == pytest.approx(value, rel=1e-12)
        assert bootstrap_iqm(scores)[0] == pytest.approx(value, rel=1e-12)
    assert bootstrap_iqm(X, X)[0] == pytest.approx(0, abs=1e-9)  # less the baseline's own changes
    assert np.isnan(iqm([[1.0, NAN, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]])).tolist() == [True, False]


def test_probability_of_improvement_is_rliables():
    recorded = [(X, Y, 0.72), (Y, X, 0.28), (X, Z, 0.5904761904761905), (X, X, 0.5)]
    for x, y, probability in [*recorded, (X[:, :1], Z[:, :1], 0.8857142857142857)]:
        p, low, high = probability_of_improvement(x, y)
        assert p == pytest.approx(probability, rel=1e-12)
        assert 0 <= low < p < high <= 1


def test_a_missing_run_is_not_a_score():
    padded = np.vstack([X, np.full((1, 3), NAN)])
    assert bootstrap_iqm(padded, Y) == bootstrap_iqm(X, Y)
    assert probability_of_improvement(padded, Y) == probability_of_improvement(X, Y)
    assert statistics.compare(padded, Y) == pytest.approx(statistics.compare(X, Y), nan_ok=True)


@pytest.mark.parametrize(("shift", "envs"), [(0, 1), (2.5, 1), (1.5, 5)])
def test_coverage_of_the_probability_of_improvement(shift, envs):
    rng = np.random.default_rng(1)
    truth, inside, trials = stats.norm.cdf(shift / np.sqrt(2)), 0, 400
    for _ in range(trials):
        x, y = rng.normal(shift, 1, (5, envs)), rng.normal(0, 1, (5, envs))
        _, low, high = probability_of_improvement(x, y)
        inside += low - 1e-12 <= truth <= high + 1e-12
    assert inside / trials >= 0.9


def test_an_iqm_that_may_be_drawn_as_zero_has_no_interval_of_its_change(recwarn):
    x, y = np.array([[0.0, 1, 1, 1, 1]] * 2).T, np.array([[0.0, 0, 1, 1, 1, 1, 1, 1]] * 2).T
    value, low, high = bootstrap_iqm(x, y)
    assert np.isfinite(value) and np.isnan([low, high]).all() and not recwarn.list


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


def covered(n, distributions, trials=500):
    """Percent of samples of n seeds whose interval holds the true IQM: the worst distribution."""
    worst = 100.0
    for seed, draw in enumerate(distributions.values()):
        rng = np.random.default_rng(seed)
        truth = iqm(draw(rng, 400_000))
        samples = draw(rng, (trials, n))
        low, high = np.array([bootstrap_iqm(sample[:, None])[1:] for sample in samples]).T
        worst = min(worst, 100 * np.mean((low <= truth) & (truth <= high)))
    return worst


@pytest.mark.slow
def test_coverage_of_the_iqm_is_what_the_page_says():
    usual, mixtures = int(covered(5, DISTRIBUTIONS)), int(covered(5, MIXTURES))
    assert f"| 5 | {usual} % | {mixtures} % |" in DOCS.read_text()


def test_satterthwaites_interval_of_three_seeds_is_welchs():
    """With three seeds the IQM is the mean, so the bootstrap has a known limit: Welch's interval.

    The baseline's IQM is far from zero: dividing by it then adds nothing.
    """
    x, y = np.array([[10.0], [40.0], [10.0]]), np.array([[0.0], [1.0], [5.0]])
    base = 1e6
    value, low, high = bootstrap_iqm(x + base, y + base, resamples=400_000)
    welch = stats.ttest_ind(x[:, 0], y[:, 0], equal_var=False).confidence_interval(0.95)
    assert value == pytest.approx(100 * 18 / base, rel=1e-4)
    np.testing.assert_allclose([low, high], 100 * np.array(welch) / base, rtol=0.01)


def test_an_iqm_has_no_percent_of_what_may_be_zero_or_is_small_beside_the_span():
    x, y = np.full((3, 2), 5.0), np.array([[10.0, -1], [11, 1], [12, 2]])
    assert np.isnan(bootstrap_iqm(x, y)).all()
    assert np.isfinite(bootstrap_iqm(x[:, :1], y[:, :1])).all()
    x, y = np.array([[92.0], [93], [94]]), np.array([[1.0], [1.1], [1.2]])
    assert np.isnan(bootstrap_iqm(x, y)).all()
    assert np.isfinite(bootstrap_iqm(x / 10, y)).all()
    alike = bootstrap_iqm(np.full((5, 1), 30.0), np.full((3, 1), 20.0))
    np.testing.assert_equal(alike, (50, np.nan, np.nan))  # no proof that others are
    few_low = np.array([[3000.0], [3000], [3000], [3000], [100]])  # whose IQM is not their mean
    assert bootstrap_iqm(np.full((5, 1), 30.0), few_low)[0] == pytest.approx(-99)


def test_no_change_of_positive_returns_is_below_minus_100_percent():
    """Over environments, too, where the baseline's own IQM of changes is not zero."""
    y = np.array([[145.0, 95], [196, 192], [69, 86], [87, 85], [141, 108]])
    value, low, _ = bootstrap_iqm(0.01 * y[:3], y)
    assert value == low == -100
    found = bootstrap_iqm(np.array([[1.0], [2], [90]]), np.array([[100.0], [110], [120]]))
    assert found[0] > found[1] == -100
