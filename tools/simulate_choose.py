"""How often does `./benchmark.sh choose` find and confirm a noise that helps?

    python tools/simulate_choose.py

prints the tables of docs/sweeps.md, in about three minutes. In each simulated choice one noise has
a true gain and all others do nothing. Gains are in standard deviations of the final return over
seeds. Returns are normal, or a fifth of the runs end far above the others ("high peak"), or three
in ten far below ("failing").
"""

import argparse
import sys
from functools import partial
from math import ceil
from pathlib import Path

import numpy as np
from tabulate import tabulate

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from analysis.statistics import random_partitions, tails, welch_t  # noqa: E402
from sweep.halving import LEVEL, schedule  # noqa: E402

TRIALS = 20_000
GAINS = (1.0, 1.5, 2.0)
PARTITIONS = 999  # of a test; the real one has a hundred times as many


def two_peaks(rng, shape, height, share):
    """Draw returns, a share of them `height` widths above the others: mean 0, deviation 1."""
    returns = rng.standard_normal(shape) + height * (rng.random(shape) < share)
    return (returns - height * share) / np.sqrt(1 + height**2 * share * (1 - share))


normal = np.random.Generator.standard_normal  # of a generator and a shape, as the others
high_peak = partial(two_peaks, height=4, share=0.2)
failing = partial(two_peaks, height=-4, share=0.3)
DRAWS = {"normal": normal, "high peak": high_peak, "failing": failing}


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


def confirmed(noisy, baseline, rng):
    """Return which comparisons show a gain, by the permutation test of halving.compare.

    noisy, baseline (trials, seeds) -> (trials,) of bool.
    """
    chosen = random_partitions(noisy.shape[1], baseline.shape[1], PARTITIONS, rng)
    above, _ = tails(welch_t(np.concatenate([noisy, baseline], axis=1).T, chosen))
    return 2 * above <= LEVEL


def simulate(noises, sizes, confirm, gain, draw=normal, spread=1.0, trials=TRIALS):
    """Return the shares of choices that find the good noise, that confirm it, that claim any.

    With noise, returns have `spread` standard deviations of those without.
    """
    rng = np.random.default_rng(0)
    seeds = sum(further for _, further in sizes)
    good, claims = [], []
    for _ in range(ceil(trials / 1000)):  # 1,000 at a time, to save memory
        returns = spread * draw(rng, (1000, noises, seeds))
        returns[:, 0] += gain
        found = search(returns, sizes) == 0
        fresh = spread * draw(rng, (1000, confirm)) + gain * found[:, None]
        good.append(found)
        claims.append(confirmed(fresh, draw(rng, (1000, confirm)), rng))
    good, claims = np.concatenate(good), np.concatenate(claims)
    return good.mean(), (good & claims).mean(), claims.mean()


def print_table(head, rows):
    """Print a table in Markdown."""
    print(tabulate(rows, head, "pipe", disable_numparse=True), end="\n\n", flush=True)


def power(noises, sizes, confirm, draw=normal):
    """Return what is found, and what is confirmed, at each gain: texts for a table."""
    shares = [simulate(noises, sizes, confirm, gain, draw)[:2] for gain in GAINS]
    return [f"{share:.2f}" for pair in shares for share in pair]


def main():
    """Print the tables."""
    raw = argparse.RawDescriptionHelpFormatter
    argparse.ArgumentParser(description=__doc__, formatter_class=raw).parse_args()
    columns = [f"{what}, +{gain:g} sd" for gain in GAINS for what in ("found", "confirmed")]
    rows = [
        (n, name, *power(n, schedule(n, 3 * n), 25, draw))
        for n in (20, 90, 10, 4, 1)
        for name, draw in DRAWS.items()
    ]
    print_table(("noises", "returns", *columns), rows)
    rows = []
    for name, draw in DRAWS.items():
        claims = [simulate(1, [], 25, 0, draw, spread)[2] for spread in (1, 0.5, 2)]
        rows.append((name, *(f"{100 * share:.1f} %" for share in claims)))
    print_table(("returns", "same spread", "spread halved", "spread doubled"), rows)
    designs = [("equal, 3", equal_shares(90, 270), 10), ("equal, 2", equal_shares(90, 180), 25)]
    designs += [("√noises, 3", schedule(90, 270), 25)]
    rows = [(name, confirm, *power(90, sizes, confirm)) for name, sizes, confirm in designs]
    print_table(("runs of a round", "fresh seeds", *columns), rows)


if __name__ == "__main__":
    main()
