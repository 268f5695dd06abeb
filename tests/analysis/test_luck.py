"""What luck alone shows (analysis.luck.py): cases with a known answer, and its false alarms."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import simulate_choose
from scipy import stats
from test_analyze import FINALS, SCALE, row, run, small_sweep

import analysis.luck
import analysis.paper
import analysis.runs
import analysis.statistics
import analysis.tables
import analyze
from noisy_wrappers import BASELINE, Configuration

NAN = float("nan")
PAPER = Path(analyze.__file__).parent / "results/paper"
STUDY = {"algorithm": "PPO", "exp_name": "", "phase": ""}
MANY = 10**9  # seeds or degrees of freedom: no uncertainty


def make_study(baseline, noisy):
    """Make a Study of final returns: baseline (seeds x envs), noisy (configs x seeds x envs)."""
    returns = {BASELINE: baseline[None]}
    for i, values in enumerate(noisy):
        returns[Configuration((f"N({i})",), ((1.0, 1.0),))] = values[None]
    environments = [f"Env{e}-v0" for e in range(baseline.shape[1])]
    seeds = list(range(len(baseline)))
    return analysis.runs.Study("PPO", "", "", environments, seeds, np.array([1]), returns)


def luck_of_one_environment(baseline, noisy):
    """Return p_luck of the best: baseline (seeds,), noisy (configs x seeds)."""
    study = make_study(baseline[:, None], noisy[..., None])
    best = noisy.mean(axis=1).max() - baseline.mean()
    return analysis.luck.p_of_luck(analysis.luck.luck_of_study(study).best["Env0-v0"], best)


# ------------------------------------------------------------------------------- a known answer


def test_a_single_configuration_is_students_test():
    rng = np.random.default_rng(0)
    for n, m, shift in [(3, 3, 1), (5, 5, 0.5), (10, 4, 1), (5, 10, -0.5)]:
        noisy = np.full((1, max(n, m)), NAN)
        noisy[0, :n] = rng.normal(100 + shift, 1, n)
        baseline = np.full(max(n, m), NAN)
        baseline[:m] = rng.normal(100, 1, m)
        luck = analysis.luck.luck_of_study(make_study(baseline[:, None], noisy[..., None]))
        difference = np.nanmean(noisy) - np.nanmean(baseline)
        expected = stats.ttest_ind(noisy[0, :n], baseline[:m], alternative="greater").pvalue
        assert analysis.luck.p_of_luck(luck.best["Env0-v0"], difference) == pytest.approx(
            expected, abs=0.015
        )


def test_the_best_of_many_against_a_baseline_that_is_known():
    """P(best <= x) is the product over configurations of Phi(x sqrt(n) / std)."""
    rng, n = np.random.default_rng(0), np.array([4] * 20 + [25] * 10)
    draws = analysis.luck.draw_differences(10.0, MANY, MANY, n, rng)
    assert draws.shape == (30, analysis.luck.DRAWS)
    best = draws.max(axis=0)
    for difference in (5, 10, 15):
        expected = np.prod(stats.norm.cdf(difference * np.sqrt(n) / 10))
        assert np.mean(best <= difference) == pytest.approx(expected, abs=0.02)


def test_an_unlucky_baseline_is_part_of_the_luck():
    """With as many seeds the baseline adds as much variance as one configuration has."""
    rng = np.random.default_rng(0)
    draws = analysis.luck.draw_differences(10.0, MANY, 4, [4] * 50, rng)
    assert draws[0].std() == pytest.approx(5 * np.sqrt(2), rel=0.03)
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


def test_consistent_rows_by_luck():
    """A useless configuration is consistent in 6 of 32 cases: at least 4 of 5 fair coins."""
    rng = np.random.default_rng(0)
    study = make_study(rng.normal(100, 1, (4, 5)), rng.normal(100, 1, (40, 4, 5)))
    luck = analysis.luck.luck_of_study(study)
    assert luck.configurations == 40
    assert luck.consistent.mean() == pytest.approx(40 * 6 / 32, rel=0.05)
    assert luck.consistently_worse.mean() == pytest.approx(40 / 32, rel=0.1)


def test_a_configuration_counts_where_it_was_run():
    rng = np.random.default_rng(0)
    baseline, noisy = rng.normal(100, 1, (5, 3)), rng.normal(100, 1, (3, 5, 3))
    noisy[0, :, 1:] = NAN  # in one environment: consistent nowhere
    noisy[1, :, 2] = NAN
    baseline[:, 2] = NAN
    luck = analysis.luck.luck_of_study(make_study(baseline, noisy))
    assert np.isnan(luck.best["Env2-v0"]).all() and luck.configurations == 2
    assert luck.consistent.mean() == pytest.approx(2 / 4, abs=0.03)  # both of two environments
    assert luck.consistently_worse.max() == 2
    assert (luck.lowest <= luck.highest).all()


def test_no_spread_is_known_from_single_runs():
    alone = analysis.luck.luck_of_study(make_study(np.ones((1, 1)), np.ones((2, 1, 1))))
    best = pd.DataFrame([STUDY | {"environment": "Env0-v0", "difference": 1.0}])
    found = analysis.luck.add_luck_of_best(best, {("PPO", "", ""): alone})
    assert found[["luck_median", "luck_95", "p_luck"]].isna().all(axis=None)


def test_a_baseline_of_zero_is_drawn_in_units_of_the_return():
    """Its environment counts by sign; averages in percent are over the others."""
    rng = np.random.default_rng(0)
    baseline, noisy = rng.normal([0, 100], 1, (5, 2)), rng.normal([0, 100], 1, (3, 5, 2))
    baseline[:, 0] -= baseline[:, 0].mean()
    luck = analysis.luck.luck_of_study(make_study(baseline, noisy))
    assert list(luck.best) == ["Env0-v0", "Env1-v0"] and 0.2 < np.median(luck.best["Env0-v0"]) < 2
    assert luck.consistent.mean() == pytest.approx(3 / 4, abs=0.1)  # both of two environments
    assert 0.2 < np.median(luck.highest) < 2  # percent of 100
    luck = analysis.luck.luck_of_study(make_study(baseline[:, [0, 0]], noisy[..., [0, 0]]))
    assert np.isnan(analysis.luck.p_of_luck(luck.highest, np.nan))


# -------------------------------------------------------------------------------- false alarms


@pytest.mark.slow
@pytest.mark.parametrize(("n", "n_baseline", "most"), [(5, 5, 0.08), (10, 10, 0.08), (5, 20, 0.1)])
def test_useless_noise_is_seldom_beyond_luck(n, n_baseline, most, monkeypatch):
    """About 5 % of studies of 90 useless configurations claim that the best is beyond luck.

    Five runs resampled from only twenty are a little less spread than five new ones: 7 %.
    """
    monkeypatch.setattr(analysis.luck, "DRAWS", 400)
    rng, studies, p = np.random.default_rng(n), 400, []
    for _ in range(studies):
        seeds = max(n, n_baseline)
        baseline, noisy = np.full((seeds, 1), NAN), np.full((90, seeds, 1), NAN)
        baseline[:n_baseline, 0] = rng.normal(20, 1, n_baseline)
        noisy[:, :n, 0] = rng.normal(20, 1, (90, n))
        luck = analysis.luck.luck_of_study(make_study(baseline, noisy))
        best = np.nanmean(noisy, axis=1).max() - np.nanmean(baseline)
        p.append(analysis.luck.p_of_luck(luck.best["Env0-v0"], best))
    p = np.array(p)
    assert 0.03 <= (p <= 0.05).mean() <= most
    assert 0.4 <= (p <= 0.5).mean() <= 0.6


@pytest.mark.slow
def test_useless_noise_in_a_paper_is_beyond_luck_in_five_percent_of_studies(monkeypatch):
    """Only the baseline's standard deviation is known there, from n seeds."""
    monkeypatch.setattr(analysis.luck, "DRAWS", 400)
    n = 5
    rng, studies, p = np.random.default_rng(n), 500, []
    names = ["environment", "baseline_mean", "baseline_std", "difference"]
    for _ in range(studies):
        baseline, noisy = rng.normal(20, 1, n), rng.normal(20, 1, (90, n))
        best = noisy.mean(axis=1).max() - baseline.mean()
        values = ["Env0-v0", baseline.mean(), baseline.std(ddof=1), best]
        table = pd.DataFrame([STUDY | dict(zip(names, values, strict=True))])
        lucks = analysis.luck.luck_of_paper(table, {"PPO": n}, 90)
        p.append(analysis.luck.add_luck_of_best(table, lucks)["p_luck"].item())
    assert 0.03 <= (np.array(p) <= 0.05).mean() <= 0.08


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 10])
def test_the_page_says_how_often_p_luck_is_wrong_and_how_often_it_finds_an_effect(n, monkeypatch):
    monkeypatch.setattr(analysis.luck, "DRAWS", 400)
    page = (Path(analyze.__file__).parent / "docs/statistics.md").read_text()
    draws = {"high peak": simulate_choose.high_peak, "low peak": simulate_choose.failing}
    for name, gain in (("high peak", 0), ("low peak", 0), ("normal", 1.5)):
        [line] = re.findall(rf"^\| {name} \| {n} \| (.*) \|$", page, re.MULTILINE)
        cells = [cell.rstrip(" %") for cell in line.split(" | ")]
        place = 2 if gain else 0
        said = float(cells[place]), float(cells[4 + place])
        found = p_of_the_best(n, gain, draws.get(name, simulate_choose.normal))
        assert found == pytest.approx(said, abs=8), name
        if name == "low peak":
            assert found[1] <= 2.5


def p_of_the_best(n, gain, draw, studies=200):
    """Percent of studies of 90 configurations, one with a true gain, whose best is beyond luck.

    As analyze.py judges its own runs, and as it judges the paper's table.
    """
    rng, own, paper = np.random.default_rng(0), 0, 0
    for _ in range(studies):
        baseline, noisy = 20 + draw(rng, (n, 1)) / 10, 20 + draw(rng, (90, n, 1)) / 10
        noisy[0] += gain / 10
        best = noisy.mean(axis=1).max() - baseline.mean()
        lucks = analysis.luck.luck_of_study(make_study(baseline, noisy))
        own += analysis.luck.p_of_luck(lucks.best["Env0-v0"], best) <= analysis.statistics.LEVEL
        row = STUDY | {"environment": "Env0-v0", "difference": best}
        row |= {"baseline_mean": baseline.mean(), "baseline_std": baseline.std(ddof=1)}
        lucks = analysis.luck.luck_of_paper(pd.DataFrame([row]), {"PPO": n}, 90)
        paper += (
            analysis.luck.p_of_luck(lucks["PPO", "", ""].best["Env0-v0"], best)
            <= analysis.statistics.LEVEL
        )
    return 100 * own / studies, 100 * paper / studies


# -------------------------------------------------------------------------------------- tables


@pytest.mark.slow
def test_luck_stands_beside_the_best_and_the_consistent(tmp_path):
    small_sweep(tmp_path / "runs")
    tables = run(tmp_path, compare=PAPER)
    pusher = row(tables["best"], environment="Pusher-v5")
    finals = [values for key, values in FINALS.items() if key[0] == "Pusher-v5"]
    baseline, noisy = np.array(finals[0], float), np.array(finals[1:], float)
    assert pusher["p_luck"] == pytest.approx(luck_of_one_environment(baseline, noisy), abs=0.005)
    assert pusher["luck_median"] < pusher["luck_95"] < pusher["difference"]
    good, bad = tables["consistent"], tables["consistently_worse"]
    assert list(good["noise"]) == [SCALE] and 0 < good["p_luck"].item() < 0.05
    assert bad["p_luck"].item() == pytest.approx(1 / (analysis.luck.DRAWS + 1))
    luck = tables["luck"].iloc[0]
    assert (luck["environments"], luck["configurations"], luck["best_beyond_luck"]) == (2, 3, 2)
    assert (luck["consistent"], luck["consistently_worse"]) == (1, 1)
    assert luck["consistent_by_luck"] == pytest.approx(3 / 4, abs=0.05)
    assert luck["consistent_beyond_luck"] == luck["consistently_worse_beyond_luck"] == 1
    page = (tmp_path / "results/report.html").read_text()
    assert all(name in page for name in ("p luck", 'id="luck"', 'id="table-compare_luck"'))


def test_luck_in_the_papers_tables():
    lucks = analysis.paper.with_luck(analysis.paper.read_paper(PAPER))
    tables, luck = lucks[0], lucks[1].set_index("algorithm")
    assert luck["consistent"].to_dict() == {"PPO": 5, "SAC": 20, "TD3": 4}
    assert luck["consistently_worse"].to_dict() == {"PPO": 10, "SAC": 14, "TD3": 25}
    np.testing.assert_allclose(luck["consistent_by_luck"], 90 * 6 / 32, rtol=0.05)
    np.testing.assert_allclose(luck["consistently_worse_by_luck"], 90 / 32, rtol=0.1)
    best = tables["best"]
    walker = row(best, algorithm="PPO", environment="Walker2d-v2")
    # Of 90 means of 10 runs the highest, minus the baseline's: about 4.0 standard errors of 1206.7
    assert walker["luck_95"] > 4.0 * 1206.7 / np.sqrt(10)
    assert (best["p_luck"] > 0.1).all() and (best["p_luck"] < 1).all()
    assert luck["best_beyond_luck"].sum() == 0 == luck["consistent_beyond_luck"].sum()
