"""What luck alone would show: a sweep in which no noise does anything, drawn many times.

The best of many configurations looks good although none is. Each draw makes the baseline and all
configurations anew, each with its own number of seeds, from one and the same distribution of final
returns. Keeping the baseline fixed would not do: a baseline that was unlucky is part of the luck.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.runs import STUDY, rows_of
from analysis.statistics import LEVEL, pooled_std

DRAWS = 10_000
SEEDS_TO_RESAMPLE = 20  # with fewer seeds of the baseline, returns are taken as normal
CONSISTENT_PERCENT = 80  # of the environments, as in the paper
_COLUMNS = """environments best_beyond_luck configurations
    consistent consistent_by_luck consistent_by_luck_95 p_consistent consistent_beyond_luck
    consistently_worse consistently_worse_by_luck consistently_worse_by_luck_95
    p_consistently_worse consistently_worse_beyond_luck"""
COLUMNS = [*STUDY, *_COLUMNS.split()]  # of the table of luck


@dataclass
class Luck:
    """What DRAWS sweeps of an algorithm show in which no noise does anything."""

    best: dict  # environment -> (draws,) the highest difference, in units of the return, or NaN
    configurations: int  # how many there are in two or more environments
    highest: np.ndarray  # (draws,) the highest average improvement of any of them, in percent
    lowest: np.ndarray  # (draws,) the lowest one
    consistent: np.ndarray  # (draws,) how many of them count as consistent
    consistently_worse: np.ndarray  # (draws,) how many are worse in every environment


def draw_differences(std, df, n_baseline, n_noisy, rng, seeds=()):
    """Draw the differences of configurations that do nothing from their baseline.

    The standard deviation `std` was estimated with `df` degrees of freedom, so each draw has its
    own, std sqrt(df / chi2_df). For a single configuration this is Student's t-test. Returns are
    normal, or have the shape of the baseline's `seeds` if there are SEEDS_TO_RESAMPLE or more.

    std, df, n_baseline: numbers; n_noisy (configs,), 0 where there is no run
    -> (configs x draws) in units of std, NaN where there is no run.
    """
    spread = std * np.sqrt(df / rng.chisquare(df, DRAWS))
    resample = len(seeds) >= SEEDS_TO_RESAMPLE and np.ptp(seeds) > 0
    if resample:
        shape = (seeds - np.mean(seeds)) / np.std(seeds)

    def mean_of(n):
        if resample:
            return rng.choice(shape, (DRAWS, n)).mean(axis=1)
        return rng.standard_normal(DRAWS) / np.sqrt(n)

    baseline = mean_of(n_baseline)
    differences = np.full((len(n_noisy), DRAWS), np.nan)
    for i, n in enumerate(n_noisy):
        if n > 0:
            differences[i] = spread * (mean_of(n) - baseline)
    return differences


def summarize(environments, draws, percents):
    """Make a Luck of differences (envs x configs x draws) that are NaN where there is no run.

    percents (envs,): what a difference of 1 is in percent of the baseline, NaN where percentages
    mean nothing.
    """
    tried = np.isfinite(draws[..., 0])
    best = dict(zip(environments, np.fmax.reduce(draws, axis=1, initial=np.nan), strict=True))
    several = tried.sum(axis=0) > 1
    draws, number = draws[:, several], tried[:, several].sum(axis=0)[:, None]
    share = 100 * (draws >= 0).sum(axis=0) / number  # NaN >= 0 is false
    improvements = draws * percents[:, None, None]
    averaged = np.isfinite(improvements[..., 0]).sum(axis=0)[:, None]
    average = np.nansum(improvements, axis=0) / np.where(averaged, averaged, np.nan)
    return Luck(
        best=best,
        configurations=int(several.sum()),
        highest=np.fmax.reduce(average, axis=0, initial=-np.inf),
        lowest=np.fmin.reduce(average, axis=0, initial=np.inf),
        consistent=(share >= CONSISTENT_PERCENT).sum(axis=0),
        consistently_worse=(share == 0).sum(axis=0),
    )


def luck_of_study(study):
    """Draw the sweep of a Study again, with its numbers of seeds, as if no noise did anything."""
    rng = np.random.default_rng(0)
    draws = np.full((len(study.environments), len(study.returns) - 1, DRAWS), np.nan)
    for e in range(len(study.environments)):
        samples = [study.sample(config, e) for config in study.returns]
        std, df = pooled_std(samples)
        n_baseline, *n_noisy = map(len, samples)
        if n_baseline and df > 0:
            draws[e] = draw_differences(std, df, n_baseline, n_noisy, rng, samples[0])
    percents = np.array([study.percent(e) for e in range(len(study.environments))])
    return summarize(study.environments, draws, percents)


def luck_of_paper(best, seeds, configurations):
    """Draw the paper's sweep from its table of best noises: a dict of what STUDY has -> Luck.

    The standard deviation is the baseline's. That of the best noise is known, too, but belongs to a
    winner, which had luck with its seeds.

    best: the table; seeds: algorithm -> seeds of each configuration, of which there are
    `configurations` in every environment.
    """
    lucks = {}
    for key, rows in best.groupby(STUDY):
        rng, n = np.random.default_rng(0), seeds[key[0]]
        draws = [
            draw_differences(std, n - 1, n, configurations * [n], rng)
            for std in rows["baseline_std"]
        ]
        percents = 100 / rows["baseline_mean"].abs().to_numpy()
        lucks[key] = summarize(list(rows["environment"]), np.stack(draws), percents)
    return lucks


def p_of_luck(draws, observed):
    """P(a draw is as high as `observed`), the observation counted as a draw: never zero.

    NaN where nothing was observed, because no environment has percentages, or nothing was drawn.
    """
    if np.isnan(observed) or np.isnan(draws).all():
        return np.nan
    return (1 + (draws >= observed).sum()) / (1 + len(draws))


def add_luck(lucks, best, good, bad):
    """Return the tables of best, consistent and consistently worse noise with p_luck, and of luck.

    p_luck is the probability that as many useless configurations show a best difference as high, a
    highest average improvement as high, or a lowest as low.

    lucks: a dict of what the columns STUDY have -> Luck.
    """
    best = add_luck_of_best(best, lucks)
    columns = [*STUDY, "average_improvement_percent"]
    p = [p_of_luck(lucks[*key].highest, value) for *key, value in good[columns].values]
    good = good.assign(p_luck=p)
    p = [p_of_luck(-lucks[*key].lowest, -value) for *key, value in bad[columns].values]
    bad = bad.assign(p_luck=p)
    luck = pd.DataFrame(luck_rows(lucks, best, good, bad), columns=COLUMNS)
    return best, good, bad, luck


def add_luck_of_best(best, lucks):
    """Add to a table of best noises what the best of as many useless configurations shows."""
    best = best.assign(luck_median=np.nan, luck_95=np.nan, p_luck=np.nan)
    for row in best.itertuples():
        draws = lucks[row.algorithm, row.exp_name, row.phase].best[row.environment]
        found = np.median(draws), np.quantile(draws, 0.95), p_of_luck(draws, row.difference)
        best.loc[row.Index, ["luck_median", "luck_95", "p_luck"]] = found
    return best


def luck_rows(lucks, best, good, bad):
    """Yield one row per study: what its tables have, and what they would have by luck."""
    for key, luck in lucks.items():
        p_best, p_good, p_bad = (
            table.loc[rows_of(table, key), "p_luck"] for table in (best, good, bad)
        )
        if len(p_best) == 0:
            continue
        values = [*key, len(p_best), (p_best <= LEVEL).sum(), luck.configurations]
        if luck.configurations:
            values += [*counts(p_good, luck.consistent), *counts(p_bad, luck.consistently_worse)]
        yield dict(zip(COLUMNS, values, strict=False))


def counts(p, draws):
    """Return the columns of one table in luck_rows: p_luck of its rows, and how many luck makes."""
    by_luck = draws.mean(), np.quantile(draws, 0.95), p_of_luck(draws, len(p))
    return len(p), *by_luck, (p <= LEVEL).sum()
