"""What luck alone would show: a sweep in which no noise does anything, drawn many times.

The best of many configurations looks good although none is. Each draw makes the baseline and all
configurations anew, each with its own number of seeds, from one and the same distribution of final
returns. Keeping the baseline fixed would not do: a baseline that was unlucky is part of the luck.
"""

import numpy as np

from analysis.runs import STUDY
from analysis.statistics import contrast, pooled_std

DRAWS = 10_000
SEEDS_TO_RESAMPLE = 20  # with fewer seeds of the baseline, returns are taken as normal


def draw_differences(std, df, n_baseline, n_noisy, rng, seeds=()):
    """Draw the differences of configurations that do nothing from their baseline.

    The standard deviation `std` was estimated with `df` degrees of freedom, so each draw has its
    own, std sqrt(df / chi2_df). For a single configuration this is Student's t-test. Returns are
    normal, or have the shape of the baseline's `seeds` if there are SEEDS_TO_RESAMPLE or more.

    std, df, n_baseline: numbers; n_noisy (configs,) -> (configs x draws) in units of std.
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
    return np.array([spread * (mean_of(n) - baseline) for n in n_noisy])


def luck_of_studies(studies):
    """Draw the sweep of each Study again, with its numbers of seeds, as if no noise did anything.

    The spread is that of the baseline, of the best noise, and of all that are not clearly worse:
    one that ends training, or makes it diverge, does something, and has a spread of its own.

    Return {(*study.key, environment): the highest difference of each sweep (draws,)}, NaN where
    nothing was chosen, because one configuration or none was tried, where all tests have the same
    result, and where no spread is known.
    """
    lucks = {}
    for study in studies:
        rng, all_equal = np.random.default_rng(0), study.all_equal()
        for e, environment in enumerate(study.environments):
            samples = [study.sample(config, e) for config in study.finals]
            best = max(filter(len, samples[1:]), key=np.mean, default=None)
            kept = [s for s in samples if s is best or not clearly_worse(s, samples[0])]
            std, df = pooled_std(kept, study.episodes)
            n_baseline, *n_noisy = map(len, samples)
            tried = [n for n in n_noisy if n]
            best_draws = np.full(DRAWS, np.nan)
            known = n_baseline and df > 0 and std > 0
            if len(tried) > 1 and known and environment not in all_equal:
                draws = draw_differences(std, df, n_baseline, tried, rng, samples[0])
                best_draws = draws.max(axis=0)
            lucks[*study.key, environment] = best_draws
    return lucks


def clearly_worse(sample, baseline):
    """Tell whether the 95 % interval of the difference of two samples is below zero."""
    return len(sample) > 1 and len(baseline) > 1 and contrast([sample, baseline], [1, -1])[3] < 0


def p_of_luck(draws, observed):
    """P(a draw is as high as `observed`), the observation counted as a draw: never zero.

    NaN where nothing was drawn.
    """
    if np.isnan(draws).all():
        return np.nan
    return (1 + (draws >= observed).sum()) / (1 + len(draws))


def add_luck(best, lucks):
    """Add to a table of best noises what the best of as many useless configurations shows.

    lucks: of luck_of_studies.
    """
    best = best.assign(luck_median=np.nan, luck_95=np.nan, p_luck=np.nan)
    for row in best.itertuples():
        draws = lucks[tuple(getattr(row, name) for name in (*STUDY, "environment"))]
        found = np.median(draws), np.quantile(draws, 0.95), p_of_luck(draws, row.difference)
        best.loc[row.Index, ["luck_median", "luck_95", "p_luck"]] = found
    return best
