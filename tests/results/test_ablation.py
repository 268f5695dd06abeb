"""The scale of PPO's noise and SAC's steps to a return, with made-up runs."""

from itertools import product

import ablation
import common
import headline
import numpy as np
import pandas as pd
import pytest
import readme
from scipy import stats

from analysis.paper import read_paper

PAPER = read_paper(common.RESULTS / "paper")
SCALED, UNIFORM = ablation.scales()


def made_up(seeds, effect=0.0):
    """Whole seeds: returns of about 100; beta costs `effect` each with the first noise."""
    rng, rows = np.random.default_rng(0), []
    for environment in common.ENVIRONMENTS:
        cells = [("", 0)]
        for wrapper, noises in ablation.scales().items():
            cells += [(noise, i * (wrapper == SCALED)) for i, noise in enumerate(noises.values())]
        for noise, place in cells:
            for seed in seeds:
                rows.append([environment, noise, seed, 100 - effect * place + rng.normal()])
    return pd.DataFrame(rows, columns=["environment", "noise", "seed", "test"])


def test_the_scales_are_those_of_the_preset():
    scales = ablation.scales()
    assert list(scales) == ["RandomUniformScaleReward", "RandomUniformNoisyObservation"]
    assert list(scales[SCALED]) == [1.1, 1.2, 1.5, 1.8, 2.0]
    assert scales[SCALED][2.0] == "RandomUniformScaleReward(0.0, 2.0)"
    assert scales[UNIFORM][0.001] == "RandomUniformNoisyObservation(-0.001, 0.001)"


@pytest.mark.slow
def test_the_committed_runs_of_the_ablation_are_the_planned_ones():
    runs = ablation.read_returns(ablation.FOLDER)
    noises = {noise for scale in ablation.scales().values() for noise in scale.values()}
    planned = product(common.ENVIRONMENTS, {"", *noises}, (1, 2, 3))
    found = zip(runs["environment"], runs["noise"], runs["seed"], strict=True)
    assert sorted(found) == sorted(planned)


def test_the_test_of_the_scales_is_kruskal_and_wallis():
    """For one environment its p is scipy's, up to the chi-squared approximation."""
    rng = np.random.default_rng(1)
    for shift in (0.0, 0.4, 0.8):
        returns = rng.normal(size=(1, 5, 8)) + shift * np.arange(5)[:, None]
        expected = stats.kruskal(*returns[0]).pvalue
        assert ablation.same_at_all_scales(returns) == pytest.approx(expected, abs=0.03)


def test_useless_scales_are_seldom_found():
    """Without an effect p is uniform, also where environments have scales of their own."""
    rng = np.random.default_rng(2)
    size = np.array([1.0, 1000.0])[:, None, None]
    p = [ablation.same_at_all_scales(size * rng.normal(size=(2, 5, 3))) for _ in range(40)]
    assert 0.3 < np.mean(p) < 0.7 and np.mean(np.array(p) <= 0.05) < 0.2


def test_the_smallest_shift_that_the_test_of_the_scales_finds():
    """For one environment, found again with scipy's test."""
    shift = ablation.smallest_shown(1, 5, 8)
    rng, found = np.random.default_rng(3), 0
    for _ in range(1000):
        returns = rng.normal(size=(5, 8))
        returns[2] -= shift
        found += stats.kruskal(*returns).pvalue <= 0.05
    assert found / 1000 == pytest.approx(0.8, abs=0.05)
    assert ablation.smallest_shown(5, 5, 3) < ablation.smallest_shown(5, 5, 2)


def test_a_noise_whose_largest_scale_alone_matters():
    runs = made_up([1, 2, 3])
    runs.loc[runs["noise"] == ablation.scales()[UNIFORM][1.0], "test"] -= 50
    found = ablation.numbers(runs, PAPER)
    page = common.render("ablation.md.jinja", {"ablation": found})
    assert found["p"][UNIFORM] < 0.001 and found["p_smaller"][UNIFORM] > 0.05
    assert f"no dependence is shown (p = {found['p_smaller'][UNIFORM]:.2g}, asked" in page


@pytest.mark.slow
def test_the_figure_is_drawn(monkeypatch, tmp_path):
    (tmp_path / "figures").mkdir()
    monkeypatch.setattr(ablation, "RESULTS", tmp_path)
    ablation.draw(made_up([1, 2, 3], effect=5))
    assert (tmp_path / "figures/ablation.svg").stat().st_size > 10_000


def test_a_noise_whose_scale_matters():
    found = ablation.numbers(made_up([1, 2, 3], effect=5), PAPER)
    page = common.render("ablation.md.jinja", {"ablation": found})
    assert f"- `{SCALED}`: the return depends on beta (p = 0.0002, corrected)" in page
    assert f"- `{UNIFORM}`: no dependence on beta is shown (p = " in page
    assert "Without the largest beta it still does (p = 0.0001, asked afterwards)." in page
    assert page.count("Without the largest") == 1
    assert "ablation.svg" in page and "The bars' lines are" in page
    assert found["p"][SCALED] == pytest.approx(2 / 10_001) and found["p"][UNIFORM] > 0.05
    rows = {line.split("|")[1].strip(): line for line in found["table"].splitlines()[2:]}
    assert "| +20 ± 40 %" in rows["`RandomUniformScaleReward(0.8, 1.2)`"]
    assert "| +8 ± 19 %" in rows["`RandomUniformNoisyObservation(-0.001, 0.001)`"]
    assert rows["`RandomUniformScaleReward(0.0, 2.0)`"].count("-20 %") >= 2


# ------------------------------------------------------------------------------------- the headline

STEPS = np.arange(1, 11) * 100_000


def curves(*lengths):
    """A return that rises by 1,000 every 100,000 steps up to each run's own end."""
    return np.stack([np.minimum(STEPS / 100, end) for end in lengths], axis=1)


def test_steps_to_the_baselines_return_by_hand():
    """The baselines end at 7,900, 8,000 and 8,100; with noise one of the runs never gets there."""
    without, noisy = curves(7900, 8000, 8100), np.minimum(2.5 * curves(9900, 9900, 2000), 9900)
    found = headline.numbers((STEPS, without, noisy))
    assert found["target"] == 8000 and found["n"] == 3
    for name, final, steps, runs in (
        ("without", "8,000 ± 100", 900_000, [1_000_000, 800_000, 800_000]),
        ("noisy", "8,267 ± 2,829", 400_000, [400_000, 400_000, 1_000_000]),
    ):
        assert (found[name]["final"], found[name]["mean"]) == (final, steps)
        assert found[name]["in_words"] == f"at {steps:,} steps"
        assert found[name]["runs"] == runs
    expected = stats.ttest_ind(noisy[-1], without[-1], equal_var=False)
    assert (found["difference"], found["p"]) == pytest.approx((800 / 3, expected.pvalue))
    assert found["verdict"] == "undecided"


def test_a_single_seed_is_shown_without_a_verdict():
    found = headline.numbers((STEPS, curves(7900), 2 * curves(3500)))
    assert (found["n"], found["p"], found["verdict"]) == (1, None, "not tested")
    assert (found["without"]["final"], found["noisy"]["final"]) == ("7,900", "7,000")
    assert found["without"]["in_words"] == "at 800,000 steps"
    assert found["noisy"]["in_words"] == "never"


def test_the_smallest_difference_that_is_shown():
    """Simulated: three against three runs find it in 80 % of the draws."""
    x, y = np.array([1.0, 2, 3]), np.array([11.0, 12, 13])
    shift = headline.smallest_shown(x, y)
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(20_000, 2, 3))
    p = stats.ttest_ind(draws[:, 0] + shift, draws[:, 1], axis=1).pvalue
    assert np.mean(p <= 0.05) == pytest.approx(0.8, abs=0.01)


def test_verdicts_on_the_headline():
    assert headline.verdict(400_000, True, 0.04) == "confirmed"
    assert headline.verdict(400_000, True, 0.06) == "undecided"
    assert headline.verdict(500_000, True, 0.04) == headline.verdict(np.nan, True, 0.04)
    assert headline.verdict(500_000, True, 0.04) == "undecided"


def made_up_runs(seeds_of_noise):
    rows = [
        ["finished", "SAC", "HalfCheetah-v5", noise, rate, seed, 1_000_000, STEPS, STEPS + seed]
        for noise, rate, seeds in seeds_of_noise
        for seed in seeds
    ]
    names = [
        "status",
        "algorithm",
        "environment",
        "noise",
        "noise_rate",
        "seed",
        "total",
        "steps",
        "returns",
    ]
    return pd.DataFrame(rows, columns=names)


def test_only_whole_seeds_of_the_headline_count(monkeypatch):
    runs = made_up_runs([("", "0.00", (1, 2, 3, 4)), (headline.NOISE, "0.01", (2, 3, 4, 5))])
    monkeypatch.setattr(headline, "read_runs", lambda folder: runs)
    steps, without, noisy = headline.read_curves()
    assert (steps == STEPS).all() and (without == noisy).all()
    assert (without[0] - STEPS[0]).tolist() == [2, 3, 4]
    for left in (runs[runs["seed"].isin([1, 5])], runs[runs["noise"] == ""], runs.iloc[:0]):
        monkeypatch.setattr(headline, "read_runs", lambda folder, left=left: left)
        assert headline.read_curves() is None
    assert headline.numbers(None) == {"n": 0, "p": None, "verdict": "not tested"}


@pytest.mark.slow
def test_readme_has_the_headline_and_the_scales(monkeypatch):
    found = (STEPS, curves(7900, 8000, 8100), 2 * curves(9000, 9100, 3000))
    numbers = readme.numbers() | {"headline": headline.numbers(found)}
    numbers |= {"ablation": ablation.numbers(made_up([1, 2, 3], effect=5), PAPER)}
    monkeypatch.setattr(readme, "numbers", lambda: numbers)
    page = readme.page()
    assert "1,000,000, 800,000, 800,000" in page and "not complete" not in page
    assert "| ScaleReward p = 0.0002, NoisyObservation p = " in page
    assert "(#step-variance-and-speed)" in page
    assert "Ours (3 seeds) ends at" in page and "too few" not in page
    one = headline.numbers((STEPS, curves(7900), 2 * curves(4500)))
    monkeypatch.setattr(readme, "numbers", lambda: numbers | {"headline": one})
    page = readme.page()
    assert "Ours (1 seed, too few for a verdict) ends at 7,900" in page
    claim = next(line for line in page.splitlines() if "halves the steps" in line)
    assert claim.endswith("| **not tested**   |") and "p =" not in claim
