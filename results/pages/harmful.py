"""Our runs with noises that the paper finds worse in every environment."""

import pandas as pd
from common import (
    ENVIRONMENTS,
    FEW_SEEDS,
    FIXED_SEEDS,
    by_environment,
    compare_rows,
    markdown,
    spell_average,
)

from analysis.statistics import contrast, detectable_percent, improvement_percent, mann_whitney

MIXUP = "RandomMixupObservation(0.0, recursive=True)"
PLAIN_MIXUP = "RandomMixupObservation(0.0)"
TD3_RATES = ("0.01", "1.00")  # the ends of the paper's
NORMAL = "RandomNormalNoisyObservation(1.0)"
# Noises of PPO at p = 1 that the paper finds worse everywhere, and mixup without a memory of the
# mixture beside: which of the two did the paper run?
WORSE = {
    NORMAL: ENVIRONMENTS,
    MIXUP: ENVIRONMENTS,
    PLAIN_MIXUP: ["HalfCheetah", "Pusher", "Walker2d"],
}


def worse_noises(runs, paper):
    """PPO with noises that the paper finds worse everywhere, against runs without noise.

    With noise there are FEW_SEEDS, without FIXED_SEEDS: as many in each environment, so that each
    has the same weight in the test.
    """
    theirs = paper["consistently_worse"].query("algorithm == 'PPO' and noise_rate == '1.00'")
    theirs = theirs.set_index("noise")
    base = by_environment(runs[runs["noise"] == ""], FIXED_SEEDS)
    rows, found = [], {}
    for noise, environments in WORSE.items():
        noisy = by_environment(runs.query("noise == @noise and noise_rate == '1.00'"), FEW_SEEDS)
        noisy, without = noisy[environments], base[environments]
        change = improvement_percent(noisy.mean(), without.mean())
        p, _ = mann_whitney(noisy, without)
        found[noise] = {"change": change.to_dict(), "average": change.mean(), "p": p}
        found[noise]["n"] = len(noisy)
        found[noise]["interval"] = average_interval(noisy, without)
        found[noise]["alone_interval"] = {
            e: average_interval(noisy[[e]], without[[e]]) for e in environments
        }
        found[noise]["lowest"] = list(change.index[noisy.max() < without.min()])
        found[noise]["alone"] = {e: mann_whitney(noisy[[e]], without[[e]])[0] for e in environments}
        found[noise]["finds"] = {e: detectable_percent(noisy[e], without[e]) for e in environments}
        row = {"noise": f"`{noise}`"} | {name: "\u2013" for name in ENVIRONMENTS}
        row |= {name: f"{value:+.0f} %" for name, value in change.items()}
        row["average"] = f"{change.mean():+.0f} ± {change.std(ddof=1):.0f} %"
        row["the paper"] = "\u2013"
        if noise in theirs.index:
            row["the paper"] = spell_average(theirs.loc[noise])
            found[noise]["paper"] = theirs.loc[noise, "average_improvement_percent"]
        rows.append(row | {"p (exact)": f"{p:.2g}"})
    return {"table": markdown(rows), **found}


def average_interval(noisy, without):
    """Return the 95 % interval of the change in percent, averaged over environments (columns)."""
    scale = 100 / without.mean().abs() / noisy.shape[1]
    samples = [table[name].to_numpy() for table in (noisy, without) for name in table]
    _, _, low, high = contrast(samples, [*scale, *-scale])
    return low, high


def td3(runs, paper):
    """TD3 on HalfCheetah with a noise that the paper finds worse everywhere at every rate."""
    theirs = paper["consistently_worse"].query("algorithm == 'TD3' and noise == @NORMAL")
    theirs = theirs.set_index("noise_rate")
    runs = runs.query("environment == 'HalfCheetah' and seed in @FEW_SEEDS")
    base = runs[runs["noise"] == ""]["test"]
    rows, found = [], {}
    for rate in TD3_RATES:
        noisy = runs.query("noise == @NORMAL and noise_rate == @rate")["test"]
        row, found[rate] = compare_rows(f"p = {float(rate):g}", noisy, base)
        rows.append(row | {"the paper": spell_average(theirs.loc[rate])})
    names = {"first": "with noise", "second": "without", "of the second": "change"}
    names["p"] = "p (exact)"
    table = markdown(pd.DataFrame(rows).rename(columns=names))
    return {"table": table, "rates": TD3_RATES, **found}
