"""One plain sentence for each environment and noise: is it better than no noise?

A noise is called better or worse only where the p of the exact two-sided Mann-Whitney test (over
several environments, of the test of the mean win rate), corrected with Benjamini and Hochberg's
method over all configurations of one algorithm in one environment, is at most 0.05; where only the
uncorrected p is, it is "perhaps" so.
"""

from math import nan

import numpy as np
import pandas as pd

from analysis.runs import STUDY, rows_of, study_name
from analysis.statistics import LEVEL, improvement_percent
from noisy_wrappers import BASELINE

UNCLEAR = "no clear difference"
CLEAR = ["better", "worse"]
VERDICTS = [*CLEAR, "perhaps better", "perhaps worse", UNCLEAR]  # in this order
MAX_SEEDS = 1000  # a difference that would take more seeds is said to take more than these


def verdict(row):
    """Name the verdict of a row of statistics with its p, p_adjusted and win rate; or NaN."""
    if pd.isna(row["p"]):
        return nan
    if round(row["p"], 12) > LEVEL:
        return UNCLEAR
    direction = "better" if row["probability_of_improvement"] > 0.5 else "worse"
    return direction if round(row["p_adjusted"], 12) <= LEVEL else f"perhaps {direction}"


# ---------------------------------------------------------------------------------------- sentences


def percent(value, sign="+"):
    """Spell a percentage: whole from 10 on, with a decimal below."""
    return f"{value:{sign}.{0 if abs(value) >= 10 else 1}f} %"


def interval(low, high):
    """Spell an interval in percent: whole numbers, or with a decimal where it is narrow."""
    if high - low >= 10:
        return f"[{round(low)}, {round(high)}]"
    return f"[{low:.1f}, {high:.1f}]"


def counted(number, word):
    """Spell how many there are: "1 seed", "5 seeds"."""
    return f"{number:.0f} {word}" + ("" if number == 1 else "s")


def seeds_of(n, n_baseline):
    """Spell the seeds with and without noise: "5", or "5/10" where they differ."""
    return f"{n:.0f}" if n == n_baseline else f"{n:.0f}/{n_baseline:.0f}"


def p_value(p):
    """Spell a p-value for a sentence: "= 0.04", or "< 0.001"."""
    return f"= {p:.2g}" if p >= 0.001 else "< 0.001"


def far_away(values):
    """Count the values (n) that lie far above and far below the others (Tukey's outer fences)."""
    low, high = np.quantile(values, [0.25, 0.75])
    reach = 3 * (high - low)
    return (values > high + reach).sum(), (values < low - reach).sum()


def disagreement(mean_percent, iqm_percent, x, y):
    """Say where the improvement of the mean differs from that of the interquartile mean, or "".

    They differ by at least 10 points and by half of the larger one. x (n) with noise, y (m)
    without.
    """
    apart = abs(mean_percent - iqm_percent)
    if not apart >= max(10, abs(mean_percent) / 2, abs(iqm_percent) / 2):
        return ""
    reasons = []
    for values, name in ((x, "with noise"), (y, "without noise")):
        for count, where in zip(far_away(values), ("above", "below"), strict=True):
            if count:
                lie = "lies" if count == 1 else "lie"
                reasons.append(f"{count} of {len(values)} runs {name} {lie} far {where} the others")
    because = f": {' and '.join(reasons)}" if reasons else ""
    return f" The mean says {percent(mean_percent)}{because}."


def evidence(row):
    """Spell the improvement with its interval and the p-values of a row of statistics."""
    text = ""
    if pd.notna(row["improvement_iqm_percent"]):
        text = percent(row["improvement_iqm_percent"])
        if pd.notna(row["improvement_low"]):
            text += f" {interval(row['improvement_low'], row['improvement_high'])}"
        text += ", "
    text += f"p {p_value(row['p'])}"
    if row["comparisons"] > 1 and row["verdict"] != UNCLEAR:
        corrected = p_value(row["p_adjusted"]).removeprefix("= ")
        text += f", corrected for {row['comparisons']:.0f} comparisons {corrected}"
    elif row["comparisons"] == 1 and row["verdict"] != UNCLEAR:
        text += ", the only comparison"
    return text


def disagrees(direction, low, high):
    """Say that the test decides where the interval says something else, or "".

    direction: what the test says, "better", "worse" or UNCLEAR; low, high: the interval of the
    improvement, NaN where there is none.
    """
    if not low <= high:
        return ""
    says = "better" if low > 0 else "worse" if high < 0 else UNCLEAR
    return "" if says == direction else " Test and interval disagree: the test decides."


def reach(row):
    """Say what the seeds of a row without a clear difference could have shown, or ""."""
    n, m, most = int(row["n"]), int(row["n_baseline"]), int(row["n_baseline_most"])
    seeds = counted(n, "seed")
    if m < most:
        seeds += f" against {m} to {most}"
    elif n != m:
        seeds += f" against {m}"
    parts = []
    if row["smallest_p"] > LEVEL:
        parts.append(f"{seeds} cannot show any (smallest possible p: {row['smallest_p']:.2g})")
    elif pd.notna(row["detectable_percent"]):
        difference = percent(row["detectable_percent"], sign="")
        power = "80 % power"
        if row["comparisons"] > 1:
            power += f" before the correction for {row['comparisons']:.0f} comparisons"
        if row["smallest_p_adjusted"] > LEVEL:
            power += ", which no noise can pass alone"
        parts.append(f"{seeds} could have shown {difference} ({power})")
    needed = row["seeds_needed"]
    if needed > max(n, m):
        needed = f"about {needed:.0f}" if needed <= MAX_SEEDS else f"more than {MAX_SEEDS:,}"
        difference = percent(abs(row["improvement_iqm_percent"]), sign="")
        parts.append(f"{difference} would take {needed} seeds each")
    return "; " + ", and ".join(parts) if parts else ""


def sentence(row):
    """Say in one sentence what a row of statistics shows."""
    where = row["environment"]
    if row["scope"] == "all":
        where = f"all {row['environments']:.0f} environments together"
    study = study_name(*row[STUDY])
    start = f"{study} on {where} with {row['noise']} at rate {row['noise_rate']}"
    direction = row["verdict"].removeprefix("perhaps ")
    text = f"is {row['verdict']} than no noise: {evidence(row)}."
    if direction == UNCLEAR:
        text = f"shows {UNCLEAR}: {evidence(row)}{reach(row)}."
    return f"{start} {text}{disagrees(direction, row['improvement_low'], row['improvement_high'])}"


def tally(verdicts):
    """Count verdicts in words: "3 comparisons: 1 perhaps better, 2 no clear difference"."""
    counts = verdicts.value_counts()
    parts = [f"{counts[name]} {name}" for name in VERDICTS if name in counts]
    return f"{counted(len(verdicts), 'comparison')}: {', '.join(parts)}"


def luck_sentence(best):
    """Say whether the best noises of a study look better than luck alone would make them, or "".

    best: its rows of the table of best noises, one for each environment.
    """
    best = best[best["p_luck"].notna()]
    if best.empty:
        return ""
    if not (best["improvement_percent"] > 0).any():
        return "Nothing that was tried has a higher mean return than no noise."
    tried = set(best["chosen_from"])
    rivals = f"the best of {max(tried):.0f} useless noises would"
    if tried == {1}:
        rivals = "one useless noise might"
    elif len(tried) > 1:
        rivals = "the best of as many useless noises would"
    beyond = best[best["p_luck"] <= LEVEL]
    if beyond.empty:
        where = " in each environment" if len(best) > 1 else ""
        return f"The best noise{where} looks no better than {rivals}."
    where = [f"{row.environment} (p {p_value(row.p_luck)})" for row in beyond.itertuples()]
    elsewhere = "; elsewhere it does not" if len(beyond) < len(best) else ""
    return f"On {together(where)} the best noise looks better than {rivals}{elsewhere}."


def together(names):
    """Join names for a sentence: "A, B and C"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def headlines(statistics, best):
    """Return for each study its name, its comparisons in words, its counts of verdicts, its luck.

    Counted are the verdicts of single environments. statistics, best: the frames of these tables.
    """
    lines = []
    alone = statistics[statistics["p"].notna() & (statistics["scope"] == "environment")]
    for key, rows in alone.groupby(STUDY, sort=False):
        noises = counted(len(rows.drop_duplicates(["noise", "noise_rate"])), "noise")
        tried = f"{noises} in {counted(rows['environment'].nunique(), 'environment')}"
        if len(rows) > 1:
            tried = f"{counted(len(rows), 'comparison')} ({tried})"
        counts = [(word, (rows["verdict"] == word).sum()) for word in VERDICTS]
        counts = [(word, n) for word, n in counts if n or word in CLEAR]
        luck = luck_sentence(best[rows_of(best, key)])
        lines.append({"name": study_name(*key), "tried": tried, "counts": counts, "luck": luck})
    return lines


def clear_first(verdicts, number=10):
    """Split a frame of sentences: the first clear ones, at most `number`, and all others.

    What is better comes before what is worse.
    """
    clear = verdicts[verdicts["verdict"].isin(CLEAR)].sort_values("verdict", kind="stable")
    return clear[:number], verdicts.drop(clear.index[:number])


def sentences(studies, statistics):
    """Return a frame with a verdict and a sentence for all that was tested.

    All environments together come before each alone, and clear differences before others.
    """
    columns = [*STUDY, "scope", "environment", "verdict", "sentence"]
    tested = statistics[statistics["p"].notna()]
    tested = tested.assign(
        apart=tested["scope"] != "all",
        rank=[VERDICTS.index(verdict) for verdict in tested["verdict"]],
    )
    rows = []
    for study in studies:
        mine = tested[rows_of(tested, study.key)]
        for _, row in mine.sort_values(["apart", "environment", "rank", "p"]).iterrows():
            text = sentence(row) + remark(study, row)
            rows.append((*row[columns[:-1]], text))
    return pd.DataFrame(rows, columns=columns)


def remark(study, row):
    """Return what the returns behind a row of one environment say besides, or ""."""
    if row["scope"] == "all":
        return ""
    e = study.environments.index(row["environment"])
    configs = {(config.noise, config.noise_rate): config for config in study.returns}
    x = study.final(configs[row["noise"], row["noise_rate"]])[:, e]
    y = study.final(BASELINE)[:, e]
    x, y = x[np.isfinite(x)], y[np.isfinite(y)]
    mean_percent = improvement_percent(x.mean(), y.mean())
    return disagreement(mean_percent, row["improvement_iqm_percent"], x, y)
