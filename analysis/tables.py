"""The tables of analyze.py: their rows, made of a Study's returns, their columns and captions."""

from itertools import product
from math import ceil

import numpy as np
import pandas as pd
from scipy import stats

from analysis.folders import SEARCH
from analysis.formatting import P_VALUE, PLAIN, SHARE, TENTH, WHOLE, Table
from analysis.luck import (
    CONSISTENT_PERCENT,
    DRAWS,
    add_luck_of_best,
    add_luck_of_consistent,
    luck_of_study,
    luck_rows,
)
from analysis.paper import compare_tables
from analysis.runs import KEYS, STUDY, SUCCESS, study_name
from analysis.statistics import (
    LEVEL,
    bootstrap_iqm,
    compare,
    contrast,
    holm,
    mean_std,
    probability_of_improvement,
    steps_to_reach,
)
from analysis.verdicts import (
    ALL_EQUAL,
    counted,
    difference,
    listed,
    seeds_of,
    verdict,
    what_all_runs_do,
)
from noisy_wrappers import BASELINE

PERCENTS = ("difference_percent", "iqm_change_percent", "iqm_change_low", "iqm_change_high")
INTERVAL = ("difference_low", "difference_high")
SEEDS_FOR_INTERACTION = 3  # of each of the four configurations
# After those that name a study
_COLUMNS = {
    "summary": """environment noise noise_rate n mean std n_baseline baseline_mean
        baseline_std difference improvement_percent p steps_to_baseline""",
    "best": """environment noise noise_rate baseline_mean baseline_std noisy_mean
        noisy_std difference improvement_percent p p_adjusted luck_median luck_95 p_luck
        n n_baseline chosen_from""",
    "consistency": """noise noise_rate percent_of_environments
        average_improvement_percent std_improvement_percent p p_adjusted p_luck
        environments without_percent n fails_at_every_rate""",
    "luck": """environments best_beyond_luck configurations
        consistent consistent_by_luck consistent_by_luck_95 p_consistent consistent_beyond_luck
        consistently_worse consistently_worse_by_luck consistently_worse_by_luck_95
        p_consistently_worse consistently_worse_beyond_luck""",
    "success": """environment noise noise_rate mean std baseline_mean baseline_std difference
        p p_adjusted n n_baseline""",
    "interactions": """environment noise noise_rate n both_mean first_mean second_mean
        baseline_mean interaction interaction_low interaction_high standard_error
        interaction_percent percent_low percent_high""",
    "early_performance": "environment noise steps_millions noise_rate mean std n",
    "statistics": """scope environment noise noise_rate verdict difference difference_low
        difference_high difference_percent effect_size p p_adjusted n n_baseline n_baseline_most
        detectable seeds_needed iqm iqm_low iqm_high iqm_change_percent iqm_change_low
        iqm_change_high probability_of_improvement probability_low probability_high t pooled_std
        environments comparisons smallest_p smallest_p_adjusted""",
}
COLUMNS = {name: [*STUDY, *text.split()] for name, text in _COLUMNS.items()}
_COLUMNS_WITH = {
    WHOLE: """n n_baseline n_baseline_most environments conditions chosen_from configurations
        seeds seeds_needed steps_to_baseline percent_of_environments best_beyond_luck consistent
        consistent_beyond_luck consistently_worse consistently_worse_beyond_luck""",
    P_VALUE: """p p_adjusted p_holm smallest_p smallest_p_adjusted p_luck p_luck_of_best
        paper_p_luck p_consistent p_consistently_worse""",
    SHARE: "probability_of_improvement probability_low probability_high effect_size t",
    TENTH: "difference_se consistent_by_luck consistently_worse_by_luck",
    PLAIN: "steps_millions",
}
FORMATS = {name: form for form, names in _COLUMNS_WITH.items() for name in names.split()}
STATISTICS_ONLY_CSV = ("iqm", "iqm_low", "iqm_high", "t", "pooled_std", "environments")
STATISTICS_ONLY_CSV += ("seeds_needed", "comparisons", "smallest_p", "smallest_p_adjusted")
LUCK_ONLY_CSV = ("consistent_by_luck_95", "consistently_worse_by_luck_95")

# --------------------------------------------------------------------------------------------- rows


def row_keys(study, environment, config):
    """Return the columns that say what a row is about."""
    return dict(zip(KEYS, (*study.key, environment, config.noise, config.noise_rate), strict=True))


def summary_rows(study):
    """Yield the final mean and std of every configuration, against the baseline of its env."""
    for (e, env), config in product(enumerate(study.environments), study.returns):
        mean, std, n = mean_std(study.final(config)[:, e])
        if n == 0:
            continue
        baseline = study.final(BASELINE)[:, e]
        base_mean, base_std, base_n = mean_std(baseline)
        row = {
            **row_keys(study, env, config),
            "n": n,
            "mean": mean,
            "std": std,
            "n_baseline": base_n,
            "baseline_mean": base_mean,
            "baseline_std": base_std,
        }
        if config != BASELINE:
            row["difference"] = mean - base_mean
            row["improvement_percent"] = study.percent_of(mean - base_mean, e)
        curves = study.returns[config][..., e]
        row["steps_to_baseline"] = steps_to_reach(curves, study.steps, base_mean)
        yield row


def best_rows(summary):
    """Yield the best noise of every study and environment, from the rows of a summary."""
    noisy = summary[summary["difference"].notna()]
    for _, group in noisy.groupby([*STUDY, "environment"]):
        best = group.loc[group["mean"].idxmax()]
        named = {"noisy_mean": best["mean"], "noisy_std": best["std"]}
        yield best.to_dict() | named | {"chosen_from": len(group)}


def consistency_rows(summary):
    """Yield per noise and rate the share of envs that are matched or better, and by how much.

    Every environment counts in the share, by the sign of its difference; the average is over those
    whose baseline has a percentage, and the others are named.
    """
    keys = [*STUDY, "noise", "noise_rate"]
    for key, group in summary[summary["difference"].notna()].groupby(keys):
        mean, std, _ = mean_std(group["improvement_percent"])
        without = group.loc[group["improvement_percent"].isna(), "environment"]
        yield dict(zip(keys, key, strict=True)) | {
            "percent_of_environments": 100 * (group["difference"] >= 0).mean(),
            "average_improvement_percent": mean,
            "std_improvement_percent": std,
            "environments": len(group),
            "without_percent": ", ".join(without),
            "n": group["n"].min(),
        }


def early_rows(study):
    """Yield mean and std at every 0.2 M steps, or at every fifth of a run below 1 M steps."""
    total = study.steps[-1]
    stride = 200_000 if total >= 1_000_000 else total / 5
    wanted = np.arange(1, round(total / stride) + 1) * stride
    places = np.unique(np.searchsorted(study.steps, wanted, side="right") - 1)
    places = places[places >= 0]
    noises = sorted({config.noise for config in study.returns if not config.is_baseline})
    for (e, env), noise in product(enumerate(study.environments), noises):
        configs = [config for config in study.returns if config.noise == noise]
        if not any(np.isfinite(study.final(config)[:, e]).any() for config in configs):
            continue  # not tried here: the baseline alone would be no comparison
        for i, config in product(places, [BASELINE, *configs]):
            mean, std, n = mean_std(study.returns[config][i, :, e])
            if n > 0:
                yield {
                    **row_keys(study, env, config),
                    "noise": noise,
                    "steps_millions": study.steps[i] / 1e6,
                    "mean": mean,
                    "std": std,
                    "n": n,
                }


def statistics_rows(study):
    """Yield the comparison of every configuration with the baseline, per env and over all.

    The scope of a row is "environment", or "all": of those with two seeds of both kinds.
    """
    places = [("environment", env, [e]) for e, env in enumerate(study.environments)]
    if study.phase != "confirmation":  # there each environment has its one comparison
        places.append(("all", "", list(range(len(study.environments)))))
    limits, all_equal = baseline_limits(study), study.all_equal()
    differing = np.array([env not in all_equal for env in study.environments])
    for (scope, environment, chosen), config in product(places, study.returns):
        x, y = study.final(config)[:, chosen], study.final(BASELINE)[:, chosen]
        seeds = np.isfinite(x).sum(axis=0)
        fewest = 2 if scope == "all" else 1
        both = (seeds >= fewest) & (np.isfinite(y).sum(axis=0) >= fewest)
        if scope == "all":
            both &= differing
        row = row_keys(study, environment, config) | {"scope": scope}
        if scope == "all":
            if config == BASELINE or both.sum() < 2:
                continue
        elif not seeds.any():
            continue
        else:  # returns of different environments have no common scale
            row["n"] = seeds[0]
            row["iqm"], row["iqm_low"], row["iqm_high"] = bootstrap_iqm(x)
        if config != BASELINE and both.any():
            clear = not any(low <= 0 <= high for low, high in limits[:, chosen][:, both].T)
            row |= against_baseline(x[:, both], y[:, both], clear)
            if study.metric == SUCCESS:  # never percent of a rate
                row |= dict.fromkeys(PERCENTS, np.nan)
            if environment in all_equal:
                row |= dict.fromkeys([*PERCENTS, *INTERVAL, "t", "p"], np.nan)
                row["verdict"] = ALL_EQUAL
        yield row


def baseline_limits(study):
    """Return the 95 % intervals (2 x envs) of the baseline's IQM, NaN where there is none."""
    limits = np.full((2, len(study.environments)), np.nan)
    for e, returns in enumerate(study.final(BASELINE).T):
        if np.isfinite(returns).any():
            limits[:, e] = bootstrap_iqm(returns)[1:]
    return limits


def against_baseline(x, y, clear):
    """Return the part of a row of statistics that compares x with y, both (seeds x envs).

    clear: whether the IQM of every baseline is clearly not zero, so that the IQM has percent.
    """
    row = compare(x, y)._asdict()
    names = ("probability_of_improvement", "probability_low", "probability_high")
    row |= zip(names, probability_of_improvement(x, y), strict=True)
    if clear and np.isfinite(row["difference_percent"]):
        names = ("iqm_change_percent", "iqm_change_low", "iqm_change_high")
        row |= zip(names, bootstrap_iqm(x, y), strict=True)
    return row


def interaction_rows(study):
    """Yield, for two noises and both at once: how much more do they change than their sum?

    I = J(A + B) - J(A) - J(B) + J(0) of the mean final returns, in every environment where all
    four have at least SEEDS_FOR_INTERACTION seeds, with a 95 % interval; then relative to |J(0)|.
    """
    for (e, environment), config in product(enumerate(study.environments), study.returns):
        parts = config.parts
        if len(parts) != 2 or parts[0] == parts[1]:
            continue
        samples = []
        for part in (config, *parts, BASELINE):
            finals = study.final(part)[:, e] if part in study.returns else np.empty(0)
            samples.append(finals[np.isfinite(finals)])
        if min(map(len, samples)) < SEEDS_FOR_INTERACTION:
            continue
        both, first, second, alone = samples
        value, error, low, high = contrast(samples, [1, -1, -1, 1])
        percent = study.percent_of(1.0, e)
        yield {
            **row_keys(study, environment, config),
            "n": min(map(len, samples)),
            "both_mean": both.mean(),
            "first_mean": first.mean(),
            "second_mean": second.mean(),
            "baseline_mean": alone.mean(),
            "interaction": value,
            "interaction_low": low,
            "interaction_high": high,
            "standard_error": error,
            "interaction_percent": value * percent,
            "percent_low": low * percent,
            "percent_high": high * percent,
        }


# ------------------------------------------------------------------------------------------- tables


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
    """Add p corrected for all comparisons of a family, the smallest possible, and verdicts.

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
    compared = statistics[statistics["verdict"].notna() & (statistics["verdict"] != ALL_EQUAL)]
    keys = ["comparisons", "smallest_p"]
    for study, rows in compared.groupby(STUDY):
        best = rows.sort_values("smallest_p", kind="stable")
        best = best.drop_duplicates(["scope", "environment"]).sort_index()
        for (size, smallest), same in best.groupby(keys, sort=False, dropna=False):
            places = same["environment"].mask(same["scope"] == "all", "all")
            where = f"{study_name(*study)}, {', '.join(places)}"
            seeds = counted(min(same["n"].min(), same["n_baseline"].min()), "seed")
            if smallest > LEVEL:
                notes.append(
                    f"{where}: with {seeds} no difference can be significant (smallest possible p: "
                    f"{smallest:.2g})."
                )
            elif (needed := ceil(round(size * smallest / LEVEL, 9))) > 1:
                notes.append(
                    f"{where}: with {seeds} and {size:.0f} comparisons, differences can be "
                    f"significant after the correction only if at least {needed} of them are "
                    f"(smallest possible p: {smallest:.2g}, corrected for one alone "
                    f"{min(1, size * smallest):.2g})."
                )
    return notes


def all_equal_notes(studies):
    """Say where all tests of all runs have the same result, so that comparisons say nothing."""
    return [
        f"{study.name} on {environment}: {what_all_runs_do(value, study.metric)} in "
        f"{study.steps[-1]:,} steps, so they say nothing about noise."
        for study in studies
        for environment, value in study.all_equal().items()
    ]


def success_table(studies):
    """Return the table of final success rates as {name: Table}, empty without such studies."""
    judging = [study for study in studies if study.phase != SEARCH]
    rows = [row for study in judging for row in summary_rows(study)]
    if not rows:
        return {}
    statistics = frame("statistics", (row for study in judging for row in statistics_rows(study)))
    return {"success": table_of("success", with_p(frame("success", rows), adjust(statistics)))}


# At most two lines in the report; docs/statistics.md says how the numbers are computed.
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
seeds, and the difference from no noise. Here p is not corrected.""",
    "statistics": """Every noise against no noise: the difference of the mean final returns with its
95 % interval, and its test. The effect size is the difference in standard deviations.""",
    "success": """Success rate in the final test, in percent of its episodes: mean \u00b1 standard
deviation over n seeds, and the difference from no noise in percentage points.""",
    "interactions": """What two combined noises do beyond the sum of their effects, with 95 %
intervals. Above zero, both at once are better than the sum.""",
    "choice": """How the noise was chosen: each round of the search drops the worse half, and fresh
seeds confirm the winner or not.""",
    "robustness_score": """Primary figure of robustness: the mean return under noise that was not in
training, of policies trained with noise and without.""",
    "robustness": """Return under every test condition: mean \u00b1 standard deviation over n seeds,
and difference from the policies trained without noise.""",
    "missing": "Runs that are in no table and no figure, with their seeds.",
    "compare_luck": """The same for the paper's tables.""",
    "compare": "The paper's table (environments v2, 1,000,000 steps) beside ours.",
}
CAPTIONS = {name: " ".join(text.split()) for name, text in CAPTIONS.items()}


def percent_note(summary, metric):
    """Say in which environments of a summary percentages would mean nothing, or ""."""
    if metric == SUCCESS:
        return "Success rates are in percent of the episodes, differences in percentage points."
    without = summary["difference"].notna() & summary["improvement_percent"].isna()
    names = sorted(set(summary.loc[without, "environment"]))
    if not names:
        return ""
    return (
        f"No percentage on {listed(names)}: the mean return without noise is not clearly different "
        "from zero there. Averages of percentages leave this out; shares and best noises do not."
    )


def make_tables(studies, paper=None):
    """Compute every table: a dict of name -> Table, in the order of the report.

    `paper` has the paper's tables (read_paper), to be set beside ours.
    """
    summary = frame("summary", (row for study in studies for row in summary_rows(study)))
    # The seeds of a search chose the noise, so they cannot judge it.
    judging = [study for study in studies if study.phase != "search"]
    judged = summary[summary["phase"] != "search"]
    best = frame("best", best_rows(judged))
    consistency = frame("consistency", consistency_rows(judged))
    early = frame("early_performance", (row for study in studies for row in early_rows(study)))
    statistics = frame("statistics", (row for study in judging for row in statistics_rows(study)))
    statistics = adjust(statistics)
    compared = statistics[statistics["verdict"].notna()]
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
    failing = f"Worse at every rate that was tried: {failing or 'none'}."
    metric = studies[0].metric
    note = percent_note(judged, metric)
    tables = [
        table_of("best", best, view=best_view(best, statistics), note=note),
        table_of("consistent", good, note=note),
        table_of("consistently_worse", bad, note=f"{failing} {note}".strip()),
        table_of("luck", luck, only_csv=LUCK_ONLY_CSV),
        table_of("statistics", statistics, view=compared, only_csv=STATISTICS_ONLY_CSV, note=note),
        table_of("early_performance", early, rates_beside=True),
    ]
    found = frame("interactions", (row for study in judging for row in interaction_rows(study)))
    if len(found):
        tables.append(table_of("interactions", found))
    for algorithm, table in summary.groupby("algorithm"):
        more = {"name": f"summary_{algorithm}", "note": percent_note(table, metric)}
        tables.append(table_of("summary", table, **more))
    if paper:
        lengths = {study.key: study.steps[-1] for study in studies}
        steps = ", ".join(f"{study_name(*key)} {n:,}" for key, n in lengths.items())
        ours = judged, best, consistency, good, bad, early
        for name, table in compare_tables(paper, lengths, *ours):
            section = name.removeprefix("compare_")
            if section == "luck":
                more = {"kind": name, "only_csv": LUCK_ONLY_CSV}
            else:
                more = {"kind": "compare", "note": f"Our steps: {steps}."}
            tables.append(table_of(frame=table, section=section, name=name, **more))
    return {table.name: table for table in tables}


def table_of(kind, frame, name=None, section=None, **more):
    """Make a Table with the formats and captions of this module; name and section may be kind."""
    return Table(name or kind, frame, CAPTIONS[kind], section or kind, FORMATS, **more)


def best_view(best, statistics):
    """Return the best noises as people read them, in nine columns."""
    tests = statistics[statistics["scope"] == "environment"].set_index(KEYS)
    tests = tests.loc[list(best[KEYS].itertuples(index=False, name=None))]
    view = pd.DataFrame(index=best.index)
    names = [study_name(*key) for key in best[STUDY].itertuples(index=False)]
    view["algorithm, environment"] = [
        f"{name}, {environment}"
        for name, environment in zip(names, best["environment"], strict=True)
    ]
    same = ["noise", "noise_rate", "baseline_mean", "baseline_std", "noisy_mean", "noisy_std"]
    view = view.join(best[same])
    view["difference"] = [difference(row) for row in tests.itertuples()]
    view = view.join(best[["p_adjusted", "luck_95"]])
    view["p_luck_of_best"] = best["p_luck"]
    view["n"] = [seeds_of(*pair) for pair in best[["n", "n_baseline"]].to_numpy()]
    return view
