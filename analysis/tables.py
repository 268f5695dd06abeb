"""The tables of analyze.py: their rows, made of a Study's returns, their columns and captions."""

from itertools import product

import numpy as np
import pandas as pd
from scipy import stats

from analysis import statistics, verdicts
from analysis.folders import CONFIRMATION, PHASES, SEARCH
from analysis.formatting import Table
from analysis.luck import add_luck, luck_of_studies
from analysis.paper import compare_tables
from analysis.runs import KEYS, STUDY, SUCCESS, study_name
from analysis.verdicts import ALL_EQUAL, counted, listed, seeds_of
from noisy_wrappers import BASELINE

CONSISTENT_PERCENT = 80  # of the environments, as in the paper
PROBABILITY = ("probability_of_improvement", "probability_low", "probability_high")
IQM_CHANGE = ("iqm_change_percent", "iqm_change_low", "iqm_change_high")
# What a comparison does not tell where all returns are equal
UNKNOWN = ("t", "p", "difference_low", "difference_high", *IQM_CHANGE)
UNKNOWN += ("difference_percent", "improvement_percent")
# The best noises as people read them; a terminal may lack room for the last columns
BEST_VIEW = ["algorithm, environment", "noise", "noise_rate", "difference", "p_adjusted", "n"]
BEST_VIEW += ["luck_95", "p_luck", "baseline_mean", "baseline_std", "noisy_mean", "noisy_std"]
# After those that name a study
_COLUMNS = {
    "summary": """environment noise noise_rate n mean std n_baseline baseline_mean
        baseline_std difference improvement_percent p steps_to_baseline""",
    "best": """environment noise noise_rate baseline_mean baseline_std noisy_mean
        noisy_std difference improvement_percent p p_adjusted luck_median luck_95 p_luck
        n n_baseline chosen_from""",
    "consistency": """noise noise_rate percent_of_environments
        average_improvement_percent std_improvement_percent p p_adjusted
        environments without_percent n fails_at_every_rate""",
    "success": """environment noise noise_rate mean std baseline_mean baseline_std difference
        p p_adjusted n n_baseline""",
    "early_performance": "environment noise steps_millions noise_rate mean std n",
    "statistics": """scope environment noise noise_rate verdict difference difference_low
        difference_high difference_percent effect_size p p_adjusted n n_baseline n_baseline_most
        detectable seeds_needed iqm iqm_low iqm_high iqm_change_percent iqm_change_low
        iqm_change_high probability_of_improvement probability_low probability_high t pooled_std
        environments comparisons smallest_p smallest_p_adjusted""",
}
COLUMNS = {name: [*STUDY, *text.split()] for name, text in _COLUMNS.items()}
COLUMNS["judged"] = [*dict.fromkeys(COLUMNS["summary"] + COLUMNS["statistics"])]
STATISTICS_ONLY_CSV = ("iqm", "iqm_low", "iqm_high", "t", "pooled_std", "environments")
STATISTICS_ONLY_CSV += ("seeds_needed", "comparisons", "smallest_p", "smallest_p_adjusted")

# --------------------------------------------------------------------------------------------- rows


def row_keys(study, environment, config):
    """Return the columns that say what a row is about."""
    return dict(zip(KEYS, (*study.key, environment, config.noise, config.noise_rate), strict=True))


def judge(studies):
    """Return all that is known of the final returns of studies, with the verdicts on them.

    The result has the columns of the tables summary and statistics, and a row for every
    configuration in every environment (scope "environment"), then for every noise in all
    environments together (scope "all").
    """
    rows = [row for study in studies for row in final_rows(study)]
    return adjust(pd.DataFrame(rows, columns=COLUMNS["judged"]))


def final_rows(study):
    """Yield the rows of `judge` for one study, without corrections and verdicts.

    The seeds of a search chose the noise, so they are not compared.
    """
    all_equal = study.all_equal()
    for (e, environment), config in product(enumerate(study.environments), study.returns):
        sample, baseline = study.sample(config, e), study.sample(BASELINE, e)
        if len(sample) == 0:
            continue
        row = row_keys(study, environment, config) | {"scope": "environment"}
        row["mean"], row["std"], row["n"] = statistics.mean_std(sample)
        row["baseline_mean"], row["baseline_std"], row["n_baseline"] = statistics.mean_std(baseline)
        row["iqm"], row["iqm_low"], row["iqm_high"] = statistics.bootstrap_iqm(sample)
        curves, target = study.returns[config][..., e], row["baseline_mean"]
        row["steps_to_baseline"] = statistics.steps_to_reach(curves, study.steps, target)
        if config != BASELINE and len(baseline) and study.phase != SEARCH:
            row |= against_baseline(study, config, [e])
            row["improvement_percent"] = row["difference_percent"]
            if environment in all_equal:
                row |= dict.fromkeys(UNKNOWN, np.nan) | {"verdict": ALL_EQUAL}
        yield row
    if study.phase in PHASES:  # in a confirmation each environment has its one comparison
        return
    differing = np.array([environment not in all_equal for environment in study.environments])
    for config in study.returns:
        seeds = [np.isfinite(study.final(side)).sum(axis=0) for side in (config, BASELINE)]
        places = np.flatnonzero(differing & (np.minimum(*seeds) >= 2))
        if config != BASELINE and len(places) > 1:
            row = row_keys(study, "", config) | {"scope": "all"}
            yield row | against_baseline(study, config, places)


def against_baseline(study, config, places):
    """Return the part of a row that compares a configuration with the baseline.

    places: the numbers of the environments.
    """
    x, y = study.final(config)[:, places], study.final(BASELINE)[:, places]
    row = statistics.compare(x, y)._asdict()
    row |= zip(PROBABILITY, statistics.probability_of_improvement(x, y), strict=True)
    if study.metric == SUCCESS:  # never percent of a rate
        row["difference_percent"] = np.nan
    if np.isfinite(row["difference_percent"]):
        row |= zip(IQM_CHANGE, statistics.bootstrap_iqm(x, y), strict=True)
    return row


def best_rows(judged):
    """Return the rows of `judge` about the best noise of every study and environment."""
    noisy = judged[judged["difference"].notna()]
    means = noisy.groupby([*STUDY, "environment"])["mean"]
    best = noisy.assign(chosen_from=means.transform("size")).loc[means.idxmax()]
    return best.rename(columns={"mean": "noisy_mean", "std": "noisy_std"})


def consistency_rows(judged):
    """Yield per noise and rate the share of envs that are matched or better, and by how much.

    Every environment counts in the share, by the sign of its difference, but those in which all
    returns are equal; the average is over those whose baseline has a percentage, and the others are
    named. p is that of all environments.
    """
    keys = [*STUDY, "noise", "noise_rate"]
    tests = judged[judged["scope"] == "all"].set_index(keys)[["p", "p_adjusted"]].to_dict("index")
    told = judged["difference"].notna() & (judged["verdict"] != ALL_EQUAL)
    for key, group in judged[told].groupby(keys):
        mean, std, _ = statistics.mean_std(group["improvement_percent"])
        without = group.loc[group["improvement_percent"].isna(), "environment"]
        row = dict(zip(keys, key, strict=True)) | tests.get(key, {})
        yield row | {
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
    noises = sorted({config.noise for config in study.returns if config != BASELINE})
    for (e, env), noise in product(enumerate(study.environments), noises):
        configs = [config for config in study.returns if config.noise == noise]
        if not any(len(study.sample(config, e)) for config in configs):
            continue  # not tried here: the baseline alone would be no comparison
        for i, config in product(places, [BASELINE, *configs]):
            row = row_keys(study, env, config) | {"noise": noise}
            row["steps_millions"] = study.steps[i] / 1e6
            row["mean"], row["std"], row["n"] = statistics.mean_std(study.returns[config][i, :, e])
            if row["n"] > 0:
                yield row


# ------------------------------------------------------------------------------------------- tables


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


def adjust(rows):
    """Add p corrected for all comparisons of a family, the smallest possible, and verdicts.

    A family is a study in one environment, or in all, corrected with Benjamini and Hochberg's
    method. The confirmations of `./benchmark.sh choose` were fixed beforehand: they are one family,
    corrected with Holm's method.
    """
    tested = rows[rows["p"].notna()]
    confirmed = tested["phase"] == CONFIRMATION
    families = [(tested[confirmed], statistics.holm)] if confirmed.any() else []
    for _, family in tested[~confirmed].groupby([*STUDY, "scope", "environment"], dropna=False):
        families.append((family, stats.false_discovery_control))
    for family, correct in families:
        rows.loc[family.index, "p_adjusted"] = correct(family["p"].to_numpy(float))
        rows.loc[family.index, "comparisons"] = len(family)
    rows["smallest_p_adjusted"] = (rows["smallest_p"] * rows["comparisons"]).clip(upper=1)
    rows["verdict"] = [verdicts.verdict(row) for _, row in rows.iterrows()]
    return rows


def family_notes(judged):
    """Say where there are too few seeds for a difference that is significant, if corrected."""
    notes = []
    compared = judged[judged["verdict"].notna() & (judged["verdict"] != ALL_EQUAL)]
    best = compared.sort_values("smallest_p", kind="stable")
    best = best.drop_duplicates([*STUDY, "scope", "environment"]).sort_index()
    keys = [*STUDY, "comparisons", "smallest_p"]
    for (*study, size, smallest), same in best.groupby(keys, sort=False, dropna=False):
        places = same["environment"].mask(same["scope"] == "all", "all")
        seeds = counted(same[["n", "n_baseline"]].min(axis=None), "seed")
        start = f"{study_name(*study)}, {', '.join(places)}: with {seeds}"
        possible = f"smallest possible p: {verdicts.two_digits(smallest)}"
        if smallest > statistics.LEVEL:
            notes.append(f"{start} no difference can be significant ({possible}).")
        elif round(size * smallest, 9) > statistics.LEVEL:
            corrected = verdicts.two_digits(min(1, size * smallest))
            notes.append(
                f"{start} and {size:.0f} comparisons no difference alone can be significant "
                f"after the correction ({possible}, corrected {corrected})."
            )
    return notes


def all_equal_notes(studies):
    """Say where all tests of all runs have the same result, so that comparisons say nothing."""
    return [
        f"{study.name} on {environment}: {verdicts.what_all_runs_do(value, study.metric)} in "
        f"{study.steps[-1]:,} steps, so they say nothing about noise."
        for study in studies
        for environment, value in study.all_equal().items()
    ]


def success_table(studies):
    """Return the table of final success rates as {name: Table}, empty without such studies."""
    rows = judge(study for study in studies if study.phase != SEARCH)
    rows = rows[rows["scope"] == "environment"]
    return {"success": table_of("success", rows[COLUMNS["success"]])} if len(rows) else {}


# At most two lines in the report; docs/statistics.md says how the numbers are computed.
CAPTIONS = {
    "best": """The best noise in each environment, which may still be worse than no noise. Mean
\u00b1 standard deviation of the final return over n seeds (with / without noise).""",
    "consistent": f"""Noise that matches or beats no noise in at least {CONSISTENT_PERCENT} % of two
or more environments. Average improvement \u00b1 standard deviation over environments.""",
    "consistently_worse": "Noise that is worse than no noise in each of two or more environments.",
    "early_performance": """Mean test return \u00b1 standard deviation during training, by noise
rate (0.00: no noise), with the number of seeds in brackets.""",
    "summary": """Final test return of every configuration: mean \u00b1 standard deviation over n
seeds, and the difference from no noise. Here p is not corrected.""",
    "statistics": """Every noise against no noise: the difference of the mean final returns with its
95 % interval, and its test. The effect size is the difference in standard deviations.""",
    "success": """Success rate in the final test, in percent of its episodes: mean \u00b1 standard
deviation over n seeds, and the difference from no noise in percentage points.""",
    "choice": """How the noise was chosen: each round of the search drops the worse half, and fresh
seeds confirm the winner or not.""",
    "robustness_score": """Primary figure of robustness: the mean return under noise that was not in
training, of policies trained with noise and without.""",
    "robustness": """The return under every test condition: mean \u00b1 standard deviation over n
seeds, and difference from the policies trained without noise.""",
    "missing": "Runs that are in no table and no figure, with their seeds.",
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
    rows = judge(studies)
    alone = rows[rows["scope"] == "environment"]
    # The seeds of a search chose the noise, so they cannot judge it.
    judged = rows[rows["phase"] != SEARCH]
    judging = [study for study in studies if study.phase != SEARCH]
    best = add_luck(best_rows(judged), luck_of_studies(judging))
    consistency = pd.DataFrame(consistency_rows(judged), columns=COLUMNS["consistency"])
    good, bad = split_consistency(consistency)
    returns = (row for study in studies for row in early_rows(study))
    early = pd.DataFrame(returns, columns=COLUMNS["early_performance"])
    failing = bad[bad["fails_at_every_rate"] == "yes"][[*STUDY, "noise"]].drop_duplicates()
    failing = "; ".join(f"{noise} ({study_name(*study)})" for *study, noise in failing.values)
    failing = f"Worse at every rate that was tried: {failing or 'none'}."
    note = percent_note(judged, studies[0].metric)
    compared = judged["verdict"].notna()
    table = judged.assign(n_baseline=judged["n_baseline"].where(compared))[COLUMNS["statistics"]]
    more = {"view": table[compared], "only_csv": STATISTICS_ONLY_CSV, "note": note}
    tables = [
        table_of("best", best[COLUMNS["best"]], view=best_view(best), note=note),
        table_of("consistent", good, note=note),
        table_of("consistently_worse", bad, note=f"{failing} {note}".strip()),
        table_of("statistics", table, **more),
        table_of("early_performance", early, rates_beside=True),
    ]
    for algorithm, table in alone.groupby("algorithm"):
        more = {"name": f"summary_{algorithm}", "note": percent_note(table, studies[0].metric)}
        tables.append(table_of("summary", table[COLUMNS["summary"]], **more))
    if paper:
        lengths = {study.key: study.steps[-1] for study in studies}
        steps = ", ".join(f"{study_name(*key)} {n:,}" for key, n in lengths.items())
        ours = alone[alone["phase"] != SEARCH], consistency, early
        for name, table in compare_tables(paper, lengths, *ours):
            more = {"name": f"compare_{name}", "section": name, "note": f"Our steps: {steps}."}
            tables.append(table_of("compare", table, **more))
    return {table.name: table for table in tables}


def table_of(kind, frame, name=None, section=None, **more):
    """Make a Table as this module describes its kind; name and section may be kind."""
    return Table(name or kind, frame, CAPTIONS[kind], section or kind, **more)


def best_view(best):
    """Return the best noises as people read them, in nine columns."""
    names = [f"{study_name(*key)}, {env}" for *key, env in best[[*STUDY, "environment"]].values]
    seeds = [seeds_of(*pair) for pair in best[["n", "n_baseline"]].values]
    said = [verdicts.difference(row) for row in best.itertuples()]
    view = best.assign(difference=said, n=seeds)
    view["algorithm, environment"] = names
    return view[BEST_VIEW]
