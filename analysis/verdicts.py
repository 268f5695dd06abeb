"""One plain sentence for each comparison: is this noise better than no noise?

A comparison is a row of a frame of analysis/comparisons.py.
"""

from math import nan

import numpy as np
import pandas as pd

from analysis.folders import SUCCESS
from analysis.formatting import (
    is_zero,
    listed,
    not_zero,
    p_text,
    p_value,
    percent,
    percent_end,
    rounded,
)
from analysis.power import LEVEL
from analysis.runs import STUDY, rows_of, study_name
from analysis.statistics import holm
from analysis.words import counted

BETTER, WORSE = CLEAR = ["better", "worse"]
NO_SUCH_GAIN = "no such gain"  # as --smallest-gain asks for
UNCLEAR = "no clear difference"
TOO_FEW = "too few seeds"
ALL_EQUAL = "all equal"  # all tests of all runs
VERDICTS = [BETTER, WORSE, NO_SUCH_GAIN, UNCLEAR, TOO_FEW, ALL_EQUAL]  # in this order
POINTS = " percentage points of success"
# With more times the seeds on one side, and few on the other, a test may be wrong too often where
# noise changes the spread of lopsided returns: docs/statistics.md. Comparisons of noises are noted,
# those of single rates have no verdict.
MOST_RATIO, MOST_RATIO_OF_RATES, SEEDS_FOR_ANY_RATIO = 2.6, 1.6, 20


def verdict(row, smallest_gain=None, metric=None):
    """Name the verdict of a comparison: one of VERDICTS, or NaN where nothing is to be judged."""
    if pd.isna(row["smallest_p"]):
        return nan
    if row.get("verdict") == ALL_EQUAL:
        return ALL_EQUAL
    if pd.isna(row["p"]):
        return TOO_FEW
    if significant(row["p_adjusted"]):
        way = direction(row["t"], row["effect_size"], row["difference_percent"])
        return {1: BETTER, -1: WORSE, 0: UNCLEAR}[way]
    if smallest_gain is not None and row["difference_low"] < row["difference_high"]:
        limit = row["difference_high"] if metric == SUCCESS else row["percent_high"]
        if limit < smallest_gain:
            return NO_SUCH_GAIN
    return UNCLEAR


def significant(p, level=LEVEL):
    """Tell whether a p-value is at most the level, in spite of rounding errors."""
    return round(p, 12) <= level


def direction(*sizes):
    """Return the sign of all sizes of a comparison that are not NaN, or 0 where they have several.

    Over several environments they may: t, the median effect and the mean of the percentages.
    """
    signs = {np.sign(size) for size in sizes if not np.isnan(size)}
    return signs.pop() if len(signs) == 1 else 0


def is_lopsided(n, n_baseline, most=MOST_RATIO):
    """Tell whether the numbers of seeds differ so much that a test may be wrong too often."""
    few, many = sorted((n, n_baseline))
    return few < SEEDS_FOR_ANY_RATIO and many > most * few


# ------------------------------------------------------------------------------- parts of sentences


def spread_of(row):
    """Return what a comparison's difference may be off by: half its interval, or its spread."""
    half = (row.difference_high - row.difference_low) / 2
    return row.pooled_std if pd.isna(half) else half


def difference_in_words(row, unit="", of=""):
    """Write what a comparison found: "+11.8 [8.4, 15.3] (+21 % [15, 28])".

    Of several environments in standard deviations. unit: of the difference, such as POINTS; of:
    what the percentages are of, if that is not the mean without noise.
    """
    if pd.isna(row.difference):
        text = f"{row.effect_size:+z.2f} standard deviations in the median environment"
        if pd.isna(row.effect_size):
            text = "effects that have no median"
        elif np.isinf(row.effect_size):
            way = "higher" if row.effect_size > 0 else "lower"
            text = f"{way}, by returns that never vary in at least half of the environments"
    else:
        spread = spread_of(row)
        text = rounded(row.difference, spread)
        text = f"+{text}" if row.difference > 0 and not is_zero(text) else text
        if pd.notna(row.difference_low):
            ends = row.difference_low, row.difference_high
            text += f" [{', '.join(not_zero(end, spread) for end in ends)}]"
        text += unit
    if pd.notna(row.difference_percent):
        average = " on average" if pd.isna(row.difference) else ""
        text += f" ({percent(row.difference_percent)}{percent_interval(row)}{average}{of})"
    return text


def percent_interval(row):
    """Write the interval of a change in percent: " [15, 28]", or ""."""
    if pd.isna(row.percent_low):
        return ""
    ends = row.percent_low, row.percent_high
    return f" [{', '.join(percent_end(end).removesuffix(' %') for end in ends)}]"


def excluded(row, unit=""):
    """Say which gains and losses the interval of a comparison excludes, or "".

    An interval on one side of zero says nothing: it is not corrected, and the verdict is.
    """
    if not row.difference_low < 0 < row.difference_high:
        return ""
    spread = spread_of(row)

    def beyond(what, end, end_in_percent):
        if end_in_percent > 0:
            return f"a {what} of more than {percent_end(end_in_percent)}"
        return f"a {what} of more than {not_zero(end, spread)}{unit}"

    gain = beyond("gain", row.difference_high, row.percent_high)
    loss = beyond("loss", -row.difference_low, -row.percent_low)
    return f"; excluded: {gain}, {loss}"


def corrected(p, number, what):
    """Write a p-value that is corrected for a number of comparisons, if there are several."""
    if number == 1:
        return ""
    return f", corrected for {counted(number, what)} {p_text(p)}"


def borderline(row, level=LEVEL):
    """Say where the interval of a comparison, of this level, and its p differ, or ""."""
    if pd.isna(row.difference_low) or pd.isna(row.p):
        return ""
    excludes_zero = row.difference_low > 0 or row.difference_high < 0
    if excludes_zero == significant(row.p, level):
        return ""
    return f" Borderline: the interval {'excludes' if excludes_zero else 'includes'} zero."


def smallest(row):
    """Say which p is the smallest possible where a comparison has too few seeds for an interval."""
    has_interval = pd.notna(row.difference_low) or pd.isna(row.difference)  # of one environment
    if has_interval or not significant(row.smallest_p):
        return ""
    return f" (smallest possible: {p_text(row.smallest_p)}; too few seeds for an interval)"


def undirected(row):
    """Say where the environments of a comparison differ and have no common direction, or ""."""
    if direction(row.t, row.effect_size, row.difference_percent):
        return ""
    return "; its direction depends on how the environments are averaged"


def cannot_show(row):
    """Say where the runs of a comparison cannot show any difference, or ""."""
    if significant(row.smallest_p):
        return ""
    n, m, most = int(row.n), int(row.n_baseline), int(row.n_baseline_most)
    runs = counted(n, "run")
    if m < most:
        runs += f" against {m} to {most}"
    elif n != m:
        runs += f" against {m}"
    return f"; {runs} cannot show any (smallest possible p: {p_text(row.smallest_p)})"


# ---------------------------------------------------------------------------------------- sentences


def sentence(row, unit="", smallest_gain=None):
    """Say in one sentence what a comparison shows; unit: of the difference."""
    where = row["environment"] or f"{row['environments']:.0f} environments together"
    rate = row["noise_rate"]
    at = f"at rate {rate}" if "," not in rate else f"at {rate.count(',') + 1} rates together"
    start = f"{study_name(*row[STUDY])} on {where} with {row['noise']} {at}"
    if row["verdict"] == ALL_EQUAL:
        return f"{start} cannot be judged: all tests of all runs have the same result."
    if row["verdict"] == TOO_FEW:
        return f"{start} has too few seeds for a test: {difference_in_words(row, unit)}."
    evidence = f"{difference_in_words(row, unit)}, p {p_value(row['p'])}{smallest(row)}"
    several = corrected(row["p_adjusted"], row["comparisons"], "comparison")
    if row["verdict"] in CLEAR:
        evidence += several or ", the only comparison there"
        return f"{start} is {row['verdict']} than no noise: {evidence}.{borderline(row)}"
    shows = UNCLEAR
    if row["verdict"] == NO_SUCH_GAIN:
        shows = f"no gain of {smallest_gain:g}{unit or ' %'}"
    evidence += several if significant(row["p"]) else ""
    evidence += undirected(row) if significant(row["p_adjusted"]) else ""
    evidence += excluded(row, unit) + cannot_show(row)
    return f"{start} shows {shows}: {evidence}.{borderline(row)}"


def in_sentences(compared, unit="", smallest_gain=None):
    """Return a frame with a verdict and a sentence for all comparisons that have one.

    Clear differences come before others. unit: behind each difference, such as POINTS.
    """
    compared = compared[compared["verdict"].notna()]
    sentences = [sentence(row, unit, smallest_gain) for _, row in compared.iterrows()]
    rank = compared["verdict"].map(VERDICTS.index)
    compared = compared.assign(sentence=sentences, rank=rank)
    compared = compared.sort_values([*STUDY, "environment", "rank", "p"], kind="stable")
    return compared[[*STUDY, "environment", "verdict", "sentence"]].reset_index(drop=True)


def clear_first(judged, number=10):
    """Split a frame of sentences: the first clear ones, at most `number`, and all others.

    What is better comes before what is worse.
    """
    clear = judged[judged["verdict"].isin(CLEAR)].sort_values("verdict", kind="stable")
    return clear[:number], judged.drop(clear.index[:number])


def what_all_runs_do(value, metric):
    """Say what runs do whose tests all have the same result; what was learned, it cannot tell."""
    if metric != SUCCESS:
        return f"all tests of all runs return {rounded(value)}"
    always = {0: "no run ever solves the task", 100: "all runs solve the task in every test"}
    return always.get(value, f"all tests of all runs have a success rate of {value:.0f} %")


def tally(verdicts):
    """Count verdicts in words: "3 comparisons: 1 better, 2 no clear difference"."""
    counts = verdicts.value_counts()
    parts = [f"{counts[name]:,} {name}" for name in VERDICTS if name in counts]
    return f"{counted(len(verdicts), 'comparison')}: {', '.join(parts)}"


def luck_sentence(best):
    """Say whether the best noises of a study look better than luck alone would make them, or "".

    best: its rows of the table of best noises, one for each environment.
    """
    judged = best[best["p_luck"].notna()]
    if judged.empty:
        return ""
    if not (best["difference"] > 0).any():
        return "Nothing that was tried has a higher mean than no noise."
    judged = judged.assign(p_luck=holm(judged["p_luck"].to_numpy(float)))  # over environments
    rivals = "the best of as many useless noises would"
    beyond = judged[judged["p_luck"] <= LEVEL]
    if beyond.empty:
        where = listed(list(judged["environment"]))
        return f"On {where} the best noise looks no better than {rivals}."
    where = [f"{row.environment} (p {p_value(row.p_luck)})" for row in beyond.itertuples()]
    return f"On {listed(where)} the best noise looks better than {rivals}."


def headlines(by_noise, best):
    """Return for each study its name, its comparisons in words, its counts of verdicts, its luck.

    by_noise: the comparisons of noises, in one environment and in several; best: the table's frame.
    """
    lines = []
    judged = by_noise[by_noise["verdict"].notna()]
    for key, rows in judged.groupby(STUDY, sort=False):
        alone, together = rows[rows["environment"] != ""], (rows["environment"] == "").sum()
        noises = counted(rows["noise"].nunique(), "noise")
        tried = f"{noises} in {counted(alone['environment'].nunique(), 'environment')}"
        if together:
            tried += f", {together} in several environments together"
        if len(rows) > 1:
            tried = f"{counted(len(rows), 'comparison')} ({tried})"
        found = rows["verdict"].value_counts()
        said = [word for word in VERDICTS if word in CLEAR or word in found]
        counts = [(word, found.get(word, 0)) for word in said]
        luck = luck_sentence(best[rows_of(best, key)])
        lines.append({"name": study_name(*key), "tried": tried, "counts": counts, "luck": luck})
    return lines
