"""One plain sentence for each environment and noise: is it better than no noise?"""

from math import nan

import pandas as pd

from analysis.runs import STUDY, SUCCESS, rows_of, study_name
from analysis.statistics import LEVEL, SEEDS_FOR_INTERVAL, holm
from noisy_wrappers import rounded

UNCLEAR = "no clear difference"
TOO_FEW = "too few seeds"
ALL_EQUAL = "all equal"  # all tests of all runs
CLEAR = ["better", "worse"]
VERDICTS = [*CLEAR, "perhaps better", "perhaps worse", UNCLEAR, TOO_FEW, ALL_EQUAL]  # in this order
POINTS = " percentage points of success"
MAX_SEEDS = 1000  # a difference that would take more seeds is said to take more than these


def verdict(row):
    """Name the verdict of a row of statistics: one of VERDICTS, or NaN without a baseline."""
    if pd.isna(row["smallest_p"]):
        return nan
    if row.get("verdict") == ALL_EQUAL:
        return ALL_EQUAL
    if pd.isna(row["p"]):
        return TOO_FEW
    if not significant(row["p"]):
        return UNCLEAR
    direction = "better" if row["t"] > 0 else "worse"
    return direction if significant(row["p_adjusted"]) else f"perhaps {direction}"


def significant(p):
    """Tell whether a p-value is at most LEVEL, in spite of rounding errors."""
    return round(p, 12) <= LEVEL


# ---------------------------------------------------------------------------- numbers in a sentence


def percent(value, sign="+"):
    """Write a percentage: whole from 10 on, with a decimal below, without a sign if that is 0.0."""
    if abs(value) < 0.05:
        return "0.0 %"
    return f"{value:{sign},.{0 if abs(value) >= 10 else 1}f} %"


def counted(number, word):
    """Write how many there are: "1 seed", "5 seeds"."""
    return f"{number:.0f} {word}" + ("" if number == 1 else "s")


def seeds_of(n, n_baseline):
    """Write the seeds with and without noise: "5", or "5/10" where they differ."""
    return f"{n:.0f}" if n == n_baseline else f"{n:.0f}/{n_baseline:.0f}"


def two_digits(p):
    """Write a p-value with two significant digits, with more if it would look like LEVEL."""
    text = f"{p:.2g}"
    return f"{p:.4g}" if float(text) <= LEVEL < p else text


def p_value(p):
    """Write a p-value for a sentence: "= 0.04", or "< 0.001"."""
    return f"= {two_digits(p)}" if p >= 0.001 else "< 0.001"


def spread_of(row):
    """Return what a comparison's difference may be off by: half its interval, or its spread."""
    half = (row.difference_high - row.difference_low) / 2
    return row.pooled_std if pd.isna(half) else half


def is_zero(text):
    """Tell whether a number looks like zero as it is written."""
    return not float(text.replace(",", ""))


def not_zero(value, spread):
    """Write a number as `rounded` does, with more digits if it would look like zero and is not."""
    text = rounded(value, spread)
    is_rounding_error = not abs(value) > 1e-9 * spread
    return rounded(value, abs(value)) if is_zero(text) and not is_rounding_error else text


def difference(row, unit=""):
    """Write what a comparison found: "+11.8 [8.4, 15.3] (+21 %)", of several environments in sd.

    unit: of the difference, such as POINTS.
    """
    if pd.isna(row.difference):
        text = f"{row.effect_size:+z.2f} standard deviations in the median environment"
        if pd.isna(row.effect_size):
            text = "effects that have no median"
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
        text += f" ({percent(row.difference_percent)}{average})"
    return text


def corrected(p, number, what):
    """Write a p-value that is corrected for a number of comparisons, if there are several."""
    if number == 1:
        return ""
    return f", corrected for {number:.0f} {what}s {p_value(p).removeprefix('= ')}"


def borderline(row):
    """Say where the interval of a comparison and its p differ, or ""."""
    if pd.isna(row.difference_low):
        return ""
    excludes_zero = row.difference_low > 0 or row.difference_high < 0
    if excludes_zero == significant(row.p):
        return ""
    return f" Borderline: the interval {'excludes' if excludes_zero else 'includes'} zero."


def smallest(row):
    """Say which p is the smallest possible where a comparison has too few seeds for an interval."""
    few = min(row.n, row.n_baseline) < SEEDS_FOR_INTERVAL and significant(row.smallest_p)
    return f" (smallest possible: {row.smallest_p:.2g})" if few else ""


# ---------------------------------------------------------------------------------------- sentences


def sentence(row, unit=""):
    """Say in one sentence what a row of statistics shows; unit: of the difference."""
    where = row["environment"]
    if row["scope"] == "all":
        where = f"{row['environments']:.0f} environments together"
    study = study_name(*row[STUDY])
    start = f"{study} on {where} with {row['noise']} at rate {row['noise_rate']}"
    if row["verdict"] == ALL_EQUAL:
        return f"{start} cannot be judged: all tests of all runs have the same result."
    if row["verdict"] == TOO_FEW:
        return f"{start} has too few seeds for a test: {difference(row, unit)}."
    evidence = f"{difference(row, unit)}, p {p_value(row['p'])}{smallest(row)}"
    if row["verdict"] == UNCLEAR:
        return f"{start} shows {UNCLEAR}: {evidence}{power(row)}.{borderline(row)}"
    several = corrected(row["p_adjusted"], row["comparisons"], "comparison")
    evidence += several or ", the only comparison there"
    return f"{start} is {row['verdict']} than no noise: {evidence}.{borderline(row)}"


def what_all_runs_do(value, metric):
    """Say what runs do whose tests all have the same result; what was learned, it cannot tell."""
    if metric != SUCCESS:
        return f"all tests of all runs return {rounded(value)}"
    always = {0: "no run ever solves the task", 100: "all runs solve the task in every test"}
    return always.get(value, f"all tests of all runs have a success rate of {value:.0f} %")


def power(row):
    """Say what the seeds of a row without a clear difference could have shown, or ""."""
    n, m, most = int(row["n"]), int(row["n_baseline"]), int(row["n_baseline_most"])
    seeds = counted(n, "seed")
    if m < most:
        seeds += f" against {m} to {most}"
    elif n != m:
        seeds += f" against {m}"
    parts = []
    if not significant(row["smallest_p"]):
        parts.append(
            f"{seeds} cannot show any (smallest possible p: {two_digits(row['smallest_p'])})"
        )
    elif row["detectable"] > 0:
        before, number = "80 % power", row["comparisons"]
        if number > 1:
            before += f" before the correction for {number:.0f} comparisons"
            if not significant(row["smallest_p_adjusted"]):
                before += ", which no noise can pass alone"
        found = rounded(row["detectable"], spread_of(row))
        parts.append(f"{seeds} could have shown {found} ({before})")
    needed = row["seeds_needed"]
    if needed > max(n, m) and row["difference"]:
        needed = f"about {needed:.0f}" if needed <= MAX_SEEDS else f"more than {MAX_SEEDS:,}"
        observed = not_zero(abs(row["difference"]), spread_of(row))
        parts.append(f"{observed} would take {needed} seeds each")
    return "; " + ", and ".join(parts) if parts else ""


def tally(verdicts):
    """Count verdicts in words: "3 comparisons: 1 perhaps better, 2 no clear difference"."""
    counts = verdicts.value_counts()
    parts = [f"{counts[name]} {name}" for name in VERDICTS if name in counts]
    return f"{counted(len(verdicts), 'comparison')}: {', '.join(parts)}"


def luck_sentence(best):
    """Say whether the best noises of a study look better than luck alone would make them, or "".

    best: its rows of the table of best noises, one for each environment.
    """
    judged = best[best["p_luck"].notna()]  # the others have too few seeds
    if judged.empty:
        return ""
    if not (best["difference"] > 0).any():
        return "Nothing that was tried has a higher mean than no noise."
    tried = set(judged["chosen_from"])
    number = "as many" if len(tried) > 1 else f"{max(tried):.0f}"
    rivals = f"the best of {number} useless noises would"
    if tried == {1}:
        rivals = "one useless noise might"
    judged = judged.assign(p_luck=holm(judged["p_luck"].to_numpy(float)))  # over environments
    beyond = judged[judged["p_luck"] <= LEVEL]
    if beyond.empty:
        where = " in each environment" if len(judged) > 1 else ""
        if len(judged) < len(best):
            where = f" on {listed(list(judged['environment']))}"
        return f"The best noise{where} looks no better than {rivals}."
    where = [f"{row.environment} (p {p_value(row.p_luck)})" for row in beyond.itertuples()]
    elsewhere = "; elsewhere it does not" if len(beyond) < len(judged) else ""
    return f"On {listed(where)} the best noise looks better than {rivals}{elsewhere}."


def listed(names):
    """Join names for a sentence: "A, B and C"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def headlines(statistics, best):
    """Return for each study its name, its comparisons in words, its counts of verdicts, its luck.

    statistics, best: the frames of these tables.
    """
    lines = []
    judged = statistics[statistics["verdict"].notna()]
    for key, rows in judged.groupby(STUDY, sort=False):
        alone, together = rows[rows["scope"] != "all"], (rows["scope"] == "all").sum()
        noises = counted(len(rows.drop_duplicates(["noise", "noise_rate"])), "noise")
        tried = f"{noises} in {counted(alone['environment'].nunique(), 'environment')}"
        if together:
            tried += f", {together} in several environments together"
        if len(rows) > 1:
            tried = f"{counted(len(rows), 'comparison')} ({tried})"
        found = rows["verdict"].value_counts()
        said = [word for word in VERDICTS if word in CLEAR or word in found]
        counts = [(word, found.get(word, 0)) for word in said]
        luck = (
            "" if set(rows["verdict"]) == {ALL_EQUAL} else luck_sentence(best[rows_of(best, key)])
        )
        lines.append({"name": study_name(*key), "tried": tried, "counts": counts, "luck": luck})
    return lines


def clear_first(judged, number=10):
    """Split a frame of sentences: the first clear ones, at most `number`, and all others.

    What is better comes before what is worse.
    """
    clear = judged[judged["verdict"].isin(CLEAR)].sort_values("verdict", kind="stable")
    return clear[:number], judged.drop(clear.index[:number])


def in_sentences(statistics, unit=""):
    """Return a frame with a verdict and a sentence for all that was compared.

    unit: behind each difference, such as POINTS.
    All environments together come before each alone, and clear differences before others.
    """
    compared = statistics[statistics["verdict"].notna()]
    sentences = [sentence(row, unit) for _, row in compared.iterrows()]
    rank = compared["verdict"].map(VERDICTS.index)
    compared = compared.assign(sentence=sentences, apart=compared["scope"] != "all", rank=rank)
    compared = compared.sort_values([*STUDY, "apart", "environment", "rank", "p"], kind="stable")
    columns = [*STUDY, "scope", "environment", "verdict", "sentence"]
    return compared[columns].reset_index(drop=True)
