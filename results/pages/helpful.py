"""Our runs with the noises that the paper finds best.

The five comparisons of PPO with and without noise were fixed before the runs: seeds 1 to 10, and
one noise for each environment. Holm's method corrects p over these five. The seeds from 11 on are
analysed apart.
"""

from functools import cache

import numpy as np
import pandas as pd
from common import (
    FIXED_SEEDS,
    cells,
    compare_rows,
    markdown,
    sample,
    spell,
    standard_error,
    uncorrected,
    welch,
    welch_interval,
)
from paper_tables import kind
from scipy import stats

from analysis.luck import DRAWS
from analysis.paper import PAPER_SEEDS
from analysis.statistics import (
    LEVEL,
    holm,
    improvement_percent,
    mann_whitney,
    mann_whitney_null,
    wins,
)

FRESH_SEEDS = range(11, 31)
CHEETAH_SEEDS = range(11, 51)
FAR_ABOVE = 3000  # of PPO on HalfCheetah; chosen after seeds 1 to 10 were seen
NEAR_THE_REST = 1800  # chosen after all seeds were seen
TRIALS = 400_000  # of a power
ENDING = "RandomEarlyTermination(50)"
TRUNCATING = "RandomEarlyTermination(50, truncate=True)"
ENDING_ANYWHERE = "RandomEarlyTermination(1, 100)"


def fixed_beforehand(runs, chosen):
    """Keep the runs of the comparisons that were fixed beforehand.

    They are those of FIXED_SEEDS without noise, and with a noise of `chosen`, a list of
    (environment, noise, noise_rate).
    """
    configs = zip(runs["environment"], runs["noise"], runs["noise_rate"], strict=True)
    wanted = np.array([config in chosen or config[1] == "" for config in configs], bool)
    return runs[wanted & runs["seed"].isin(FIXED_SEEDS)]


def power(effect, std, n, other_std, other_n, level=LEVEL):
    """Probability that the exact Mann-Whitney test finds a shift of normal returns.

    With TRIALS samples its standard error is at most 0.0008.
    """
    return np.mean(drawn_p(effect, std, n, other_std, other_n) <= level)


@cache
def drawn_p(effect, std, n, other_std, other_n):
    """Draw the p of the exact Mann-Whitney test TRIALS times."""
    rng, p = np.random.default_rng(0), []
    below = np.cumsum(mann_whitney_null(n, other_n))
    for _ in range(TRIALS // 10_000):  # so many at a time, to save memory
        x = rng.normal(effect, std, (10_000, n))
        y = rng.normal(0, other_std, (10_000, other_n))
        won = (x[:, :, None] > y[:, None]).sum(axis=(1, 2))
        p.append(2 * below[np.minimum(won, n * other_n - won)])
    return np.concatenate(p)


def power_of_levene(ratio, n):
    """Probability that Brown and Forsythe's test finds this ratio of standard deviations at 5 %."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(0, ratio, (TRIALS, n)), rng.normal(0, 1, (TRIALS, n))
    return np.mean(stats.levene(x, y, center="median", axis=1).pvalue <= 0.05)


def improvements(table):
    """Return the columns of analyze.py's statistics that compare noise with the baseline."""
    iqm = [table[f"improvement_{name}"] for name in ("iqm_percent", "low", "high")]
    better = [table[f"probability_{name}"] for name in ("of_improvement", "low", "high")]
    return {
        "IQM [95 %]": cells("{:+.1f} % [{:.0f}, {:.0f}]", *iqm),
        "P(improvement) [95 %]": cells("{:.2f} [{:.2f}, {:.2f}]", *better),
    }


def five_noises(base, noisy, paper_base, paper_noisy, percent, statistics):
    """PPO with the paper's best noise of each environment against PPO without."""
    x, y = sample(noisy, "test"), sample(base, "test")
    names = x.index
    gain, paper_gain = x["mean"] - y["mean"], paper_noisy["mean"] - paper_base["mean"]
    error = standard_error(x, y, paper_noisy, paper_base)
    noise = noisy.groupby("environment")[["noise", "noise_rate"]].first()
    tested = statistics.set_index("environment").loc[names]
    low, high = welch_interval(x, y)
    found, strict = (
        [power(paper_gain[e], x["std"][e], x["n"][e], y["std"][e], y["n"][e], at) for e in names]
        for at in (LEVEL, LEVEL / len(names))
    )
    rewarding = [e for e in names if kind(noise["noise"][e]) == "reward"]
    with_reward_noise, without = (
        runs.pivot(index="seed", columns="environment", values="test")[rewarding]
        for runs in (noisy, base)
    )
    text = markdown(
        {
            "": names,
            "noise": cells("`{}`, p = {:g}", noise["noise"], noise["noise_rate"].astype(float)),
            "the paper": cells("{} ({:+.1f} %)", spell(paper_noisy), percent),
            "ours": cells("{} ({:+.1f} %)", spell(x), 100 * gain / y["mean"].abs()),
            **improvements(tested),
            "power (at 1 %)": cells("{:.2f} ({:.2f})", found, strict),
            "gains differ by SE": cells("{:+.1f}", (gain - paper_gain) / error),
            "p": tested["p"].to_numpy(float),
        }
    )
    corrected = holm(tested["p"].to_numpy(float))
    return {
        "table": text,
        "percent": (100 * gain / y["mean"].abs()).to_dict(),
        "low": (100 * low / y["mean"].abs()).to_dict(),
        "high": (100 * high / y["mean"].abs()).to_dict(),
        "n": x["n"].to_dict(),
        "gains": pd.DataFrame(
            {
                "noise": noise["noise"],
                "noise_rate": noise["noise_rate"],
                "paper_gain": paper_gain,
                "gain": gain,
                "gain_low": low,
                "gain_high": high,
            }
        ),
        "power_at_5": dict(zip(names, found, strict=True)),
        "paper_percent": percent.to_dict(),
        "p": tested["p"].to_dict(),
        "holm": dict(zip(names, corrected, strict=True)),
        "reward": {
            "won": sum(
                wins(with_reward_noise[e].to_numpy(), without[e].to_numpy()) for e in rewarding
            ),
            "pairs": sum(x["n"][e] * y["n"][e] for e in rewarding),
            "p": mann_whitney(with_reward_noise, without)[0],
        },
    }


def spread(base, noisy, paper_base, paper_noisy):
    """PPO's standard deviations over seeds with and without noise."""
    x, y = sample(noisy, "test"), sample(base, "test")
    p = [
        stats.levene(a, b, center="median").pvalue
        for a, b in zip(
            noisy.groupby("environment")["test"].agg(list),
            base.groupby("environment")["test"].agg(list),
            strict=True,
        )
    ]
    return {
        "change": (100 * (x["std"] / y["std"] - 1)).to_dict(),
        "p": dict(zip(x.index, p, strict=True)),
        "holm": dict(zip(x.index, holm(np.array(p)), strict=True)),
        "n": len(FIXED_SEEDS),
        "power": power_of_levene(0.5, len(FIXED_SEEDS)),
        "table": pd.DataFrame(
            {
                "std_without": y["std"],
                "std_with": x["std"],
                "paper_std_without": paper_base["std"],
                "paper_std_with": paper_noisy["std"],
                "brown_forsythe_p": p,
                "brown_forsythe_p_holm": holm(np.array(p)),
            }
        ),
    }


def speed(summary):
    """The first test at which PPO's mean over seeds is at the baseline's final mean."""
    start = summary[summary["noise"] == ""].set_index("environment")["steps_to_baseline"]
    noisy = summary[summary["noise"] != ""].set_index("environment")["steps_to_baseline"]
    return {"without": start.to_dict(), "with": noisy.to_dict()}


def pusher(runs):
    """PPO on Pusher with early termination: the fixed seeds, the fresh ones, and truncation."""
    runs = runs.query("environment == 'Pusher' and noise_rate in ('0.00', '1.00')")
    returns = {
        noise: group.set_index("seed")["test"].sort_index()
        for noise, group in runs.groupby("noise")
    }

    def seeds(noise, wanted):
        found = returns.get(noise, pd.Series(dtype=float))
        return found[found.index.isin(list(wanted))]

    both = [*FIXED_SEEDS, *FRESH_SEEDS]
    cases = [
        ("terminated at 50, none: seeds 1 to 10", ENDING, "", FIXED_SEEDS, "fixed"),
        ("terminated at 50, none: fresh seeds 11 to 30", ENDING, "", FRESH_SEEDS, "fresh"),
        ("terminated at 50, none: all 30 seeds", ENDING, "", both, "all"),
        ("truncated at 50, none: seeds 1 to 20", TRUNCATING, "", range(1, 21), "truncated"),
        ("truncated, terminated at 50: seeds 1 to 20", TRUNCATING, ENDING, range(1, 21), "ways"),
    ]
    rows, numbers = [], {}
    for name, first, second, wanted, key in cases:
        x, y = seeds(first, wanted), seeds(second, wanted)
        if len(x) == len(y) == len(wanted):
            row, numbers[key] = compare_rows(name, x, y)
            rows.append(row)
    x, y = seeds(ENDING, FIXED_SEEDS), seeds("", FIXED_SEEDS)
    gain, n = x.mean() - y.mean(), len(FRESH_SEEDS)
    return {
        "table": uncorrected(rows),
        **pd.DataFrame(numbers).T.to_dict(),  # {"p": {"fixed": ...}, "percent": ..., "low": ...}
        "power": power(gain, x.std(), n, y.std(), n),
        "power_half": power(gain / 2, x.std(), n, y.std(), n),
    }


def other_step(searched, runs):
    """Compare PPO on Pusher when episodes end at a random step with their end at step 50.

    searched: the runs of choice/; runs: those of runs/. Both ways with the same seeds.
    """
    anywhere = searched.query("noise == @ENDING_ANYWHERE").set_index("seed")["test"]
    ending = runs.query("environment == 'Pusher' and noise == @ENDING and noise_rate == '1.00'")
    ending = ending.set_index("seed")["test"].loc[anywhere.index]
    return compare_rows("", anywhere, ending)[1] | {"n": len(anywhere)}


def half_cheetah(runs, paper_percent):
    """PPO on HalfCheetah: how many runs end far above the rest, and what luck that makes.

    `luck`: in how many percent of the ways to take two sets of ten of all runs without noise the
    first is better by the paper's improvement, or more.
    """
    runs = runs.query("environment == 'HalfCheetah'")
    noisy = runs[runs["noise"].str.startswith("RandomUniformNoisyReward")]["test"]
    base = runs[runs["noise"] == ""].set_index("seed")["test"]
    fixed, fresh = (base[base.index.isin(list(seeds))] for seeds in (FIXED_SEEDS, CHEETAH_SEEDS))
    low = fixed[fixed <= FAR_ABOVE]
    rest = pd.concat([low, noisy])
    between = sorted(fresh[(fresh > rest.max()) & (fresh <= FAR_ABOVE)])
    rng = np.random.default_rng(0)
    draws = rng.permuted(np.tile(base, (DRAWS, 1)), axis=1)
    first, second = draws[:, :10].mean(axis=1), draws[:, 10:20].mean(axis=1)
    better = improvement_percent(first, second) >= paper_percent
    return {
        "n": len(base),
        "fixed": far_above(fixed),
        "fresh": far_above(fresh),
        "tops": sorted(fixed[fixed > FAR_ABOVE]),
        "rest": [rest.min(), rest.max()],
        "between": len(between),
        "just_above": [value for value in between if value < NEAR_THE_REST],
        "percent_of_rest": improvement_percent(noisy.mean(), low.mean()),
        "all": compare_rows("", noisy, base)[1],
        "luck": 100 * better.mean(),
    }


def far_above(returns):
    """How many of the returns are above FAR_ABOVE, with the exact interval of their share."""
    count = int((returns > FAR_ABOVE).sum())
    low, high = stats.binomtest(count, len(returns)).proportion_ci(method="exact")
    return {"count": count, "of": len(returns), "low": 100 * low, "high": 100 * high}


def sac(early, statistics):
    """SAC on HalfCheetah after 200,000 steps, ours and the paper's."""
    early = early.query("algorithm == 'SAC' and steps_millions == 0.2 and n.notna()")
    tested = statistics.query("algorithm == 'SAC'").set_index("noise_rate")
    tested = tested.loc[early["noise_rate"]]
    ours = early[["mean", "std", "n"]].astype(float)
    paper = early[["paper_mean", "paper_std"]].set_axis(["mean", "std"], axis=1)
    errors, p = welch(ours, paper.assign(n=PAPER_SEEDS["SAC"]))
    noisy = tested[tested["p"].notna()]
    text = markdown(
        {
            "noise rate": early["noise_rate"],
            "n": cells("{:.0f}", ours["n"]),
            "ours, v5": spell(ours),
            "the paper, v2": spell(paper),
            **improvements(tested),
            "p (exact)": cells("{:.2g}", tested["p"]),
            "difference from the paper in SE": cells("{:+.1f} (p = {:.2g})", errors, p),
        }
    )
    return {
        "table": text,
        "p": noisy["p"].to_dict(),
        "percent": noisy["improvement_iqm_percent"].to_dict(),
        "low": noisy["improvement_low"].to_dict(),
        "high": noisy["improvement_high"].to_dict(),
        "n": noisy["n"].to_dict(),
        "finds": noisy["detectable_percent"].to_dict(),
    }
