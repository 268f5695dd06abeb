"""The tables of analyze.py: their columns, their captions, and in which order they come."""

from math import ceil

import numpy as np
import pandas as pd
from scipy import stats

from analysis.formatting import P_VALUE, PLAIN, SHARE, WHOLE, Table
from analysis.luck import (
    CONSISTENT_PERCENT,
    DRAWS,
    FALSE_ALARMS,
    FALSE_ALARMS_IN_THE_PAPER,
    LUCKY,
    POWER_IN_THE_PAPER,
    POWER_OF_BEST,
    SEEDS_TO_RESAMPLE,
    add_luck_of_best,
    add_luck_of_consistent,
    luck_of_study,
    luck_rows,
)
from analysis.paper import PAPER_CONFIGURATIONS, compare_tables
from analysis.rows import (
    best_rows,
    consistency_rows,
    early_rows,
    interaction_rows,
    statistics_rows,
    summary_rows,
)
from analysis.runs import KEYS, STUDY, study_name
from analysis.statistics import (
    COVERAGE,
    COVERAGE_OF_MIXTURES,
    MIN_SEEDS,
    MOST_VALUES,
    PERMUTATIONS,
    holm,
)
from analysis.verdicts import counted, seeds_of, verdict

# After those that name a study
_COLUMNS = {
    "summary": """environment noise noise_rate n mean std n_baseline baseline_mean
        baseline_std improvement_percent p std_change_percent steps_to_baseline""",
    "best": """environment noise noise_rate baseline_mean baseline_std noisy_mean
        noisy_std improvement_percent p p_adjusted luck_median_percent luck_95_percent p_luck
        leave_one_seed_out_percent n n_baseline chosen_from leave_one_seed_out_mean""",
    "consistency": """noise noise_rate percent_of_environments
        average_improvement_percent std_improvement_percent p p_adjusted p_luck environments n
        fails_at_every_rate""",
    "luck": """environments best_beyond_luck configurations
        consistent consistent_by_luck consistent_by_luck_95 p_consistent consistent_beyond_luck
        consistently_worse consistently_worse_by_luck consistently_worse_by_luck_95
        p_consistently_worse consistently_worse_beyond_luck""",
    "interactions": """environment noise noise_rate n both_mean first_mean second_mean
        baseline_mean interaction interaction_low interaction_high standard_error
        interaction_percent percent_low percent_high""",
    "early_performance": "environment noise steps_millions noise_rate mean std n",
    "statistics": """scope environment noise noise_rate verdict improvement_iqm_percent
        improvement_low improvement_high p p_adjusted comparisons probability_of_improvement
        probability_low probability_high environments n n_baseline n_baseline_most
        iqm iqm_low iqm_high detectable_percent seeds_needed smallest_p smallest_p_adjusted""",
}
COLUMNS = {name: [*STUDY, *text.split()] for name, text in _COLUMNS.items()}
_COLUMNS_WITH = {
    WHOLE: """n n_baseline n_baseline_most environments chosen_from configurations seeds
        seeds_needed steps_to_baseline percent_of_environments best_beyond_luck consistent
        consistent_beyond_luck consistently_worse consistently_worse_beyond_luck""",
    P_VALUE: """p p_adjusted smallest_p smallest_p_adjusted p_luck p_luck_of_best paper_p_luck
        p_consistent p_consistently_worse""",
    SHARE: "probability_of_improvement probability_low probability_high",
    PLAIN: "steps_millions",
}
FORMATS = {name: form for form, names in _COLUMNS_WITH.items() for name in names.split()}
LUCK_ONLY_CSV = ("consistent_by_luck_95", "consistently_worse_by_luck_95")


def frame(name, rows):
    """Make a table of a list of dicts, with the columns of its kind even when it is empty."""
    return pd.DataFrame(list(rows), columns=COLUMNS[name])


def split_consistency(consistency):
    """Return the rows with at least 80 % of the environments, best first, and those with 0 %.

    One environment says nothing about consistency.
    """
    consistency = consistency[consistency["environments"] > 1]
    share = consistency["percent_of_environments"]
    by = [*STUDY, "percent_of_environments", "average_improvement_percent"]
    good = consistency[share >= CONSISTENT_PERCENT].drop(columns="fails_at_every_rate")
    good = good.sort_values(by, ascending=[True, True, True, False, False], kind="stable")
    highest = share.groupby([consistency[name] for name in (*STUDY, "noise")]).transform("max")
    bad = consistency.assign(fails_at_every_rate=np.where(highest == 0, "yes", "no"))[share == 0]
    return good, bad


def adjust(statistics):
    """Add p corrected for all comparisons of a family, the smallest in reach, and verdicts.

    A family is a study in one environment, or in all, corrected with Benjamini and Hochberg's
    method. The confirmations of `./benchmark.sh choose` were fixed beforehand: they are one family,
    corrected with Holm's method.
    """
    tested = statistics[statistics["p"].notna()]
    confirmed = tested["phase"] == "confirmation"
    families = [(tested[confirmed], holm)] if confirmed.any() else []
    for _, family in tested[~confirmed].groupby([*STUDY, "scope", "environment"], dropna=False):
        families.append((family, stats.false_discovery_control))
    for family, correct in families:
        number = len(family)
        statistics.loc[family.index, "p_adjusted"] = correct(family["p"].to_numpy(float))
        alone = np.minimum(1, family["smallest_p"].astype(float) * number)
        statistics.loc[family.index, "smallest_p_adjusted"] = alone
        statistics.loc[family.index, "comparisons"] = number
    statistics["verdict"] = [verdict(row) for _, row in statistics.iterrows()]
    return statistics


def with_p(table, statistics):
    """Fill in the test of every row of a table that compares a noise with the baseline.

    A table without environments has averages over all of them: it gets the test over all.
    """
    keys = [name for name in KEYS if name in table]
    scope = "environment" if "environment" in table else "all"
    tests = statistics[statistics["scope"] == scope].set_index(keys)[["p", "p_adjusted"]]
    found = tests.reindex(pd.MultiIndex.from_frame(table[keys])).set_index(table.index)
    for name in ("p", "p_adjusted"):
        if name in table:
            table[name] = found[name]
    return table


def family_notes(statistics):
    """Say where the number of seeds is too small to show a difference, if corrected."""
    notes = []
    tested = statistics[statistics["p"].notna()]
    keys = ["comparisons", "smallest_p"]
    for study, rows in tested.groupby(STUDY):
        best = rows.sort_values("smallest_p", kind="stable")
        best = best.drop_duplicates(["scope", "environment"]).sort_index()
        for (size, smallest), same in best.groupby(keys, sort=False):
            places = same["environment"].mask(same["scope"] == "all", "all")
            where = f"{study_name(*study)}, {', '.join(places)}"
            seeds = counted(min(same["n"].min(), same["n_baseline"].min()), "seed")
            needed = ceil(round(size * smallest / 0.05, 9))
            if smallest > 0.05:
                notes.append(
                    f"{where}: with {seeds} no difference can be significant (smallest possible p: "
                    f"{smallest:.2g})."
                )
            elif needed > 1:
                notes.append(
                    f"{where}: with {seeds} and {size:.0f} comparisons, differences can be "
                    f"significant after the correction only if at least {needed} of them are "
                    f"(smallest possible p: {smallest:.2g}, corrected for one alone "
                    f"{min(1, size * smallest):.2g})."
                )
    return notes


def listed(numbers):
    """Spell numbers for a sentence: "7, 13, 26"."""
    return ", ".join(map(str, numbers))


# Captions have at most two lines in the report; HOW is its last section.
CAPTIONS = {
    "best": """The best noise in each environment, which may still be worse than no noise. Mean
\u00b1 standard deviation of the final return over n seeds (with / without noise).""",
    "consistent": f"""Noise that matches or beats no noise in at least {CONSISTENT_PERCENT} % of two
or more environments. Average improvement \u00b1 standard deviation over environments.""",
    "consistently_worse": "Noise that is worse than no noise in each of two or more environments.",
    "luck": f"""How many rows the tables above would have if no noise did anything, from
{DRAWS:,} simulated sweeps.""",
    "early_performance": """Mean test return \u00b1 standard deviation during training, by noise
rate (0.00: no noise), with the number of seeds in brackets.""",
    "summary": """Final test return of every configuration: mean \u00b1 standard deviation over n
seeds, and the improvement over no noise. Here p is not corrected.""",
    "statistics": """Every noise against no noise: the improvement of the interquartile mean (IQM)
with its 95 % interval, and the test behind the verdict.""",
    "interactions": """What two noises do together beyond the sum of their effects, with 95 %
intervals. Above zero, both together are better than the sum.""",
    "choice": """How the noise was chosen: each round of the search drops the worse half, and fresh
seeds confirm the winner or not.""",
    "missing": "Runs that are in no table and no figure, with their seeds.",
    "compare_luck": """The same for the paper's tables.""",
    "compare": "The paper's table (environments v2, 1,000,000 steps) beside ours.",
}
HOW = {
    "best": f"""The best noise is the one with the highest mean final return. It is chosen on the
seeds that it is reported on, which flatters it. Improvement and p corrected are those of the
statistics. Luck 95 %: if no noise did anything, the best mean of as many noises would still look
this much better than no noise in one of twenty sweeps; in brackets, the probability that luck alone
gives a mean at least as high as the best one has. best.csv has more columns. Its leave-one-seed-out
value measures the procedure of choosing, not the noise that is named: choose on all seeds but one,
measure on that one, average over seeds. It is descriptive: its terms share seeds, so it has no
interval. A best noise counts as beyond luck where that probability is at most {LUCKY}.""",
    "consistent": """p is the exact test over all environments, then corrected for all
configurations (Benjamini-Hochberg). p luck: the probability that the highest average of as many
configurations is as high if none does anything. n is the smallest number of seeds in any
environment.""",
    "consistently_worse": """Columns as in the table of consistent noise, p luck with the lowest
average. Worse at every rate that was tried:""",
    "luck": f"""{DRAWS:,} sweeps are drawn in which no noise does anything: the baseline and all
configurations anew, with their numbers of seeds, from a normal distribution with the pooled
standard deviation within configurations (from {SEEDS_TO_RESAMPLE} seeds of the baseline on, with
the shape of their returns). By luck: the mean number of rows in the tables of consistent and
consistently worse noise, and its 95 % quantile. p: the probability of at least as many rows as
observed. Beyond luck: rows with a p luck of {LUCKY} or less. Configurations are those in two or
more environments. The p luck of a best noise is right for normal returns of equal spread: that of
90 useless configurations is then {LUCKY} or less in 5 % of simulated studies. Where a fifth of the
runs end around a second, higher peak, it is in {FALSE_ALARMS[5]} % with five seeds and
{FALSE_ALARMS[10]} % with ten. One configuration of 90 with a true gain of 1, 1.5 and 2 standard
deviations is beyond luck in {listed(POWER_OF_BEST[5])} % of studies with five seeds, and in
{listed(POWER_OF_BEST[10])} % with ten.""",
    "summary": """Improvement: of the mean, in percent of |mean without noise|, with the p of the
exact Mann-Whitney test. Steps to baseline: the first evaluation at which the mean over seeds
reaches the final mean without noise.""",
    "statistics": f"""IQM: interquartile mean of the final returns over n seeds. Improvement: IQM of
(return - baseline mean) / |baseline mean| over seeds and environments, minus that of the baseline's
own returns; the baseline are the runs without noise. [ ]: 95 % intervals from a stratified
bootstrap over seeds (Student's t times the bootstrap standard error, with Satterthwaite's degrees
of freedom: few seeds of the baseline widen it as much as few with noise). In simulated samples of
one environment they held the true IQM in at least
{", ".join(f"{c} % (n = {n})" for n, c in COVERAGE.items())} of the cases where returns were normal,
skewed or 20 % of them in a low peak, but in
{", ".join(f"{c} % (n = {n})" for n, c in COVERAGE_OF_MIXTURES.items())} where 40 % were in a low
and narrow peak. P(improvement): probability that a noisy run beats a baseline run, averaged over
environments, with Newcombe's interval. No interval for n < {MIN_SEEDS}. p: exact two-sided
Mann-Whitney test; over several environments the test of P(improvement), in which every environment
counts alike ({PERMUTATIONS:,} random orders with a fixed seed where the exact distribution has more
than {MOST_VALUES:,} values). The test decides, also where an interval says otherwise: that of the
improvement is for the interquartile mean. In a full grid the rows of all environments together are
primary: in one environment alone no configuration with five seeds can reach 0.05 on its own after
the correction. p corrected: Benjamini-Hochberg over one family, all configurations of an algorithm
in one environment, or in all of them together. The verdict is better or worse where p corrected is
at most 0.05, and perhaps so where only p is. statistics.csv also has the smallest p that one
configuration alone could reach with its number of seeds. Detectable: the improvement that these
seeds find at the 5 % level, uncorrected, with 80 % power. Seeds needed: how many on each side the
observed improvement takes. Both are for normal returns with the standard deviation of these
seeds.""",
    "interactions": """Interaction = mean with both - mean with the first - mean with the second +
mean without noise, of the final test returns, where each of the four has at least 3 seeds (n is the
smallest number), with a 95 % interval (Welch, Satterthwaite), and in percent of |mean without
noise|. This is descriptive: nothing is corrected for the number of rows.""",
    "choice": """Score in the search: the mean over the seeds, and over each run's tests in the last
15 % of its steps. Score in the confirmation, on fresh seeds (1001 and up): the mean final test
return. Survives, in the confirmation: whether the winner was shown to be better than no noise.
Search and confirmation have rows of their own everywhere, and only the confirmation is judged: the
search's seeds chose the noise, which flatters it.""",
    "missing": """Missing are the seeds that at least half of an algorithm's configurations with
noise have, and baselines.""",
    "compare_luck": f"""{PAPER_CONFIGURATIONS} configurations in each environment. The paper prints
only means and standard deviations, so returns are taken as normal, with the standard deviation of
each baseline, known from 5 seeds (PPO 10). Where a fifth of the runs end around a second, higher
peak, the best of 90 useless configurations has a p luck of {LUCKY} or less in
{FALSE_ALARMS_IN_THE_PAPER[5]} % of studies with five seeds and {FALSE_ALARMS_IN_THE_PAPER[10]} %
with ten; one with a true gain of 1, 1.5 and 2 standard deviations in
{listed(POWER_IN_THE_PAPER[5])} % and {listed(POWER_IN_THE_PAPER[10])} %, if returns are normal.""",
    "compare": """The difference is in standard errors, where the steps are the same. Listed by:
whose table has the row. Paper, luck: see the table of luck. Our steps:""",
}
CAPTIONS, HOW = (
    {name: " ".join(text.split()) for name, text in texts.items()} for texts in (CAPTIONS, HOW)
)


def make_tables(studies, paper=None):
    """Compute every table: a dict of name -> Table, in the order of the report.

    `paper` has the paper's tables (read_paper), to be set beside ours.
    """
    summary = frame("summary", (row for study in studies for row in summary_rows(study)))
    # The seeds of a search chose the noise, so they cannot judge it.
    judging = [study for study in studies if study.phase != "search"]
    judged = summary[summary["phase"] != "search"]
    best = frame("best", (row for study in judging for row in best_rows(study, judged)))
    consistency = frame("consistency", consistency_rows(judged))
    early = frame("early_performance", (row for study in studies for row in early_rows(study)))
    statistics = frame("statistics", (row for study in judging for row in statistics_rows(study)))
    statistics = adjust(statistics)
    summary, judged, best, consistency = (
        with_p(table, statistics) for table in (summary, judged, best, consistency)
    )
    good, bad = split_consistency(consistency)
    lucks = {study.key: luck_of_study(study) for study in judging}
    best = add_luck_of_best(best, lucks)
    good, bad = add_luck_of_consistent(good, bad, lucks)
    luck = frame("luck", luck_rows(lucks, best, good, bad))
    failing = bad[bad["fails_at_every_rate"] == "yes"][[*STUDY, "noise"]].drop_duplicates()
    failing = "; ".join(f"{noise} ({study_name(*study)})" for *study, noise in failing.values)
    tables = [
        table_of("best", best, view=best_view(best, statistics)),
        table_of("consistent", good),
        table_of(
            "consistently_worse", bad, how=f"{HOW['consistently_worse']} {failing or 'none'}."
        ),
        table_of("luck", luck, only_csv=LUCK_ONLY_CSV),
        table_of(
            "statistics",
            statistics,
            only_csv=("environments", "comparisons", "smallest_p", "smallest_p_adjusted"),
        ),
        table_of("early_performance", early, rates_beside=True),
    ]
    found = frame("interactions", (row for study in judging for row in interaction_rows(study)))
    if len(found):
        tables.append(table_of("interactions", found))
    for algorithm, table in summary.groupby("algorithm"):
        tables.append(table_of("summary", table, name=f"summary_{algorithm}"))
    if paper:
        lengths = {study.key: study.steps[-1] for study in studies}
        steps = ", ".join(f"{study_name(*key)} {n:,}" for key, n in lengths.items())
        listed = judged, best, consistency, good, bad, early
        for name, table in compare_tables(paper, lengths, *listed):
            section = name.removeprefix("compare_")
            if section == "luck":
                more = {"kind": name, "only_csv": LUCK_ONLY_CSV}
            else:
                more = {"kind": "compare", "how": f"{HOW['compare']} {steps}."}
            tables.append(table_of(frame=table, section=section, name=name, **more))
    return {table.name: table for table in tables}


def table_of(kind, frame, name=None, section=None, how=None, **more):
    """Make a Table with the formats and texts of this module; name and section may be its kind."""
    how = HOW.get(kind, "") if how is None else how
    return Table(name or kind, frame, CAPTIONS[kind], section or kind, FORMATS, how, **more)


def best_view(best, statistics):
    """Return the best noises as people read them, in nine columns.

    The improvement is that of the verdict, of the interquartile mean, with its interval.
    """
    keys = [*KEYS, "scope"]
    tests = statistics.set_index(keys)[
        ["improvement_iqm_percent", "improvement_low", "improvement_high"]
    ]
    rows = pd.MultiIndex.from_frame(best.assign(scope="environment")[keys])
    view = pd.DataFrame(index=best.index)
    names = [study_name(*key) for key in best[STUDY].itertuples(index=False)]
    view["algorithm, environment"] = [
        f"{name}, {environment}"
        for name, environment in zip(names, best["environment"], strict=True)
    ]
    same = ["noise", "noise_rate", "baseline_mean", "baseline_std", "noisy_mean", "noisy_std"]
    view = view.join(best[same]).join(tests.reindex(rows).set_index(best.index))
    view = view.join(best[["p_adjusted", "luck_95_percent"]])
    view["p_luck_of_best"] = best["p_luck"]
    view["n"] = [seeds_of(*pair) for pair in best[["n", "n_baseline"]].to_numpy()]
    return view
