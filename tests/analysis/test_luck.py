"""What luck alone shows (analysis.luck.py): cases with a known answer, and its false alarms."""

import re

import numpy as np
import pandas as pd
import pytest
import simulate_choose
from scipy import stats
from sweeps import NAN, ROOT

import analysis.luck
import analysis.statistics
from analysis.studies import Study
from noisy_wrappers import BASELINE, Configuration
from results.study import paper

STUDY = {"algorithm": "PPO", "exp_name": "", "phase": "", "tested": ""}
MANY = 10**9  # seeds or degrees of freedom: no uncertainty


def make_study(baseline, noisy):
    """Make a Study of final returns: baseline (seeds x envs), noisy (configs x seeds x envs)."""
    finals = {BASELINE: baseline}
    for i, values in enumerate(noisy):
        finals[Configuration((f"N({i})",), ((1.0, 1.0),))] = values
    environments = [f"Env{e}-v0" for e in range(baseline.shape[1])]
    seeds = list(range(len(baseline)))
    return Study("PPO", "", "", "", environments, seeds, np.array([1]), {}, finals)


def luck_of_study(study):
    """Return {environment: the highest differences of useless sweeps}."""
    return {key[-1]: draws for key, draws in analysis.luck.luck_of_studies([study]).items()}


# ------------------------------------------------------------------------------- a known answer


def test_a_single_configuration_is_students_test():
    rng = np.random.default_rng(0)
    for n, m, shift in [(3, 3, 1), (5, 5, 0.5), (10, 4, 1), (5, 10, -0.5)]:
        noisy, baseline = rng.normal(100 + shift, 1, n), rng.normal(100, 1, m)
        spread = analysis.statistics.pooled_std([noisy, baseline])
        [draws] = analysis.luck.draw_differences(*spread, m, [n], rng)
        found = analysis.luck.p_of_luck(draws, noisy.mean() - baseline.mean())
        expected = stats.ttest_ind(noisy, baseline, alternative="greater").pvalue
        assert found == pytest.approx(expected, abs=0.015)


def test_seeds_that_do_not_vary_are_no_proof():
    """One success in 23 configurations of five seeds with ten episodes is luck."""
    rates = np.zeros((23, 5, 1))
    rates[7, 2] = 10.0
    rare = make_study(np.zeros((5, 1)), rates)
    few = make_study(np.full((2, 1), 50.0), np.array([[[100.0], [100.0]], [[50.0], [50.0]]]))
    for study, episodes, gain in ((rare, 10, 2.0), (few, 2, 50.0)):
        study.curves, study.episodes = study.finals, episodes
        assert analysis.luck.p_of_luck(luck_of_study(study)["Env0-v0"], gain) > 0.05
        study.episodes = None  # of returns without any spread nothing is known
    assert np.isnan(luck_of_study(few)["Env0-v0"]).all()
    rounded = make_study(np.full((3, 1), 0.1), np.array([3 * [[0.2]], 3 * [[0.1]]]))
    assert np.isnan(luck_of_study(rounded)["Env0-v0"]).all()


def test_noise_that_ends_training_says_nothing_of_luck():
    rng = np.random.default_rng(0)
    baseline, useless = rng.normal(100, 1, 5), rng.normal(100, 1, (20, 5))
    dead, exploding = rng.normal(50, 0.01, (15, 5)), rng.normal(-1e6, 1e4, (15, 5))
    study = make_study(baseline[:, None], np.concatenate([useless, dead, exploding])[..., None])
    spread = analysis.statistics.pooled_std([baseline, *useless])
    drawn = analysis.luck.draw_differences(*spread, 5, [5] * 50, np.random.default_rng(0), baseline)
    np.testing.assert_array_equal(luck_of_study(study)["Env0-v0"], drawn.max(axis=0))


def test_an_unlucky_baseline_is_part_of_the_luck():
    """With as many seeds the baseline adds as much variance as one configuration has."""
    rng = np.random.default_rng(0)
    draws = analysis.luck.draw_differences(10.0, MANY, 4, [4, 4, 25], rng)
    assert draws.std(axis=1) == pytest.approx(np.sqrt([50, 50, 29]), rel=0.03)
    assert np.corrcoef(draws[0], draws[1])[0, 1] == pytest.approx(0.5, abs=0.03)


def test_twenty_seeds_of_the_baseline_are_resampled():
    """One run of a population of -1 and 3 in equal parts, minus another one: -4, 0 or 4."""
    for seeds, values in ((20, 3), (18, analysis.luck.DRAWS)):
        rng, baseline = np.random.default_rng(0), np.tile([-1.0, 3.0], seeds // 2)
        draws = analysis.luck.draw_differences(2.0, MANY, 1, [1], rng, baseline)
        found, counts = np.unique(draws.round(1), return_counts=True)
        assert (len(found) == 3) == (values == 3)
        if values == 3:
            assert found.tolist() == [-4, 0, 4]
            np.testing.assert_allclose(counts / draws.size, [0.25, 0.5, 0.25], atol=0.02)


def test_a_configuration_counts_where_it_was_run():
    """And luck needs a choice of two, a baseline, and returns that differ."""
    rng = np.random.default_rng(0)
    baseline = np.repeat(rng.normal(100, 1, (5, 1)), 5, axis=1)
    noisy = np.repeat(rng.normal(100, 1, (3, 5, 1)), 5, axis=2)
    noisy[0, :, 1] = noisy[1:, :, 2] = NAN
    baseline[:, 3] = NAN
    baseline[:, 4] = noisy[:, :, 4] = 7.0
    three, two, *others = luck_of_study(make_study(baseline, noisy)).values()
    assert np.median(three) > 1.2 * np.median(two) > 0
    assert np.isnan(others).all()


# -------------------------------------------------------------------------------- false alarms


@pytest.mark.slow
def test_the_page_says_how_often_p_luck_is_wrong_and_how_often_it_finds_an_effect(monkeypatch):
    monkeypatch.setattr(analysis.luck, "DRAWS", 400)
    n = 5
    page = (ROOT / "docs/statistics.md").read_text()
    cases = ("low peak", 0, simulate_choose.failing), ("normal", 1.5, simulate_choose.normal)
    for name, gain, draw in cases:
        [line] = re.findall(rf"^\| {name} \| {n} \| (.*) \|$", page, re.MULTILINE)
        cells = [cell.rstrip(" %") for cell in line.split(" | ")]
        place = 2 if gain else 0
        said = float(cells[place]), float(cells[4 + place])
        found = p_of_the_best(n, gain, draw)
        assert found == pytest.approx(said, abs=8), name
        if name == "low peak":
            assert found[1] <= 2.5


def p_of_the_best(n, gain, draw, studies=200):
    """Percent of studies of 90 configurations, one with a true gain, whose best is beyond luck.

    As analyze.py judges its own runs, and as it judges the paper's table.
    """
    rng, own, theirs = np.random.default_rng(0), 0, 0
    for _ in range(studies):
        baseline, noisy = 20 + draw(rng, (n, 1)) / 10, 20 + draw(rng, (90, n, 1)) / 10
        noisy[0] += gain / 10
        best = noisy.mean(axis=1).max() - baseline.mean()
        luck = luck_of_study(make_study(baseline, noisy))["Env0-v0"]
        own += analysis.luck.p_of_luck(luck, best) <= analysis.statistics.LEVEL
        row = STUDY | {"environment": "Env0-v0", "noisy_mean": best}
        row |= {"baseline_mean": 0.0, "baseline_std": baseline.std(ddof=1)}
        [p] = paper.add_luck_of_paper(pd.DataFrame([row]), {"PPO": n})["p_luck"]
        theirs += p <= analysis.statistics.LEVEL
    return 100 * own / studies, 100 * theirs / studies
