"""The sentences of analyze.py: when a noise may be called better, and what seeds could show."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import analysis.formatting
import analysis.rows
import analysis.runs
import analysis.statistics
import analysis.tables
import analysis.verdicts
from noisy_wrappers import BASELINE, Configuration

NOISE = "RandomEarlyTermination(50)"


def study(baseline, noisy):
    """One environment: final returns of the baseline, and those with noise, by its rate."""
    finals = {BASELINE: baseline}
    finals |= {Configuration.parse(NOISE, rate): values for rate, values in noisy.items()}
    most = max(map(len, finals.values()))
    returns = {}
    for config, values in finals.items():
        padded = np.full(most, np.nan)
        padded[: len(values)] = values
        returns[config] = padded.reshape(1, most, 1)
    seeds = list(range(most))
    return analysis.runs.Study("PPO", "", "", ["Pusher-v5"], seeds, np.array([1000]), returns)


def judge(baseline, noisy):
    """The statistics table and the sentences of such a study."""
    one = study(baseline, noisy)
    table = analysis.tables.adjust(
        analysis.tables.frame("statistics", analysis.rows.statistics_rows(one))
    )
    return table[table["p"].notna()], analysis.verdicts.sentences([one], table)


TEN = np.arange(100.0, 110)


def test_better_needs_the_corrected_p():
    table, said = judge(TEN, {"0.10": TEN + 100})
    assert list(said["verdict"]) == ["better"]
    p = 2 / 184756  # C(20, 10)
    assert table["p"].iloc[0] == pytest.approx(p)
    [text] = said["sentence"]
    who = f"PPO on Pusher-v5 with {NOISE} at rate 0.10"
    assert text.startswith(f"{who} is better than no noise: +96 % [")
    assert text.endswith("p < 0.001, the only comparison.")

    four = np.arange(100.0, 104)
    table, said = judge(four, {"0.10": four + 10, "0.20": four - 10, "0.30": four, "0.40": four})
    p, q = 2 / 70, 2 * 2 / 70  # two of four comparisons reach 2 / 70: times 4 / 2
    assert dict(zip(said["verdict"], said["sentence"], strict=False)).keys() == {
        "perhaps better",
        "perhaps worse",
        "no clear difference",
    }
    assert list(table["p_adjusted"][:2]) == pytest.approx([q, q]) and q > 0.05
    assert f"p = {p:.2g}, corrected for 4 comparisons {q:.2g}." in said["sentence"].iloc[0]
    assert "is perhaps better than no noise: +9.9 % [" in said["sentence"].iloc[0]
    assert "is perhaps worse than no noise: -9.9 % [" in said["sentence"].iloc[1]

    _, said = judge(four, {"0.10": four + 10, "0.20": four - 10})
    assert list(said["verdict"]) == ["better", "worse"]  # 2 / 70 twice of two: 0.029


def test_p_of_exactly_five_percent_is_enough():
    row = {"p": 0.05, "p_adjusted": 0.05, "probability_of_improvement": 1.0}
    assert analysis.verdicts.verdict(row) == "better"
    assert analysis.verdicts.verdict(row | {"probability_of_improvement": 0.0}) == "worse"
    assert analysis.verdicts.verdict(row | {"p_adjusted": 0.0501}) == "perhaps better"
    assert analysis.verdicts.verdict(row | {"p": 0.0501}) == "no clear difference"
    assert pd.isna(analysis.verdicts.verdict(row | {"p": np.nan}))


def test_three_seeds_cannot_show_anything():
    _, said = judge([10.0, 11, 12], {"0.10": [110.0, 111, 112]})
    [text] = said["sentence"]
    assert "shows no clear difference: +909 % [" in text
    assert "p = 0.1; 3 seeds cannot show any (smallest possible p: 0.1)" in text
    _, said = judge([10.0], {"0.10": [5.0]})
    [text] = said["sentence"]
    assert "difference: -50 %, p = 1; 1 seed cannot show any (smallest possible p: 1)." in text
    _, said = judge([10.0, 11, 12], {"0.10": [9.0, 10]})
    [text] = said["sentence"]
    assert "2 seeds against 3 cannot show any (smallest possible p: 0.2)" in text


def test_no_clear_difference_says_what_the_seeds_could_have_shown():
    table, said = judge(TEN, {"0.10": TEN + 1.5})
    spread = 100 * TEN.std(ddof=1) / TEN.mean()  # the same on both sides
    shift = analysis.statistics.detectable_shift(10, 10)
    row = table.iloc[0]
    assert row["detectable_percent"] == pytest.approx(shift * spread)
    observed = 100 * 1.5 / TEN.mean() / spread  # in standard deviations
    assert row["seeds_needed"] == analysis.statistics.seeds_needed(round(observed, 3)) > 30
    [text] = said["sentence"]
    assert f"; 10 seeds could have shown {shift * spread:.1f} % (80 % power), and 1.4 %" in text
    assert f" would take about {row['seeds_needed']:.0f} seeds each." in text
    _, said = judge(TEN, {"0.10": TEN})
    assert "0.0 % would take more than 1,000 seeds each." in said["sentence"].iloc[0]


@pytest.mark.parametrize(("n", "m"), [(4, 4), (5, 5), (10, 5), (10, 10), (40, 40)])
def test_the_detectable_shift_is_found_in_80_percent_of_the_cases(n, m):
    rng = np.random.default_rng(3)
    x = rng.normal(analysis.statistics.detectable_shift(n, m), 1, (1500, n))
    y = rng.normal(0, 1, (1500, m))
    p = stats.mannwhitneyu(x, y, axis=1, method="exact").pvalue
    assert (p <= 0.05).mean() == pytest.approx(0.8, abs=0.035)


@pytest.mark.parametrize("n", [4, 5, 10, 30])
def test_the_shifts_that_are_listed_are_those_of_the_simulation(n):
    simulated = analysis.statistics.simulated_shift(n, n, 0.05)
    assert analysis.statistics.detectable_shift(n, n) == pytest.approx(simulated, rel=0.005)


def test_seeds_needed_is_the_first_number_that_finds_the_shift():
    assert np.isnan(analysis.statistics.detectable_shift(3, 3))
    for shift in (3.0, 2.0, 1.2):
        n = analysis.statistics.seeds_needed(shift)
        assert analysis.statistics.detectable_shift(n, n) <= shift
        assert n == 4 or not analysis.statistics.detectable_shift(n - 1, n - 1) <= shift
    # Noether: (1.96 + 0.8416)^2 * 2 * pi / 3 / 0.3^2 = 182.6
    assert analysis.statistics.seeds_needed(0.3) == 183


def test_the_power_is_said_to_be_before_the_correction():
    """Five seeds show 20 % as "perhaps" at most: 0.0079 times ten comparisons is above 0.05."""
    five = np.arange(100.0, 105)
    _, said = judge(five, {f"{i / 10:.2f}": five + i / 100 for i in range(1, 11)})
    before = "(80 % power before the correction for 10 comparisons, which no noise can pass alone)"
    assert all(before in text for text in said["sentence"])
    _, said = judge(TEN, {"0.10": TEN + 0.1, "0.20": TEN - 0.1})
    assert all(
        "(80 % power before the correction for 2 comparisons)" in t for t in said["sentence"]
    )
    _, said = judge(TEN, {"0.10": TEN + 0.1})
    assert "(80 % power)" in said["sentence"].iloc[0]


def test_a_sentence_says_which_decides_where_test_and_interval_disagree():
    odd = " Test and interval disagree: the test decides."
    # One run that fails lowers the interquartile mean's lower end, not the order of the others.
    table, said = judge([*range(100, 105)], {"0.10": [60.0, 110, 111, 112, 113, 114, 115]})
    row = table.iloc[0]
    assert row["p"] <= 0.05 and row["improvement_low"] < 0 < row["improvement_high"]
    assert said["sentence"].iloc[0].endswith(odd)
    _, said = judge(TEN, {"0.10": TEN + 100})
    assert odd not in said["sentence"].iloc[0]
    assert analysis.verdicts.disagrees("no clear difference", 1.0, 2.0) == odd
    assert analysis.verdicts.disagrees("better", -2.0, -1.0) == odd
    assert (
        analysis.verdicts.disagrees("worse", np.nan, np.nan)
        == analysis.verdicts.disagrees("worse", -2.0, -1.0)
        == ""
    )


def test_far_runs_explain_where_mean_and_iqm_disagree():
    low = np.linspace(1500, 1700, 8)
    baseline = [*low, 4095, 3602]
    noisy = np.linspace(1500, 1710, 10)
    _, said = judge(baseline, {"0.10": noisy})
    [text] = said["sentence"]
    change = 100 * (np.mean(noisy) / np.mean(baseline) - 1)
    assert text.endswith(
        f" The mean says {change:.0f} %: 2 of 10 runs without noise lie far above the others."
    )
    _, said = judge(TEN, {"0.10": TEN + 50})
    assert "The mean says" not in said["sentence"].iloc[0]


def test_seeds_without_spread_and_a_baseline_of_zero_are_no_error():
    _, said = judge([5.0] * 5, {"0.10": [5.0] * 5})
    assert said["sentence"].iloc[0].endswith("difference: +0.0 % [0.0, 0.0], p = 1.")
    _, said = judge([-1.0, 0, 1, 0, 0], {"0.10": [10.0, 11, 12, 13, 14]})
    assert said["sentence"].iloc[0].endswith("than no noise: p = 0.0079, the only comparison.")


def test_of_many_comparisons_the_first_are_shown_and_all_are_counted():
    four = np.arange(100.0, 104)
    noisy = {f"{rate:.2f}": four + rate for rate in np.linspace(0, 1, 20)}
    noisy["0.99"] = four + 50
    _, said = judge(four, noisy)
    first, rest = analysis.verdicts.clear_first(said, 10)
    assert len(first) == 0 and len(rest) == 21
    tally = analysis.verdicts.tally(rest["verdict"])
    assert tally == "21 comparisons: 1 perhaps better, 20 no clear difference"

    ten = {f"{rate:.2f}": TEN + (50 if rate > 0.5 else -50) for rate in np.linspace(0.1, 1, 19)}
    _, said = judge(TEN, ten)
    first, rest = analysis.verdicts.clear_first(said, 12)
    assert list(first["verdict"]) == 10 * ["better"] + 2 * ["worse"]
    assert list(rest["verdict"]) == 7 * ["worse"]


def test_a_row_of_all_environments_shows_the_range_of_its_baselines():
    columns = {"n_baseline": [10, 5], "n_baseline_most": [50, 5], "p": [0.5, 0.5]}
    formats = analysis.tables.FORMATS
    table = analysis.formatting.Table("t", pd.DataFrame(columns), "", "", formats)
    assert list(analysis.formatting.shown(table)["n baseline"]) == ["10 to 50", "5"]
    row = {"n": 5, "n_baseline": 10, "n_baseline_most": 50, "smallest_p": 0.1, "seeds_needed": 4}
    assert "5 seeds against 10 to 50 cannot" in analysis.verdicts.reach(row)
