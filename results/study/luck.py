"""What the test for luck sees where some runs without noise fail.

The test (luck.md) asks whether the best of 90 noises gains more than the best of 90 ineffective
ones would, if returns are normal with the baseline's mean and standard deviation. Runs that fail
raise that standard deviation, and a noise that prevents every failure can gain only so much.
"""

import numpy as np
import pandas as pd

NOISES = 90
STUDIES, DRAWS = 2_000, 10_000


def failures(shares=(0.1, 0.2, 0.3, 0.5), seeds=(5, 10)):
    """Return how often the best of 90 noises is beyond luck, where one prevents failures.

    A run fails with a probability of `shares` and returns 0; the others return 1 ± 0.1. The true
    gain of the one noise is given in percent, too, and in standard deviations of the baseline.
    """
    rows = []
    for share in shares:
        sd = np.sqrt(share * (1 - share) + (1 - share) * 0.1**2)
        row = {"runs that fail, %": round(100 * share), "gain, SD": round(share / sd, 2)}
        row["gain, %"] = round(100 * share / (1 - share))
        for n in seeds:
            row[f"beyond luck, {n} seeds, %"] = round(100 * detected(share, n), 1)
        rows.append(row)
    return pd.DataFrame(rows)


def detected(share, n):
    """Return the share of simulated studies with n seeds whose best noise is beyond luck."""
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((DRAWS, NOISES + 1))
    best, base = draws[:, 1:].max(axis=1), draws[:, 0]
    found = 0
    for _ in range(STUDIES):
        returns = rng.normal(1, 0.1, (NOISES + 1, n))
        returns[:-1] *= rng.random((NOISES, n)) >= share  # the last noise prevents failures
        mean, error = returns[0].mean(), returns[0].std(ddof=1) / np.sqrt(n)
        if mean <= 0:  # all fail
            continue
        gain = returns[1:].mean(axis=1).max() / mean - 1
        by_luck = (best - base) * error / abs(mean + base * error)
        found += np.mean(by_luck >= gain) <= 0.05
    return found / STUDIES
