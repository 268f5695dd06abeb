"""Which way of testing PPO gives the paper's returns: the runs, the six ways and the verdicts.

paper_tests.py trains the runs, baselines.py shows the verdicts. All of it was fixed before any run:
PPO without noise on Hopper and Walker2d returns much less in the paper than here, on HalfCheetah
and Pusher it does not, and with noise the paper gains 89.6 % on Walker2d.
"""

import sys
from itertools import product
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from sweep.grid import best_pairs  # noqa: E402

# The statistics that normalize the observations of a test: those of training, frozen; the test
# environment's own, accumulated over all tests of a run; its own, begun anew in each test.
STATISTICS = ("training", "own", "own_per_test")
ACTIONS = ("mean", "sampled")
WAYS = tuple(f"{statistics}-{actions}" for statistics, actions in product(STATISTICS, ACTIONS))
COMPARED = ("Hopper", "Walker2d")  # with and without noise
CONTROLS = ("HalfCheetah", "Pusher")  # without noise
SEEDS, CONTROL_SEEDS = range(1, 11), range(1, 6)
GAINING = "Walker2d"  # where the paper's gain is to be reproduced
LEVEL = 0.05 / len(WAYS)  # of every test and interval: Bonferroni's correction for the six ways
NEAR = 2  # standard errors between a baseline and the paper's


def planned_runs():
    """Return (env_id, noise, noise_rate, seed) of every run, seed 1 of everything first.

    noise and noise_rate are tuples, as in the script's Args; the noise is the paper's best for PPO
    in that environment.
    """
    runs = []
    for seed in SEEDS:
        for name in COMPARED:
            noise, rate = best_pairs()["ppo", name]
            runs.append((f"{name}-v5", (), (), seed))
            runs.append((f"{name}-v5", (noise,), (rate,), seed))
        if seed in CONTROL_SEEDS:
            runs += [(f"{name}-v5", (), (), seed) for name in CONTROLS]
    return runs


def from_paper(returns, paper):
    """Compare returns (n) with the paper's (mean, standard deviation, n) -> difference in SE, p.

    Welch's test, two-sided.
    """
    mean, std, n = paper
    t, p = stats.ttest_ind_from_stats(
        np.mean(returns), np.std(returns, ddof=1), len(returns), mean, std, n, equal_var=False
    )
    return t, p


def p_of_gain(noisy, baseline, percent):
    """Return p of "noise changes the mean by `percent` of the baseline's", by Welch's test.

    noisy (n), baseline (m). The gains with p >= 0.05 are the 95 % interval of the ratio of the two
    means (Fieller's, with Welch's degrees of freedom), which need not be bounded.
    """
    return stats.ttest_ind(noisy, (1 + percent / 100) * baseline, equal_var=False).pvalue


def verdict(baselines, controls, gain, p_no_gain, p_paper_gain):
    """Return "reproduces", "excluded" or "not excluded" for one way of testing.

    baselines, controls: lists of (difference from the paper in standard errors, p); gain: ours in
    percent; p_no_gain, p_paper_gain: of p_of_gain. "Excluded" is a way that differs from the paper
    anywhere with p below LEVEL. "Reproduces" takes more: every return within NEAR standard errors,
    and a gain that is positive beyond chance at LEVEL and may be the paper's.
    """
    returns = [*baselines, *controls]
    if min(p_paper_gain, *(p for _, p in returns)) < LEVEL:
        return "excluded"
    near = all(abs(difference) <= NEAR for difference, _ in returns)
    return "reproduces" if near and gain > 0 and p_no_gain < LEVEL else "not excluded"
