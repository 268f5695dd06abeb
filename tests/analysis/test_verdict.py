"""The sentences of analyze.py: when a noise may be called better, and what seeds could show."""

import numpy as np
import pandas as pd
import pytest

import analysis.formatting
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
    table = analysis.tables.judge([one])
    return table[table["verdict"].notna()], analysis.verdicts.in_sentences(table)


TEN = np.arange(100.0, 110)
WHO = f"PPO on Pusher-v5 with {NOISE} at rate"


def test_better_needs_the_corrected_p():
    table, said = judge(TEN, {"0.10": TEN + 100})
    assert list(said["verdict"]) == ["better"]
    assert list(said["sentence"]) == [
        f"{WHO} 0.10 is better than no noise: +100.0 [97.2, 102.8] (+96 %), p < 0.001, "
        "the only comparison there."
    ]
    five = np.arange(100.0, 105)
    same = {f"0.{i}0": five for i in range(3, 10)}
    table, said = judge(five, {"0.10": five + 10, "0.20": five - 10} | same)
    p, q = 2 / 252, 9 / 2 * 2 / 252  # two of nine comparisons reach 2 / 252
    assert list(table["p_adjusted"][:2]) == pytest.approx([q, q]) and p < 0.05 < 2 * q
    assert list(said["verdict"][:2]) == ["better", "worse"]
    table, said = judge(five, {"0.10": five + 10} | same)
    assert list(said["verdict"]) == ["perhaps better"] + 7 * ["no clear difference"]
    assert said["sentence"].iloc[0] == (
        f"{WHO} 0.10 is perhaps better than no noise: +10.0 [7.7, 12.3] (+9.8 %), p = 0.0079, "
        "corrected for 8 comparisons 0.063."
    )


def test_together_are_the_environments_that_can_tell_something():
    """Those with two seeds of both kinds, and not those where all returns are equal."""
    baseline = np.array([[1.0, 5, 1, 7], [2, 6, 2, 7], [3, 7, 3, 7]])
    noisy = baseline + [1, 2, 3, 0]
    noisy[1:, 2] = np.nan
    returns = {BASELINE: baseline[None], Configuration((NOISE,), ((1.0, 1.0),)): noisy[None]}
    one = analysis.runs.Study("PPO", "", "", list("ABCD"), [1, 2, 3], np.array([1000]), returns)
    table = analysis.tables.judge([one])
    [environments] = table[table["scope"] == "all"]["environments"]
    assert environments == 2


def test_p_of_exactly_five_percent_is_enough():
    row = {"smallest_p": 0.01, "p": 0.05 + 1e-15, "p_adjusted": 0.05, "t": 2.0}
    assert analysis.verdicts.verdict(row) == "better"
    assert analysis.verdicts.verdict(row | {"t": -2.0}) == "worse"
    assert analysis.verdicts.verdict(row | {"p_adjusted": 0.0501}) == "perhaps better"
    assert analysis.verdicts.verdict(row | {"p": 0.0501}) == "no clear difference"
    assert analysis.verdicts.verdict(row | {"p": np.nan}) == "too few seeds"
    assert pd.isna(analysis.verdicts.verdict(row | {"smallest_p": np.nan}))


def test_few_seeds():
    """Below five there is no interval, with three no p of 0.05, with one no p."""
    _, said = judge([10.0, 11, 12, 13], {"0.10": [110.0, 111, 112, 113]})
    assert said["sentence"].iloc[0] == (
        f"{WHO} 0.10 is better than no noise: +100.0 (+870 %), p = 0.029 (smallest possible: "
        "0.029), the only comparison there."
    )
    _, said = judge([10.0, 11, 12], {"0.10": [110.0, 111, 112]})
    [text] = said["sentence"]
    assert "shows no clear difference: +100.0 (+909 %), p = 0.1; 3 seeds cannot show any" in text
    assert "(smallest possible p: 0.1)" in text
    _, said = judge([10.0, 11, 12], {"0.10": [9.0, 10]})
    assert "2 seeds against 3 cannot show any" in said["sentence"].iloc[0]
    _, said = judge([10.0], {"0.10": [5.0]})
    assert list(said["verdict"]) == ["too few seeds"]
    expected = f"{WHO} 0.10 has too few seeds for a test: -5.000 (-50 %)."
    assert list(said["sentence"]) == [expected]


def test_no_clear_difference_says_what_the_seeds_could_have_shown():
    table, said = judge(TEN, {"0.10": TEN + 1.5})
    row, spread = table.iloc[0], TEN.std(ddof=1)  # the same on both sides
    shift = analysis.statistics.detectable_shift(10, 10)
    assert row["detectable"] == pytest.approx(shift * spread)
    assert row["seeds_needed"] == analysis.statistics.seeds_needed(round(1.5 / spread, 3)) > 30
    [text] = said["sentence"]
    assert f"; 10 seeds could have shown {shift * spread:.1f} (80 % power), and 1.5 would" in text
    assert f" would take about {row['seeds_needed']:.0f} seeds each." in text
    _, said = judge(TEN, {"0.10": TEN + 0.01})
    [text] = said["sentence"]
    assert ": 0.0 [" in text and "] (0.0 %), p" in text  # no sign of what is written as zero
    assert " and 0.010 would take more than 1,000 seeds each." in text
    _, said = judge(TEN, {"0.10": TEN})
    assert "would take" not in said["sentence"].iloc[0]


def test_the_power_is_said_to_be_before_the_correction():
    """Five seeds show something as "perhaps" at most: 0.0079 times ten comparisons is over 0.05."""
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


def test_where_interval_and_p_differ_is_borderline():
    """With spreads and numbers of seeds that differ, the two methods are least alike."""
    rng, found = np.random.default_rng(0), set()
    for _ in range(40):
        x, y = rng.normal(1.2, 1, 5), rng.normal(0, 1, 5)
        table, said = judge(100 + y, {"0.10": 100 + x})
        row, [text] = table.iloc[0], said["sentence"]
        excludes = row["difference_low"] > 0 or row["difference_high"] < 0
        differ = excludes != (row["p"] <= 0.05)
        ending = f" Borderline: the interval {'excludes' if excludes else 'includes'} zero."
        assert text.endswith(ending) == differ and ("Borderline" in text) == differ
        found.add((differ, excludes))
    assert len(found) >= 3  # with and without, and at least one way to differ


@pytest.mark.parametrize(
    ("baseline", "noisy", "expected"),
    [
        (
            [5.0] * 5,
            [5.0] * 5,
            "all tests of all runs have the same result.",
        ),
        ([0.0] * 5, [0.0] * 5, "cannot be judged"),
        ([0.0] * 5, [1.0] * 5, "is better than no noise: +1.000 [1.000, 1.000], p = 0.0079"),
        ([-1.0, 0, 1, 0, 0], [10.0, 11, 12, 13, 14], "noise: +12.0 [10.1, 13.9], p = 0.0079"),
        # MountainCarContinuous learns to do nothing
        (
            [-1e-6, 2e-6, -1e-6, 1e-6, 0],
            [-20.0, -21, -22, -23, -24],
            "is worse than no noise: -22.0 [-24.0, -20.0], p = 0.0079",
        ),
        (
            [0.86, 0.87, 0.88, 0.87, 0.87],
            [0.92, 0.93, 0.94, 0.93, 0.93],
            "+0.060 [0.050, 0.070] (+6.9 %)",
        ),
        (
            [-50.0, -51, -52, -53, -54],
            [-40.0, -41, -42, -43, -44],
            "better than no noise: +10.0 [7.7, 12.3] (+19 %)",
        ),
        (
            [3e-9, 3.1e-9, 3.2e-9, 3.3e-9, 3.4e-9],
            [1e-9, 1.1e-9, 1.2e-9, 1.3e-9, 1.4e-9],
            "worse than no noise: -2.00e-09 [-2.23e-09, -1.77e-09] (-62 %)",
        ),
    ],
)
def test_numbers_of_any_size(baseline, noisy, expected):
    _, said = judge(baseline, {"0.10": noisy})
    assert expected in said["sentence"].iloc[0]


@pytest.mark.parametrize(
    ("value", "spread", "expected"),
    [(0.013, 2.4, "0.013"), (-0.013, 2.4, "-0.013"), (0.06, 2.4, "0.1"), (0.0, 2.4, "0.0")]
    + [(1e-12, 2.4, "0.0"), (4.7, 2.4, "4.7")],  # 1e-12 is a rounding error
)
def test_an_end_of_an_interval_looks_like_zero_only_if_it_is(value, spread, expected):
    assert analysis.verdicts.not_zero(value, spread) == expected
    assert analysis.formatting.text_of("difference_low", value, spread) == expected


def test_a_p_above_the_level_does_not_look_like_it():
    said = [analysis.verdicts.p_value(p) for p in (0.0496, 0.05, 0.0504, 0.051, 0.0004)]
    assert said == ["= 0.05", "= 0.05", "= 0.0504", "= 0.051", "< 0.001"]
    assert analysis.formatting.text_of("p_adjusted", 0.0504) == "0.0504"


def test_of_many_comparisons_the_first_are_shown_and_all_are_counted():
    five = np.arange(100.0, 105)
    noisy = {f"{rate:.2f}": five + rate for rate in np.linspace(0, 1, 20)}
    noisy["0.99"] = five + 50
    _, said = judge(five, noisy)
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
    table = analysis.formatting.Table("t", pd.DataFrame(columns), "", "")
    assert list(analysis.formatting.shown(table)["n baseline"]) == ["10 to 50", "5"]
    row = {"n": 5, "n_baseline": 10, "n_baseline_most": 50, "smallest_p": 0.1, "seeds_needed": 4}
    assert "5 seeds against 10 to 50 cannot" in analysis.verdicts.power(row)


def test_a_table_has_the_digits_that_the_spread_deserves():
    numbers = {"mean": [0.8712, 9512.3, 1e-6, 5.0], "std": [0.034, 210.0, 0, np.nan]}
    numbers |= {"score": [0.5, np.nan, 1234567.8, 0], "paper_mean": 4 * [0.8712]}
    table = analysis.formatting.Table("t", pd.DataFrame(numbers), "", "")
    text = analysis.formatting.shown(table)
    assert list(text["mean"]) == [
        "0.871 \u00b1 0.034",
        "9,512 \u00b1 210",
        "1.000e-06 \u00b1 0",
        "5.000 \u00b1 \u2013",
    ]
    assert list(text["score"]) == ["0.5000", "\u2013", "1,234,568", "0"]
    assert list(text["paper mean"]) == 4 * ["0.9"]  # as the paper has them
