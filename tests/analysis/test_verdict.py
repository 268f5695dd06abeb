"""The sentences of analyze.py: when a noise may be called better, and what is excluded."""

import numpy as np
import pandas as pd
import pytest

import analysis.formatting
import analysis.verdicts
from analysis.comparisons import compare_all
from analysis.robustness import robustness_sentences
from analysis.studies import Study
from noisy_wrappers import BASELINE, Configuration

TEN = np.arange(100.0, 110)
WHO = "PPO on Pusher-v5 with RandomEarlyTermination"


def study(environments, finals, *metric):
    """A study of final returns, {configuration: (seeds x environments)}."""
    curves = {config: values[None] for config, values in finals.items()}
    seeds, steps = list(range(len(finals[BASELINE]))), np.array([1000])
    return Study("PPO", "", "", "", environments, seeds, steps, curves, finals, *metric)


def judge(baseline, *noisy, smallest_gain=None, metric="return"):
    """The comparisons and the sentences of noises with these samples, in one environment."""
    most = max(map(len, (baseline, *noisy)))
    finals = {}
    for number, values in enumerate((baseline, *noisy)):
        padded = np.full((most, 1), np.nan)
        padded[: len(values), 0] = values
        noise = Configuration.parse(f"RandomEarlyTermination({number})", 0.1)
        finals[noise if number else BASELINE] = padded
    one = study(["Pusher-v5"], finals, metric, 10 if metric != "return" else None)
    table = compare_all([one], smallest_gain).noises
    unit = analysis.verdicts.POINTS if metric != "return" else ""
    return table, analysis.verdicts.in_sentences(table, unit, smallest_gain)


def test_better_needs_the_corrected_p():
    table, said = judge(TEN, TEN + 100)
    assert said["sentence"].tolist() == [
        f"{WHO}(1) at rate 0.10 is better than no noise: +100.0 [97.2, 102.8] (+96 % [91, 100]), "
        "p < 0.001, the only comparison there."
    ]
    five = np.arange(100.0, 105)
    table, said = judge(five, five + 10, five - 10, *[five] * 7)
    q = 9 / 2 * 2 / 252  # two of nine comparisons reach 2 / 252
    assert list(table["p_adjusted"][:2]) == pytest.approx([q, q])
    counts = said["verdict"].value_counts().to_dict()
    assert counts == {"better": 1, "worse": 1, "no clear difference": 7}
    table, said = judge(five, five + 10, *[five] * 7)
    assert set(said["verdict"]) == {"no clear difference"} and table["p"][0] < 0.05
    assert "p = 0.0079, corrected for 8 comparisons 0.063." in said["sentence"].iloc[0]


def test_p_of_exactly_five_percent_is_enough():
    row = {"smallest_p": 0.01, "p": 0.05 + 1e-15, "p_adjusted": 0.05, "t": 2.0}
    row |= {"effect_size": np.inf, "difference_percent": np.nan}
    assert analysis.verdicts.verdict(row) == "better"
    assert analysis.verdicts.verdict(row | {"t": -2.0, "effect_size": -1.0}) == "worse"
    assert analysis.verdicts.verdict(row | {"p_adjusted": 0.0501}) == "no clear difference"
    assert analysis.verdicts.verdict(row | {"p": np.nan}) == "too few seeds"
    assert pd.isna(analysis.verdicts.verdict(row | {"smallest_p": np.nan}))
    never_varies = row | {"p_adjusted": 1.0, "difference_low": 0.0, "difference_high": 0.0}
    never_varies["percent_high"] = 0.0  # which excludes no gain
    assert analysis.verdicts.verdict(never_varies, smallest_gain=5) == "no clear difference"


def test_few_seeds():
    """Below five there is no interval, with three no p of 0.05, with one or equal returns no p."""
    _, said = judge([10.0, 11, 12, 13], [110.0, 111, 112, 113])
    expected = "better than no noise: +100.0 (+870 %), p = 0.029 (smallest possible: 0.029; too few"
    assert expected in said["sentence"].iloc[0]
    _, said = judge([10.0, 11, 12], [9.0, 10])
    assert "2 runs against 3 cannot show any (smallest possible p" in said["sentence"].iloc[0]
    _, said = judge([10.0], [5.0])
    assert said["verdict"].tolist() == ["too few seeds"]
    _, said = judge([5.0] * 5, [5.0] * 5)
    assert "cannot be judged: all tests" in said["sentence"].iloc[0]


def test_an_unclear_verdict_says_what_is_excluded():
    table, said = judge(TEN, TEN + 1.5)
    row, [text] = table.iloc[0], said["sentence"]
    low, high = row[["percent_low", "percent_high"]]
    assert f"excluded: a gain of more than {high:.1f} %, a loss of more than {-low:.1f} %." in text
    assert low < 0 < row["difference_percent"] < high
    _, said = judge(TEN - 104.5, TEN - 104)  # of nearly zero there is no percentage
    [text] = said["sentence"]
    assert "a gain of more than 3.3, a loss of more than 2.3." in text and "%" not in text
    _, said = judge(TEN, TEN + 0.01)
    assert ": 0.0 [" in said["sentence"].iloc[0]  # no sign of what is written as zero


def test_a_gain_that_matters_may_be_excluded():
    high = judge(TEN, TEN - 1)[0]["percent_high"][0]
    for gain, verdict in ((high + 0.01, "no such gain"), (high - 0.01, "no clear difference")):
        table, said = judge(TEN, TEN - 1, smallest_gain=gain)
        assert table["verdict"].tolist() == [verdict]
    _, said = judge(TEN, TEN - 1, smallest_gain=5)
    assert "at rate 0.10 shows no gain of 5 %: -1.0 [" in said["sentence"].iloc[0]
    assert judge(TEN, TEN + 50, smallest_gain=5)[0]["verdict"].tolist() == ["better"]
    assert judge(TEN, TEN - 50, smallest_gain=5)[0]["verdict"].tolist() == ["worse"]
    near_zero = judge(TEN - 104.5, TEN - 104, smallest_gain=1e9)[0]  # nothing is in percent there
    assert near_zero["verdict"].tolist() == ["no clear difference"]
    rates = np.array([90.0, 100, 90, 100, 100])
    table, said = judge(rates, rates, smallest_gain=30, metric="success rate")
    assert table["verdict"].tolist() == ["no such gain"]
    assert "no gain of 30 percentage points of success" in said["sentence"].iloc[0]


def test_together_are_the_environments_that_can_tell_something():
    """Those with two seeds of both kinds, and not those where all returns are equal."""
    baseline = np.array([[1.0, 5, 1, 7], [2, 6, 2, 7], [3, 7, 3, 7]])
    noisy = baseline + [1, 2, 3, 0]
    noisy[1:, 2] = np.nan
    finals = {BASELINE: baseline, Configuration.parse("RandomEarlyTermination(50)", 1.0): noisy}
    compared = compare_all([study(list("ABCD"), finals)])
    assert compared.noises_together["environments"].tolist() == [2]
    [text] = analysis.verdicts.in_sentences(compared.noises_together)["sentence"]
    assert "PPO on 2 environments together" in text


def test_returns_that_never_vary_have_no_standard_deviations():
    noisy = Configuration.parse("RandomEarlyTermination(50)", 1.0)
    table = compare_all([study(["A", "B"], {BASELINE: np.ones((5, 2)), noisy: np.zeros((5, 2))})])
    [text] = analysis.verdicts.in_sentences(table.noises_together)["sentence"]
    assert "worse than no noise: lower, by returns that never vary in at least half of" in text


def test_averages_that_differ_in_direction_are_no_verdict():
    """Three environments gain 1 %, always, and one may lose more."""
    baseline = np.stack([TEN[:5] + 900] * 3 + [np.array([10.0, 60, 100, 140, 190])], axis=1)
    noisy = baseline + [10, 10, 10, -25]
    finals = {BASELINE: baseline, Configuration.parse("RandomEarlyTermination(50)", 1.0): noisy}
    table = compare_all([study(list("ABCD"), finals)]).noises_together
    assert table["p"][0] < 0.05 and table["t"][0] > 0 > table["difference_percent"][0]
    assert list(table["verdict"]) == ["no clear difference"]
    tested = table.assign(p_holm=table["p"], conditions=1, conditions_tested=1, where="all")
    tested = tested.assign(clean_change_percent=np.nan)
    sentences = robustness_sentences(tested, "return")
    for said in (*analysis.verdicts.in_sentences(table)["sentence"], *sentences):
        assert "no clear difference" in said and "direction" in said


def test_a_rate_that_alone_ran_everywhere_has_its_own_verdict():
    """Not that of the noise, which other rates made."""
    baseline = np.stack([TEN[:5], TEN[:5]], axis=1)
    finals = {BASELINE: baseline}
    for rate, changes in (0.1, (0.4, 0.4)), (0.5, (-50, np.nan)), (1.0, (np.nan, -50)):
        finals[Configuration.parse("RandomEarlyTermination(1)", rate)] = baseline + changes
    compared = compare_all([study(["Hopper-v5", "Pusher-v5"], finals)])
    assert list(compared.noises_together["verdict"]) == ["worse"]
    assert list(compared.rates_together["verdict"]) == ["no clear difference"]


def test_where_interval_and_p_differ_is_borderline():
    for noisy, p, said in (
        ([102.0, 104, 105, 108, 109], 16 / 252, "excludes"),
        ([103.0, 104, 106, 115, 115], 10 / 252, "includes"),
    ):
        table, judged = judge(TEN[:5], noisy)
        assert table["p"].tolist() == pytest.approx([p])
        assert judged["sentence"][0].endswith(f" Borderline: the interval {said} zero.")


def test_an_end_of_an_interval_looks_like_zero_only_if_it_is():
    ends = {0.013: "0.013", -0.013: "-0.013", 0.06: "0.1", 0.0: "0.0", 4.7: "4.7"}
    ends |= {1e-12: "0.0"}  # a rounding error
    for end, text in ends.items():
        assert analysis.formatting.text_of("difference_low", end, spread=2.4) == text
    assert analysis.formatting.text_of("percent_low", -0.011) == "-0.01"
    assert analysis.formatting.text_of("percent_high", 1e-12) == "0.0"
    assert analysis.formatting.rounded(-2e-9, 1e-10) == "-2.00e-09"


def test_what_is_excluded_agrees_with_the_ends_of_both_intervals():
    """Welch's and Fieller's may end on two sides of zero, and close to it."""

    def said(low, high, percent_low, percent_high):
        row = {"difference": 5.0, "difference_low": low, "difference_high": high}
        row |= {"difference_percent": 5.0, "percent_low": percent_low, "percent_high": percent_high}
        row = pd.Series(row)
        return analysis.verdicts.excluded(row).removeprefix("; excluded: ").split(", ")

    assert said(-0.011, 10, -0.011, 11)[1] == "a loss of more than 0.01 %"
    assert said(-0.26, 10, 0.3, 11)[1] == "a loss of more than 0.3"
    assert said(-9, 0.2, -9, -0.1)[0] == "a gain of more than 0.2"
    assert said(0.2, 10, 0.3, 11) == said(-9, 0.0, -9, 0.0) == [""]  # not corrected
    assert said(0.0, 0.0, 0.0, 0.0) == [""]  # returns that never vary say nothing of other seeds


def test_a_p_above_the_level_does_not_look_like_it():
    said = [analysis.formatting.p_value(p) for p in (0.0496, 0.05, 0.0504, 0.051, 0.0004)]
    assert said == ["= 0.05", "= 0.05", "= 0.0504", "= 0.051", "< 0.001"]
    assert analysis.formatting.text_of("p_adjusted", 0.0504) == "0.0504"


def test_of_many_comparisons_the_first_are_shown_and_all_are_counted():
    _, said = judge(TEN, *[TEN + (50 if i > 9 else -50) for i in range(1, 20)])
    first, rest = analysis.verdicts.clear_first(said, 12)
    assert list(first["verdict"]) == 10 * ["better"] + 2 * ["worse"]
    assert analysis.verdicts.tally(rest["verdict"]) == "7 comparisons: 7 worse"


def test_which_numbers_of_seeds_are_lopsided():
    seeds = [(5, 13), (5, 14), (50, 5), (30, 50), (20, 100), (3, 3)]
    expected = [False, True, True, False, False, False]
    assert [analysis.verdicts.is_lopsided(*pair) for pair in seeds] == expected
    assert analysis.verdicts.is_lopsided(5, 9, analysis.verdicts.MOST_RATIO_OF_RATES)
