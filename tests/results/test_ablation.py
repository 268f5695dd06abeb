"""The scale of PPO's noise and SAC's steps to a return, with made-up and committed runs."""

import json
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
    expected = stats.ttest_ind([4, 4, 10], [10, 8, 8], equal_var=False)
    assert (found["p_steps"], found["total"]) == (pytest.approx(expected.pvalue), 1_000_000)


def test_a_mean_that_never_gets_there():
    found = headline.numbers((STEPS, curves(7900, 8000, 8100), curves(6900, 7000, 7100)))
    assert (found["noisy"]["final"], found["noisy"]["in_words"]) == ("7,000 ± 100", "never")
    assert np.isnan(found["noisy"]["mean"]) and found["noisy"]["runs"] == 3 * [1_000_000]


def test_the_smallest_difference_that_is_shown():
    """Simulated: three against three runs find it in 80 % of the draws."""
    x, y = np.array([1.0, 2, 3]), np.array([11.0, 12, 13])
    shift = headline.smallest_shown(x, y)
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(20_000, 2, 3))
    p = stats.ttest_ind(draws[:, 0] + shift, draws[:, 1], axis=1).pvalue
    assert np.mean(p <= 0.05) == pytest.approx(0.8, abs=0.01)


@pytest.mark.slow
def test_the_curves_of_the_headline_are_those_of_the_runs():
    steps, *found = headline.read_curves()
    assert steps[-1] == 1_000_000
    for curves, start in zip(found, ("baseline_s", "p0.01_s"), strict=True):
        runs = sorted((common.DATA / "long").glob(f"{start}*__HalfCheetah-v5__sac_*"))
        results = [json.loads((run / "result.json").read_text()) for run in runs]
        final = [result["final_return_mean"] for result in results]
        assert curves[-1].tolist() == pytest.approx(final) and len(final) == 3


@pytest.mark.slow
def test_readme_has_the_headline_and_the_scales(monkeypatch):
    found = (STEPS, curves(7900, 8000, 8100), 2 * curves(9000, 9100, 3000))
    numbers = readme.numbers() | {"headline": headline.numbers(found)}
    numbers |= {"ablation": ablation.numbers(made_up([1, 2, 3], effect=5), PAPER)}
    monkeypatch.setattr(readme, "numbers", lambda: numbers)
    page = readme.page()
    assert "| ScaleReward p = 0.0002, NoisyObservation p = " in page
    assert "(#step-variance-and-speed)" in page
    assert "Ours (3 seeds) ends at 8,000 ± 100 without noise and at 14,067 ± 6,987 with it:" in page
    assert "| by 0.5 million, p = " in page
