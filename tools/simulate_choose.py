"""How often does `./benchmark.sh choose` find and confirm a noise that helps?

    python tools/simulate_choose.py               # about half an hour on one core
    python tools/simulate_choose.py --trials 200  # a first impression

prints tables of docs/statistics.md. Every simulated choice is made by halving.advance and judged
by halving.judge, as those of real runs are; only the returns are drawn, and the test divides them
in 9,999 ways instead of 99,999. In each choice one noise has a true gain and all others do nothing.
Gains are in standard deviations of the return over seeds.

Returns are drawn from made shapes, or from our own: those of the runs without noise in
results/data, drawn again.
"""

import argparse
import sys
from collections import defaultdict
from functools import cache, partial
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
from tabulate import tabulate

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from analysis import folders, permutation, statistics  # noqa: E402
from noisy_wrappers import BASELINE, Configuration  # noqa: E402
from sweep import halving, looks  # noqa: E402
from sweep.grid import MOST_BASELINES  # noqa: E402

GAINS = (0.5, 0.75, 1.0, 1.5, 2.0)
SPREADS = (1, 0.5, 2, 0.1)  # with noise, in those without
FEWEST = 10  # seeds of a shape of our own
PARTITIONS = 9_999  # of a test
ALL_PARTITIONS = cache(permutation.partitions.__wrapped__)  # those of all looks are kept
FIXED, FIVE = (looks.Plan(looks.looks_after(25, number), statistics.LEVEL) for number in (1, 5))


def two_peaks(rng, shape, height, share):
    """Draw returns, a share of them `height` widths above the others: mean 0, deviation 1."""
    returns = rng.standard_normal(shape) + height * (rng.random(shape) < share)
    return (returns - height * share) / np.sqrt(1 + height**2 * share * (1 - share))


def lopsided(rng, shape):
    """Draw returns with a long tail upwards (exponential): mean 0, deviation 1."""
    return rng.standard_exponential(shape) - 1


normal = np.random.Generator.standard_normal  # of a generator and a shape, as the others
high_peak = partial(two_peaks, height=4, share=0.2)
failing = partial(two_peaks, height=-4, share=0.3)
rare_peak = partial(two_peaks, height=6, share=0.05)
DRAWS = {"normal": normal, "high peak": high_peak, "failing": failing, "lopsided": lopsided}
DRAWS["rare high peak"] = rare_peak


@cache
def our_own():
    """Return {name: draw} for the runs without noise in results/data, at least FEWEST of a kind."""
    returns = defaultdict(dict)
    for path in sorted((ROOT / "results/data").glob("*/baseline_*")):
        run = folders.read_run(path)
        steps = f"{run.total_timesteps:,} steps"
        key = f"{run.algorithm} on {run.environment}, {steps}"
        value = statistics.final_value(run.curve.steps, run.curve.returns)
        returns[key].setdefault(round(value, 6), value)  # some folders share runs
    samples = {key: np.array(list(values)) for key, values in returns.items()}
    return {
        key: partial(draw_again, values=(values - values.mean()) / values.std())
        for key, values in sorted(samples.items())
        if len(values) >= FEWEST
    }


def shapes():
    """Return all shapes of returns: {name: draw}."""
    return DRAWS | our_own()


def draw_again(rng, shape, values):
    """Draw from values with replacement."""
    return rng.choice(values, shape)


NOISES = [Configuration.parse("noise", i) for i in range(90)]


def choose(noises, plan, draw_return):
    """Make a choice to its end, with the returns that are drawn; return its state, and these."""
    returns = {}
    while True:
        state = halving.advance(NOISES[:noises], 3 * noises, plan, returns)
        if not state.due:
            return state, returns
        for noise, seed in state.due:
            returns[noise, seed] = draw_return(noise)


# For advance, which tests the earlier looks again whenever it is asked
permutation_t = cache(permutation.permutation_t)


def simulate(noises, plan, gain, draw=normal, spread=1.0, trials=1000, seed=0):
    """Return the shares of choices that find the good noise, confirm it, claim any; their runs.

    The first noise has the gain, and returns with noise deviate `spread` times as much.
    """
    rng, sums = np.random.default_rng(seed), np.zeros(4)

    def draw_return(noise):
        value = float(draw(rng, ()))
        return value if noise == BASELINE else spread * value + gain * (noise == NOISES[0])

    fewer = {"RANDOM_PARTITIONS": PARTITIONS, "partitions": ALL_PARTITIONS}
    kept = mock.patch.object(looks, "permutation_t", permutation_t)
    with mock.patch.multiple(permutation, **fewer), kept:
        for _ in range(trials):
            permutation_t.cache_clear()
            state, returns = choose(noises, plan, draw_return)
            claims = halving.judge(state, plan, returns).helps
            found = state.candidates == NOISES[:1]
            sums += found, found and claims, claims, len(returns)
    return sums / trials


def level(n, m, draw, spread, trials=4000, seed=0):
    """Return how often a test of n seeds with noise against m without claims an effect of none."""
    rng = np.random.default_rng(seed)
    noisy, baseline = spread * draw(rng, (n, trials)), draw(rng, (m, trials))
    chosen = permutation.partitions(n, m)
    if len(chosen) > 2000:
        chosen = permutation.random_partitions(n, m, 1999, rng)
    ts = [
        permutation.welch_t(np.concatenate([noisy, baseline])[:, part], chosen)
        for part in np.array_split(np.arange(trials), 20)
    ]
    shares = [permutation.tails(t) for t in ts]
    p = np.concatenate([2 * np.minimum(above, below) for above, below in shares])
    return np.mean(p <= statistics.LEVEL)


def print_table(head, rows):
    """Print a table in Markdown."""
    print(tabulate(rows, head, "pipe", disable_numparse=True), end="\n\n", flush=True)


def main():
    """Print the tables."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--trials", type=int, default=2000)
    tables = dict(enumerate((power_of_a_confirmation, false_claims, whole_choices, levels), 1))
    parser.add_argument("--tables", nargs="+", type=int, choices=tables, default=tables)
    args = parser.parse_args()
    for number in args.tables:
        tables[number](args.trials)


def power_of_a_confirmation(trials):
    """Print the first table."""
    print("Power of a confirmation of one noise, and runs of at most 50\n")
    columns = [f"{what}, +{gain:g} sd" for gain in (0, *GAINS) for what in ("shown", "runs")]
    rows = []
    for (name, draw), (design, plan) in product(
        shapes().items(), (("1 look", FIXED), ("5 looks", FIVE))
    ):
        cells = [simulate(1, plan, gain, draw, trials=trials) for gain in (0, *GAINS)]
        texts = [text for cell in cells for text in (f"{cell[2]:.3f}", f"{cell[3]:.0f}")]
        rows.append((name, design, *texts))
    print_table(("returns", "design", *columns), rows)


def false_claims(trials):
    """Print the second table."""
    print("False claims that a noise helps, by the spread with noise, in percent; 5 looks\n")
    rows = []
    for name, draw in shapes().items():
        claims = [simulate(1, FIVE, 0, draw, spread, 2 * trials)[2] for spread in SPREADS]
        rows.append((name, *(f"{100 * share:.1f}" for share in claims)))
    print_table(("returns", *(f"x {spread:g}" for spread in SPREADS)), rows)


def whole_choices(trials):
    """Print the third table."""
    print("Search and confirmation: found, confirmed, and runs\n")
    rows = []
    for noises, (name, draw) in product((22, 90, 10, 4), list(DRAWS.items())[:3]):
        cells = [simulate(noises, FIVE, gain, draw, trials=trials // 2) for gain in (0, *GAINS)]
        texts = [f"{x[0]:.2f}, {x[1]:.2f}, {x[3]:.0f}" for x in cells]
        rows.append((noises, name, *texts))
    print_table(("configurations", "returns", *(f"+{gain:g} sd" for gain in (0, *GAINS))), rows)


def levels(trials):
    """Print the fourth table."""
    print("Level of one test, in percent, by the spread with noise: the worst shape\n")
    left_out = f"PPO on HalfCheetah-v5, {1_000_000:,} steps"  # 28 % whatever the numbers
    kept = {name: draw for name, draw in shapes().items() if name != left_out}
    rows = []
    for n, m in ((5, 5), (5, 8), (5, 13), (10, 10), (10, 26), (30, 13), (30, 30)):
        worst = [
            max(level(n, m, draw, spread, 2 * trials) for draw in kept.values())
            for spread in SPREADS
        ]
        rows.append((f"{n} + {m}", *(f"{100 * share:.1f} %" for share in worst)))
    print_table(("seeds with noise + without", *(f"x {spread:g}" for spread in SPREADS)), rows)
    print(f"Sweeps take at most {MOST_BASELINES:g} times as many seeds without noise.")


if __name__ == "__main__":
    main()
