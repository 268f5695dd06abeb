"""How often does `./benchmark.sh choose` find and confirm a noise that helps?

    python tools/simulate_choose.py

prints the table of docs/sweeps.md, in about two minutes. In each simulated choice one noise has a
true gain and all others do nothing. Gains are in standard deviations of the final return over
seeds. Returns are normal, or a fifth of the runs end far above the others.
"""

import argparse
import sys
from math import ceil
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from analysis.statistics import mann_whitney_null  # noqa: E402
from sweep.halving import LEVEL, schedule  # noqa: E402

TRIALS = 20_000
GAINS = [1.0, 1.5, 2.0]


def normal(rng, shape):
    """Draw returns with mean 0 and standard deviation 1."""
    return rng.standard_normal(shape)


def two_peaked(rng, shape):
    """Draw returns, a fifth of them around a peak 4 widths above the other: mean 0, deviation 1."""
    returns = rng.standard_normal(shape) + 4 * (rng.random(shape) < 0.2)
    return (returns - 4 * 0.2) / np.sqrt(1 + 4**2 * 0.2 * 0.8)


def equal_shares(noises, budget):
    """Return the schedule of Karnin et al., whose rounds share the budget equally."""
    rounds = schedule(noises, budget)
    return [(n, max(1, budget // (len(rounds) * n))) for n, _ in rounds]


def search(returns, sizes):
    """Return the noise that wins every search (trials,), by the rule of halving.advance.

    returns (trials, noises, seeds); sizes: the schedule [(noises, further seeds)].
    """
    trials, noises, _ = returns.shape
    alive = np.tile(np.arange(noises), (trials, 1))
    last_seed = 0
    for n, further in sizes:
        last_seed += further
        means = np.take_along_axis(returns[..., :last_seed].mean(axis=2), alive, axis=1)
        best = np.argsort(-means, axis=1, kind="stable")[:, : ceil(n / 2)]
        alive = np.take_along_axis(alive, np.sort(best, axis=1), axis=1)
    return alive[:, 0]


def confirmed(noisy, baseline):
    """Return which comparisons show a gain: the exact two-sided Mann-Whitney test, no ties.

    noisy, baseline (trials, seeds) -> (trials,) of bool.
    """
    n, m = noisy.shape[1], baseline.shape[1]
    losses = (noisy[:, :, None] < baseline[:, None, :]).sum(axis=(1, 2))
    p = 2 * np.cumsum(mann_whitney_null(n, m))[losses]
    return (p <= LEVEL) & (losses < n * m / 2)


def simulate(noises, sizes, confirm, gain, draw=normal, trials=TRIALS):
    """Return the shares of choices that find the good noise, that confirm it, that claim any."""
    rng = np.random.default_rng(0)
    seeds = sum(further for _, further in sizes)
    good, claims = [], []
    for _ in range(ceil(trials / 1000)):  # 1,000 at a time, to save memory
        returns = draw(rng, (1000, noises, seeds))
        returns[:, 0] += gain
        found = search(returns, sizes) == 0
        fresh = draw(rng, (1000, confirm)) + gain * found[:, None]
        good.append(found)
        claims.append(confirmed(fresh, draw(rng, (1000, confirm))))
    good, claims = np.concatenate(good), np.concatenate(claims)
    return good.mean(), (good & claims).mean(), claims.mean()


def row(noises, rounds, sizes, confirm):
    """Return a line of the table."""
    runs = sum(n * further for n, further in sizes) + 2 * confirm
    found, *shares = simulate(noises, sizes, confirm, GAINS[0])[:2]
    shares += [simulate(noises, sizes, confirm, gain)[1] for gain in GAINS[1:]]
    shares.append(simulate(noises, sizes, confirm, GAINS[0], two_peaked)[1])
    false = max(simulate(noises, sizes, confirm, 0, draw)[2] for draw in (normal, two_peaked))
    cells = [noises, rounds, confirm, runs, *(f"{share:.2f}" for share in (found, *shares))]
    return f"| {' | '.join(map(str, cells))} | {100 * false:.1f} % |"


def main():
    """Print the table."""
    raw = argparse.RawDescriptionHelpFormatter
    argparse.ArgumentParser(description=__doc__, formatter_class=raw).parse_args()
    print(
        "| noises | runs of a round | fresh seeds | runs in all | found, +1 sd | confirmed, +1 sd "
        "| +1.5 sd | +2 sd | two peaks, +1 sd | false claims |"
    )
    print("|" + 10 * "---|")
    for noises in (90, 16, 10, 4, 1):
        print(row(noises, "equal", equal_shares(noises, 3 * noises), 10))
        if noises == 90:
            print(row(noises, "equal", equal_shares(noises, 2 * noises), 25))
        print(row(noises, "√noises", schedule(noises, 3 * noises), 25), flush=True)


if __name__ == "__main__":
    main()
