"""Every noise against no noise: frames of comparisons, in one environment and over several.

A noise is compared with its rates together, which asks whether it helps at all, and each of its
rates alone, which is secondary: with a correction of its own.
"""

from dataclasses import dataclass, replace
from itertools import groupby, product

import numpy as np
import pandas as pd
from scipy import stats

from analysis import iqm, statistics, verdicts
from analysis.folders import CONFIRMATION, PHASES, SEARCH
from analysis.runs import KEYS, STUDY
from analysis.verdicts import ALL_EQUAL
from noisy_wrappers import BASELINE

PROBABILITY = ["probability_of_improvement", "probability_low", "probability_high"]
IQM = ["iqm", "iqm_low", "iqm_high"]
IQM_CHANGE = ["iqm_change_percent", "iqm_change_low", "iqm_change_high"]
# What a comparison does not tell where all returns are equal
UNKNOWN = ["t", "p", "difference_low", "difference_high", *IQM_CHANGE]
UNKNOWN += ["difference_percent", "percent_low", "percent_high", "detectable"]
UNTESTED = ["t", "p", "smallest_p", "detectable"]  # what none tells that has no test
VERDICT = ["p_adjusted", "comparisons", "verdict"]
COMPARED = [*statistics.Comparison._fields, *VERDICT, *IQM_CHANGE, *PROBABILITY, "lopsided"]
RESULTS = ["mean", "std", "n", "baseline_mean", "baseline_std", "n_baseline", *IQM]
RESULTS += ["steps_to_baseline"]


@dataclass(frozen=True)
class Comparisons:
    """All comparisons of some studies: frames with KEYS and COMPARED."""

    noises: pd.DataFrame  # with the rates of a noise together, in one environment
    noises_together: pd.DataFrame  # over several environments; `environment` is empty
    rates: pd.DataFrame  # every rate alone
    rates_together: pd.DataFrame


def compare_all(studies, smallest_gain=None):
    """Compare every noise of some studies of one metric with no noise."""
    metric = next((study.metric for study in studies), None)
    how = metric, smallest_gain
    alone, together = [*STUDY, "environment"], STUDY
    noises = judged(rows_in_one_environment(studies, "noise"), alone, *how)
    noises_together = judged(rows_together(studies, "noise"), together, *how)
    rates = rows_in_one_environment(studies, "rate")
    rates_together = rows_together(studies, "rate")
    return Comparisons(
        noises,
        noises_together,
        judged_beside(noises, rates, alone, *how),
        judged_beside(noises_together, rates_together, together, *how),
    )


def frame(rows, columns):
    """Return rows, which may lack columns, as a frame with KEYS and these columns."""
    table = pd.DataFrame(rows, columns=[*KEYS, *columns])
    return table.astype({name: object if name == "verdict" else float for name in columns})


def row_keys(study, environment, noise, noise_rate):
    """Return the columns that say what a row is about."""
    return dict(zip(KEYS, (*study.key, environment, noise, noise_rate), strict=True))


def rows_in_one_environment(studies, by):
    """Return the comparisons in one environment, without corrections and verdicts.

    The seeds of a search chose the noise, so they are not compared.
    """
    rows = []
    for study in studies:
        if study.phase == SEARCH:
            continue
        all_equal = study.all_equal()
        for e, environment in enumerate(study.environments):
            if len(study.sample(BASELINE, e)) == 0:
                continue
            tried = [config for config in study.finals if len(study.sample(config, e))]
            for (noise, rate), configs in groups_of(tried, by).items():
                row = row_keys(study, environment, noise, rate)
                row |= against_baseline(study, configs, [e], by)
                if environment in all_equal:
                    row |= dict.fromkeys(UNKNOWN, np.nan) | {"verdict": ALL_EQUAL}
                rows.append(row)
    return frame(rows, COMPARED)


def rows_together(studies, by):
    """Return the comparisons over several environments, without corrections and verdicts.

    Environments count that have two runs of both kinds, of which not all have the same result. In a
    confirmation each environment has its one comparison.
    """
    rows = []
    for study in studies:
        if study.phase in PHASES:
            continue
        for (noise, rate), configs in groups_of(study.finals, by).items():
            numbers = np.minimum(runs_in(study, configs), runs_in(study, [BASELINE]))
            finals = finals_of(study, [BASELINE, *configs])
            differing = np.array([statistics.are_different(values) for values in finals.T])
            places = np.flatnonzero(differing & (numbers >= 2))
            if len(places) > 1:
                row = row_keys(study, "", noise, rate)
                rows.append(row | against_baseline(study, configs, places, by))
    return frame(rows, COMPARED)


def groups_of(configs, by):
    """Return {(noise, rates): configurations}, by "noise" (its rates together) or by "rate"."""
    groups = {}
    noises = [config for config in configs if config != BASELINE]
    if by == "rate":
        return {(config.noise, config.noise_rate): [config] for config in noises}
    for noise, same in groupby(noises, lambda config: config.noise):  # they are sorted
        same = list(same)
        groups[noise, ", ".join(config.noise_rate for config in same)] = same
    return groups


def runs_in(study, configs):
    """Return the number of runs of some configurations in each environment."""
    return np.isfinite(finals_of(study, configs)).sum(axis=0)


def finals_of(study, configs):
    """Return what the runs of some configurations count with, together: (runs x envs)."""
    return np.concatenate([study.finals[config] for config in configs])


def against_baseline(study, configs, places, by):
    """Return the part of a row that compares some configurations together with the baseline.

    places: the numbers of the environments. by "rate": also the change of the IQM and the
    probability of improvement. lopsided: whether the numbers of seeds are, in any environment.
    """
    x, y = finals_of(study, configs)[:, places], study.finals[BASELINE][:, places]
    row = statistics.compare(x, y, episodes=study.episodes)._asdict()
    most = verdicts.MOST_RATIO_OF_RATES if by == "rate" else verdicts.MOST_RATIO
    seeds = runs_in(study, configs)[places], runs_in(study, [BASELINE])[places]
    row["lopsided"] = any(verdicts.is_lopsided(*n, most) for n in zip(*seeds, strict=True))
    if by == "rate":
        row |= zip(PROBABILITY, iqm.probability_of_improvement(x, y), strict=True)
    if by == "rate" and np.isfinite(row["difference_percent"]):
        row |= zip(IQM_CHANGE, iqm.bootstrap_iqm(x, y), strict=True)
    return row


def judged_beside(noises, rates, family, metric, smallest_gain=None):
    """Return the comparisons of rates with verdicts, beside those of noises.

    They are secondary: they have a correction of their own. A noise that has one rate has the
    verdict of its only comparison. Where the numbers of seeds differ so much that a test may be
    wrong too often, there is neither p nor verdict.
    """
    several = ~are_in(rates, noises)
    lopsided = several & rates["p"].notna() & (rates["lopsided"] == 1)
    rates.loc[lopsided, UNTESTED] = np.nan
    many = judged(rates[several].copy(), family, metric, smallest_gain)
    found = noises.set_index(KEYS)[VERDICT]
    only = rates[~several].drop(columns=VERDICT).join(found, on=KEYS)
    return pd.concat([many, only[many.columns]]).sort_index() if len(many) else only[rates.columns]


def are_in(rates, noises):
    """Tell which comparisons of rates are those of noises, too: of a noise that has one rate."""
    return pd.MultiIndex.from_frame(rates[KEYS]).isin(pd.MultiIndex.from_frame(noises[KEYS]))


def as_chosen(compared, choice):
    """Return Comparisons in which confirmations have the verdicts of `./benchmark.sh choose`.

    It looks at them several times, at levels that were fixed beforehand, so a plain p would be one
    look more. One that it has not judged yet has no verdict. choice: of read_choice, or None.
    """
    said = {}
    if choice is not None:
        for row in choice[choice["phase"] == CONFIRMATION].itertuples():
            study = row.algorithm, row.environment, row.exp_name, row.tested
            key = *study, row.noise, row.noise_rate
            words = {"yes": verdicts.BETTER, "worse": verdicts.WORSE}
            said[key] = words.get(row.survives, verdicts.UNCLEAR)

    def verdict(row):
        if row["phase"] != CONFIRMATION or row["verdict"] in (verdicts.TOO_FEW, ALL_EQUAL):
            return row["verdict"]
        study = row["algorithm"], row["environment"], row["exp_name"], row["tested"]
        key = *study, row["noise"], row["noise_rate"]
        return said.get(key, np.nan)

    judged = {}
    for name in ("noises", "rates"):
        rows = getattr(compared, name)
        found = [verdict(row) for row in rows.to_dict("records")]
        judged[name] = rows.assign(verdict=pd.Series(found, index=rows.index, dtype=object))
    return replace(compared, **judged)


def results(studies, compared):
    """Return what every configuration has reached in each environment, with its comparison.

    Those of the baseline and of a search, which have no comparison, too. compared: Comparisons.
    """
    rows = []
    for study in studies:
        for (e, environment), config in product(enumerate(study.environments), study.finals):
            sample, baseline = study.sample(config, e), study.sample(BASELINE, e)
            if len(sample) == 0:
                continue
            row = row_keys(study, environment, config.noise, config.noise_rate)
            row |= zip(RESULTS[:3], statistics.mean_std(sample), strict=True)
            row |= zip(RESULTS[3:6], statistics.mean_std(baseline), strict=True)
            found = iqm.bootstrap_iqm(sample)
            row |= zip(IQM, np.clip(found, 0, 100) if study.episodes else found, strict=True)
            curves, target = study.curves[config][..., e], row["baseline_mean"]
            row["steps_to_baseline"] = statistics.steps_to_reach(curves, study.steps, target)
            rows.append(row)
    beside = compared.rates.drop(columns=["n", "n_baseline"])
    return frame(rows, RESULTS).merge(beside, how="left", on=KEYS)


def judged(rows, family, metric, smallest_gain=None):
    """Add p corrected for all comparisons of a family, the smallest possible, and verdicts.

    A family is a study in one environment, or over all, corrected with Benjamini and Hochberg's
    method. A confirmation of `./benchmark.sh choose` was fixed beforehand, with a level of its own,
    and is not corrected.
    """
    tested = rows[rows["p"].notna()]
    rows.loc[tested.index, "p_adjusted"] = tested["p"]
    rows.loc[tested.index, "comparisons"] = 1
    for _, group in tested[tested["phase"] != CONFIRMATION].groupby(family):
        corrected = stats.false_discovery_control(group["p"].to_numpy(float))
        rows.loc[group.index, "p_adjusted"] = corrected
        rows.loc[group.index, "comparisons"] = len(group)
    found = [verdicts.verdict(row, smallest_gain, metric) for row in rows.to_dict("records")]
    rows["verdict"] = pd.Series(found, index=rows.index, dtype=object)
    return rows
