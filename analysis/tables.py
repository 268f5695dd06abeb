"""The tables of analyze.py: their rows, their columns and captions."""

from itertools import product

import numpy as np
import pandas as pd

from analysis import statistics, verdicts
from analysis.comparisons import IQM, IQM_CHANGE, PROBABILITY, compare_all, results
from analysis.folders import SEARCH, SUCCESS
from analysis.formatting import Table, listed, seeds_of
from analysis.luck import add_luck, luck_of_studies
from analysis.power import CONFIDENCE
from analysis.runs import KEYS, STUDY, study_name
from analysis.verdicts import ALL_EQUAL
from analysis.words import slug
from noisy_wrappers import BASELINE

CONSISTENT_PERCENT = 80  # of the environments, as in the paper
_BEST = ["algorithm, environment", "noise", "noise_rate", "difference", "p_adjusted", "n"]
_BEST += ["luck_95", "p_luck", "baseline_mean", "baseline_std", "noisy_mean", "noisy_std"]
_NOISES = ["verdict", "noise", "algorithm, environment", "difference", "p_adjusted", "n"]
# Columns as people read them; a terminal may lack room for the last ones
IN_WORDS = {"best": _BEST, "noises": [*_NOISES, "noise_rate"]}
DIFFERENCE = ["difference", "difference_low", "difference_high"]
DIFFERENCE += ["difference_percent", "percent_low", "percent_high"]
MORE = ["t", "pooled_std", "environments", "comparisons", "smallest_p", "detectable"]
NOISES = ["noise", "noise_rate", "verdict", *DIFFERENCE, "effect_size", "p", "p_adjusted", "n"]
RATES = [*NOISES, "n_baseline", "n_baseline_most"]
NOISES += ["n_baseline", "n_baseline_most", *MORE]
_COLUMNS = {
    "summary": """environment noise noise_rate n mean std n_baseline baseline_mean baseline_std
        difference difference_percent p steps_to_baseline""",
    "best": """environment noise noise_rate baseline_mean baseline_std noisy_mean noisy_std
        difference difference_percent p p_adjusted luck_median luck_95 p_luck n n_baseline
        chosen_from""",
    "consistency": """noise noise_rate percent_of_environments average_improvement_percent
        std_improvement_percent p p_adjusted environments without_percent n""",
    "success": """environment noise noise_rate mean std baseline_mean baseline_std difference
        difference_low difference_high p p_adjusted n n_baseline""",
    "early_performance": "environment noise steps_millions noise_rate mean std n",
}
COLUMNS = {name: text.split() for name, text in _COLUMNS.items()} | {
    "noises": ["environment", *NOISES],
    "noises_together": NOISES,
    "statistics": ["environment", *RATES, *IQM, *IQM_CHANGE, *PROBABILITY, *MORE],
    "statistics_together": [*RATES, *IQM_CHANGE, *PROBABILITY, *MORE],
}  # after those that name a study
COLUMNS = {name: [*STUDY, *columns] for name, columns in COLUMNS.items()}
ONLY_CSV = (*IQM, *MORE)  # wide tables lack these where people read them

# --------------------------------------------------------------------------------------------- rows


def best_rows(judged):
    """Return the results of the best noise of every study and environment."""
    noisy = judged[judged["difference"].notna()]
    means = noisy.groupby([*STUDY, "environment"])["mean"]
    best = noisy.assign(chosen_from=means.transform("size")).loc[means.idxmax()]
    return best.rename(columns={"mean": "noisy_mean", "std": "noisy_std"})


def consistency_rows(judged, together):
    """Yield per noise and rate the share of envs that are matched or better, and by how much.

    Every environment counts in the share, by the sign of its difference, but those in which all
    returns are equal; the average is over those whose baseline has a percentage, and the others are
    named. p is that of the same environments together: there is none if one cannot be tested.
    """
    keys = [*STUDY, "noise", "noise_rate"]
    tests = together.set_index([*keys, "environments"])[["p", "p_adjusted"]].to_dict("index")
    told = judged["difference"].notna() & (judged["verdict"] != ALL_EQUAL)
    for key, group in judged[told].groupby(keys):
        mean, std, _ = statistics.mean_std(group["difference_percent"])
        without = group.loc[group["difference_percent"].isna(), "environment"]
        row = dict(zip(keys, key, strict=True)) | tests.get((*key, len(group)), {})
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
    for (e, env), noise in product(enumerate(study.environments), study.noises):
        configs = [config for config in study.finals if config.noise == noise]
        if not any(len(study.sample(config, e)) for config in configs):
            continue  # not tried here: the baseline alone would be no comparison
        for i, config in product(places, [BASELINE, *configs]):
            row = dict(zip(KEYS, (*study.key, env, noise, config.noise_rate), strict=True))
            row["steps_millions"] = study.steps[i] / 1e6
            row["mean"], row["std"], row["n"] = statistics.mean_std(study.curves[config][i, :, e])
            if row["n"] > 0:
                yield row


# ------------------------------------------------------------------------------------------- tables


def split_consistency(consistency):
    """Return the rows with at least 80 % of the environments, best first, and those with 0 %.

    One environment says nothing about consistency.
    """
    consistency = consistency[consistency["environments"] > 1]
    share = consistency["percent_of_environments"]
    shares = ["percent_of_environments", "average_improvement_percent"]
    ascending = [True] * len(STUDY) + [False] * len(shares)
    good = consistency[share >= CONSISTENT_PERCENT]
    good = good.sort_values([*STUDY, *shares], ascending=ascending, kind="stable")
    return good, consistency[share == 0]


def lopsided_notes(compared):
    """Say where verdicts may be wrong too often, because one side has few of all seeds."""
    noises = compared.noises[compared.noises["p"].notna() & (compared.noises["lopsided"] == 1)]
    rates = compared.rates[compared.rates["smallest_p"].isna()]
    together = compared.rates_together[compared.rates_together["smallest_p"].isna()]

    def note(key, rows, said):
        numbers = rows[["n", "n_baseline", "n_baseline_most"]].to_numpy()
        seeds = sorted({seeds_of(*row) for row in numbers})
        where = ", ".join([study_name(*key), *filter(None, rows["environment"].unique())])
        return f"{where}: with {listed(seeds)} runs with and without noise {said}"

    notes = [
        note(key, rows, "a verdict may be wrong more often than in 5 %")
        for key, rows in noises.groupby(STUDY, sort=False)
    ]
    for key, rows in pd.concat([rates, together]).groupby(STUDY, sort=False):
        alone = rows[rows["environment"] != ""]
        places = ["there"] if len(alone) else []
        if len(alone) < len(rows):
            places.append("over several environments")
        said = f"single rates have no verdict {listed(places)}, which would be wrong too often"
        notes.append(note(key, alone if len(alone) else rows, said))
    return notes


def success_table(studies):
    """Return the table of final success rates as {name: Table}, empty without such studies."""
    studies = [study for study in studies if study.phase != SEARCH]
    rows = results(studies, compare_all(studies))
    return {"success": table_of("success", rows)} if len(rows) else {}


# At most two lines in the report; docs/statistics.md says how the numbers are computed.
CAPTIONS = {
    "noises": f"""Does a noise help at all? All its runs, its rates together, against no noise: the
difference of the mean final returns with its {CONFIDENCE} interval. n: runs.""",
    "noises_together": """Does a noise help at all? The same over all environments, which count
equally. The effect size is the median difference in standard deviations.""",
    "best": """The best noise in each environment, which may still be worse than no noise. Mean
\u00b1 standard deviation of the final return over n seeds (with / without noise).""",
    "consistent": f"""Noise that matches or beats no noise in at least {CONSISTENT_PERCENT} % of two
or more environments. Average improvement \u00b1 standard deviation over environments.""",
    "consistently_worse": "Noise with a lower mean than none in each of two or more environments.",
    "early_performance": """Mean test return \u00b1 standard deviation during training, by noise
rate (0.00: no noise), with the number of seeds in brackets.""",
    "summary": """Final test return of every configuration: mean \u00b1 standard deviation over n
seeds, and the difference from no noise. Here p is not corrected.""",
    "statistics": f"""Every rate alone against no noise, which is secondary: the difference of the
mean final returns with its {CONFIDENCE} interval, and its test. Effect sizes are standard
deviations.""",
    "statistics_together": """The same over all environments, which count equally.""",
    "success": """Final success rate, in percent of the episodes: mean \u00b1 standard deviation
over n seeds, and the difference from no noise in percentage points.""",
    "choice": """How the noise was chosen: each round of the search drops the worse half, and fresh
seeds confirm the winner or not.""",
    "robustness_score": """Primary figure of robustness: the mean return over all test conditions
but that of the training, of policies trained with noise and without.""",
    "robustness_together": """Primary figure of robustness over all environments, which count
equally.""",
    "robustness": """The return under every test condition: mean \u00b1 standard deviation over n
seeds, and difference from the policies trained without noise.""",
    "missing": "Runs that are in no table and no figure, with their seeds.",
}
CAPTIONS = {name: " ".join(text.split()) for name, text in CAPTIONS.items()}


def percent_note(rows, metric):
    """Say in which environments of a table percentages would mean nothing, or ""."""
    if metric == SUCCESS:
        return "Success rates are in percent of the episodes, differences in percentage points."
    without = rows["difference"].notna() & rows["difference_percent"].isna()
    without &= rows["verdict"] != ALL_EQUAL  # which has no percentages for another reason
    names = sorted(set(rows.loc[without, "environment"]))
    if not names:
        return ""
    return (
        f"No percentage, or not for every noise, on {listed(names)}: the mean return without noise "
        "is not clearly different from zero there, or small beside what the returns span. Averages "
        "of percentages leave this out; shares and best noises do not."
    )


def make_tables(studies, compared):
    """Compute every table: a dict of name -> Table, in the order of the report.

    compared: the Comparisons of the studies.
    """
    metric = studies[0].metric
    alone = results(studies, compared)
    # The seeds of a search chose the noise, so they cannot judge it.
    judged = alone[alone["phase"] != SEARCH]
    judging = [study for study in studies if study.phase != SEARCH]
    best = add_luck(best_rows(judged), luck_of_studies(judging))
    rows = consistency_rows(judged, compared.rates_together)
    good, bad = split_consistency(pd.DataFrame(rows, columns=COLUMNS["consistency"]))
    returns = (row for study in studies for row in early_rows(study))
    early = pd.DataFrame(returns, columns=COLUMNS["early_performance"])
    note = percent_note(judged, metric)
    has_comparison = judged["difference"].notna()
    rates = judged.assign(n_baseline=judged["n_baseline"].where(has_comparison))
    rates = rates[COLUMNS["statistics"]]
    tables = [
        table_of("noises_together", compared.noises_together, section="noises", only_csv=MORE),
        table_of(
            "noises", compared.noises, only_csv=MORE, note=percent_note(compared.noises, metric)
        ),
        table_of("best", best, view=in_words(best, "best"), note=note),
        table_of("consistent", good, note=note),
        table_of("consistently_worse", bad, note=note),
        table_of(
            "statistics_together", compared.rates_together, section="statistics", only_csv=ONLY_CSV
        ),
        table_of("statistics", rates, view=rates[has_comparison], only_csv=ONLY_CSV, note=note),
        table_of("early_performance", early, rates_beside=True),
    ]
    for algorithm, table in alone.groupby("algorithm"):
        more = {"name": f"summary_{slug(algorithm)}", "note": percent_note(table, metric)}
        tables.append(table_of("summary", table, **more))
    return {table.name: table for table in tables}


def table_of(kind, frame, name=None, section=None, **more):
    """Make a Table with the columns and the caption of its kind; name and section may be kind."""
    frame = frame[COLUMNS.get(kind, list(frame))]
    return Table(name or kind, frame, CAPTIONS[kind], section or kind, **more)


def in_words(compared, kind):
    """Return comparisons with the columns IN_WORDS of a kind of table."""
    names = compared[[*STUDY, "environment"]].to_numpy()
    names = [f"{study_name(*key)}, {environment}" for *key, environment in names]
    seeds = [seeds_of(*pair) for pair in compared[["n", "n_baseline"]].values]
    said = [verdicts.difference_in_words(row) for row in compared.itertuples()]
    view = compared.assign(difference=said, n=seeds)
    view["algorithm, environment"] = names
    return view[IN_WORDS[kind]]
