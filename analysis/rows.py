"""The rows of analyze.py's tables, made of the final returns and the curves of a Study."""

from itertools import product

import numpy as np

from analysis.runs import KEYS, STUDY, rows_of
from analysis.statistics import (
    MIN_SEEDS,
    bootstrap_iqm,
    contrast,
    detectable_percent,
    improvement_percent,
    leave_one_seed_out,
    mann_whitney,
    mean_std,
    probability_of_improvement,
    seeds_for,
    steps_to_reach,
)
from noisy_wrappers import BASELINE


def row_keys(study, environment, config):
    """Return the columns that say what a row is about."""
    return dict(zip(KEYS, (*study.key, environment, config.noise, config.noise_rate), strict=True))


def summary_rows(study):
    """Yield the final mean and std of every configuration, against the baseline of its env."""
    for (e, env), config in product(enumerate(study.environments), study.returns):
        mean, std, n = mean_std(study.final(config)[:, e])
        if n == 0:
            continue
        base_mean, base_std, base_n = mean_std(study.final(BASELINE)[:, e])
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
            row["improvement_percent"] = improvement_percent(mean, base_mean)
            row["std_change_percent"] = improvement_percent(std, base_std)
        curves = study.returns[config][..., e]
        row["steps_to_baseline"] = steps_to_reach(curves, study.steps, base_mean)
        yield row


def best_rows(study, summary):
    """Yield the best noise per environment, with the leave-one-seed-out value of choosing it."""
    noisy = summary[summary["improvement_percent"].notna()]
    for env, group in noisy[rows_of(noisy, study.key)].groupby("environment"):
        best = group.loc[group["mean"].idxmax()]
        e = study.environments.index(env)
        finals = np.stack([study.final(c)[:, e] for c in study.returns if c != BASELINE])
        held_out = leave_one_seed_out(finals)
        yield best.to_dict() | {
            "noisy_mean": best["mean"],
            "noisy_std": best["std"],
            "chosen_from": len(group),
            "leave_one_seed_out_mean": held_out,
            "leave_one_seed_out_percent": improvement_percent(held_out, best["baseline_mean"]),
        }


def consistency_rows(summary):
    """Yield per noise and rate the share of envs that are matched or better, and by how much."""
    keys = [*STUDY, "noise", "noise_rate"]
    for key, group in summary[summary["improvement_percent"].notna()].groupby(keys):
        mean, std, count = mean_std(group["improvement_percent"])
        yield dict(zip(keys, key, strict=True)) | {
            "percent_of_environments": 100 * (group["improvement_percent"] >= 0).mean(),
            "average_improvement_percent": mean,
            "std_improvement_percent": std,
            "environments": count,
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
    """Yield IQM, improvement, probability of improvement and test, per env and over all.

    The scope of a row is "environment", or "all": of those with both kinds of runs.
    """
    places = [("environment", env, [e]) for e, env in enumerate(study.environments)]
    if study.phase != "confirmation":  # there each environment has its one comparison
        places.append(("all", "", list(range(len(study.environments)))))
    for (scope, environment, chosen), config in product(places, study.returns):
        x, y = study.final(config)[:, chosen], study.final(BASELINE)[:, chosen]
        here = np.isfinite(x).any(axis=0)
        both = here & np.isfinite(y).any(axis=0)
        row = row_keys(study, environment, config) | {"scope": scope}
        if scope == "all":
            if config == BASELINE or both.sum() < 2:
                continue
        elif not here.any():
            continue
        else:  # returns of different environments have no common scale
            row["n"] = np.isfinite(x).sum()
            row["iqm"], row["iqm_low"], row["iqm_high"] = bootstrap_iqm(x)
        if config != BASELINE and both.any():
            row |= against_baseline(x[:, both], y[:, both])
        yield row


def against_baseline(x, y):
    """Return the part of a row of statistics that compares x with y, both (seeds x envs)."""
    improvement, improvement_low, improvement_high = bootstrap_iqm(x, y)
    probability, probability_low, probability_high = probability_of_improvement(x, y)
    p, smallest_p = mann_whitney(x, y)
    row = {
        "environments": x.shape[1],
        "n": np.isfinite(x).sum(axis=0).min(),
        "n_baseline": np.isfinite(y).sum(axis=0).min(),
        "n_baseline_most": np.isfinite(y).sum(axis=0).max(),
        "improvement_iqm_percent": improvement,
        "improvement_low": improvement_low,
        "improvement_high": improvement_high,
        "probability_of_improvement": probability,
        "probability_low": probability_low,
        "probability_high": probability_high,
        "p": p,
        "smallest_p": smallest_p,
    }
    if x.shape[1] == 1:
        row["detectable_percent"] = detectable_percent(x[:, 0], y[:, 0])
        row["seeds_needed"] = seeds_for(x[:, 0], y[:, 0], improvement)
    return row


def interaction_rows(study):
    """Yield, for two noises and both together: how much more do they change than their sum?

    I = J(A + B) - J(A) - J(B) + J(0) of the mean final returns, in every environment where all
    four have at least MIN_SEEDS seeds, with a 95 % interval; then relative to |J(0)|.
    """
    for (e, environment), config in product(enumerate(study.environments), study.returns):
        parts = config.parts
        if len(parts) != 2 or parts[0] == parts[1]:
            continue
        cells = []
        for part in (config, *parts, BASELINE):
            finals = study.final(part)[:, e] if part in study.returns else np.empty(0)
            cells.append(finals[np.isfinite(finals)])
        if min(map(len, cells)) < MIN_SEEDS:
            continue
        both, first, second, alone = cells
        value, error, low, high = contrast(cells, [1, -1, -1, 1])
        percent = 100 / abs(alone.mean()) if alone.mean() else np.nan
        yield {
            **row_keys(study, environment, config),
            "n": min(map(len, cells)),
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
