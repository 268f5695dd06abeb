"""Write results/README.md from the runs in data/: python results/pages/claims.py.

README.md.jinja has the text, this file every number in it. The five comparisons of PPO with and
without noise were fixed before the runs, with seeds 1 to 10 and one noise for each environment: so
p-values are corrected with Holm's method over them. The seeds from 11 on are analysed apart.
"""

import json

import ablation
import headline
import numpy as np
import pandas as pd
from common import (
    DATA,
    ENVIRONMENTS,
    RESULTS,
    cells,
    compare_rows,
    markdown,
    plain,
    read_returns,
    render,
    sample,
    spell,
    standard_error,
    uncorrected,
    welch,
    welch_interval,
)
from scipy import stats

from analysis.luck import (
    CONSISTENT_PERCENT,
    DRAWS,
    FALSE_ALARMS_IN_THE_PAPER,
    POWER_IN_THE_PAPER,
    draw_improvements,
    p_value,
)
from analysis.paper import PAPER_CONFIGURATIONS, PAPER_SEEDS, read_paper, with_luck
from analysis.runs import make_studies, read_runs
from analysis.statistics import (
    contrast,
    holm,
    improvement_percent,
    mann_whitney,
    mann_whitney_null,
    wins,
)
from analysis.tables import make_tables
from analysis.verdicts import power as finds
from noisy_wrappers import parse_noise

FIXED_SEEDS = range(1, 11)
FRESH_SEEDS = range(11, 31)
ENDING = "RandomEarlyTermination(50)"
TRUNCATING = "RandomEarlyTermination(50, truncate=True)"
ENDING_ANYWHERE = "RandomEarlyTermination(1, 100)"
MIXUP = "RandomMixupObservation(0.0, recursive=True)"
PLAIN_MIXUP = "RandomMixupObservation(0.0)"
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
NORMAL = "RandomNormalNoisyObservation(1.0)"
FEW_SEEDS = range(1, 6)
# Noises of PPO at p = 1 that the paper finds worse everywhere, and mixup without a memory of the
# mixture beside: which of the two did the paper run?
WORSE = {
    NORMAL: ENVIRONMENTS,
    MIXUP: ENVIRONMENTS,
    PLAIN_MIXUP: ["HalfCheetah", "Pusher", "Walker2d"],
}
RATES = [0.01, 0.05, 0.1, 0.2, 0.5, 1.0]
# The paper's 15 noises by what they perturb; its text calls early termination dynamics noise.
KINDS = {"observation": 8, "reward": 5, "dynamics": 2}

CHEETAH_SEEDS = range(11, 51)
NEAR_THE_REST = 1800  # chosen after all seeds were seen
TRIALS = 400_000  # of a power
MANY_DRAWS = 1_000_000  # of a small P
FAR_ABOVE = 3000  # of PPO on HalfCheetah; chosen after seeds 1 to 10 were seen


# ------------------------------------------------------------------------------------------ reading


def fixed_beforehand(runs, chosen):
    """Keep the runs of the comparisons that were fixed beforehand.

    They are those of FIXED_SEEDS without noise, and with a noise of `chosen`, a list of
    (environment, noise, noise_rate).
    """
    configs = zip(runs["environment"], runs["noise"], runs["noise_rate"], strict=True)
    wanted = np.array([config in chosen or config[1] == "" for config in configs], bool)
    return runs[wanted & runs["seed"].isin(FIXED_SEEDS)]


# --------------------------------------------------------------------------------------- statistics


def power(effect, std, n, other_std, other_n, level=0.05):
    """Probability that the exact Mann-Whitney test finds a shift of normal returns.

    With TRIALS samples its standard error is at most 0.0008.
    """
    rng, found = np.random.default_rng(0), 0
    below = np.cumsum(mann_whitney_null(n, other_n))
    for _ in range(TRIALS // 10_000):  # so many at a time, to save memory
        x = rng.normal(effect, std, (10_000, n))
        y = rng.normal(0, other_std, (10_000, other_n))
        won = (x[:, :, None] > y[:, None]).sum(axis=(1, 2))
        found += (2 * below[np.minimum(won, n * other_n - won)] <= level).sum()
    return found / TRIALS


def power_of_levene(ratio, n):
    """Probability that Brown and Forsythe's test finds this ratio of standard deviations at 5 %."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(0, ratio, (TRIALS, n)), rng.normal(0, 1, (TRIALS, n))
    return np.mean(stats.levene(x, y, center="median", axis=1).pvalue <= 0.05)


# ----------------------------------------------------------------------------------------- spelling


def spell_average(row):
    """Write a row of the paper's averages over environments: mean ± standard deviation."""
    average, std = row["average_improvement_percent"], row["std_improvement_percent"]
    return f"{average:+.0f} ± {std:.0f} %"


# ------------------------------------------------------------------------------- the paper's tables


def luck_of_the_best(paper):
    """The paper's best noises beside what the best of as many useless ones would show."""
    best = paper["best"]
    return {
        "table": markdown(
            {
                "": best["algorithm"] + ", " + best["environment"],
                "the paper's best noise": cells("`{}`, p = {}", best["noise"], best["noise_rate"]),
                "improvement": cells("{:+.1f} %", best["improvement_percent"]),
                "by luck: median": cells("{:+.1f} %", best["luck_median_percent"]),
                "95 %": cells("{:+.1f} %", best["luck_95_percent"]),
                "P(luck)": cells("{:.2f}", best["p_luck"]),
            }
        ),
        "p": best["p_luck"],
        "beyond": (best["p_luck"] <= 0.05).sum(),
        "rows": len(best),
        "improvement": best["improvement_percent"],
    }


def luck_with_the_winners_spread(paper):
    """P(luck) of the paper's best noises if useless noises had the spread of the winner.

    The baseline keeps its own. Both are known from few seeds, so each draw has its own.
    """
    rng, found = np.random.default_rng(0), []
    for row in paper["best"].itertuples():
        n = PAPER_SEEDS[row.algorithm]

        def drawn_std(std, df=n - 1):
            return std * np.sqrt(df / rng.chisquare(df, MANY_DRAWS) / (df + 1))  # of a mean of n

        baseline = drawn_std(row.baseline_std) * rng.standard_normal(MANY_DRAWS)
        # The best of many: its distribution function is that of one to the power of their number
        noisy = stats.norm.ppf(rng.random(MANY_DRAWS) ** (1 / PAPER_CONFIGURATIONS))
        noisy *= drawn_std(row.noisy_std)
        p = p_value(100 * (noisy - baseline) / abs(row.baseline_mean), row.improvement_percent)
        found.append((p, f"{row.algorithm} on {row.environment.split('-')[0]}"))
    (p, name), (second, _) = sorted(found)[:2]
    return {"p": p, "name": name, "second": second}


def luck_of_the_consistent(luck):
    """How many rows the paper's tables of consistent noise have, and would have by luck."""
    columns = {"": luck["algorithm"]}
    for name, title in (("consistent", "consistent"), ("consistently_worse", "worse everywhere")):
        columns |= {
            title: luck[name],
            f"{title}, by luck (95 %)": cells(
                "{:.0f} ({:.0f})", luck[f"{name}_by_luck"], luck[f"{name}_by_luck_95"]
            ),
            f"{title}, P(luck)": cells("{:.2g}", luck[f"p_{name}"]),
            f"{title}, rows beyond luck": luck[f"{name}_beyond_luck"],
        }
    by = luck.set_index("algorithm")
    return {"table": markdown(columns), "by": by.to_dict("index")}


def rates(paper):
    """How often p = 1 is the best rate, consistent, or worse everywhere."""
    found = {}
    for name in ("best", "consistent", "consistently_worse"):
        rows = paper[name]["noise_rate"].astype(float)
        count = int((rows == 1).sum())
        found[name] = {
            "count": count,
            "of": len(rows),
            "expected": len(rows) / len(RATES),
            "p": stats.binomtest(count, len(rows), 1 / len(RATES)).pvalue,
        }
    return found


def kind(noise):
    """Say what a noise perturbs: "RandomNormalNoisyReward(1.0)" -> "reward"."""
    return parse_noise(noise).wrapper.kind


def kinds(paper):
    """What the best noises perturb, for each algorithm."""
    best = paper["best"]
    counts = pd.crosstab(best["algorithm"], best["noise"].map(kind))
    counts = counts.reindex(columns=list(KINDS))
    columns = {"": counts.index} | {
        f"{name} ({number} of the 15 noises)": counts[name] for name, number in KINDS.items()
    }
    fisher = {}
    for name in ("observation", "reward"):
        rest = counts.drop(columns=name).sum(axis=1)
        table = pd.DataFrame({name: counts[name], "rest": rest}).loc[["PPO", "TD3"]]
        fisher[name] = stats.fisher_exact(table).pvalue
    return {
        "table": markdown(columns),
        "ppo": stats.binom.sf(counts.loc["PPO", "reward"] - 1, 5, KINDS["reward"] / 15),
        "td3": stats.binom.sf(counts.loc["TD3", "observation"] - 1, 5, KINDS["observation"] / 15),
        "fisher": fisher,
    }


def scaled_rewards(paper):
    """Where the paper's new noise is consistent, and how often luck does as much.

    A noise has six rates; by luck it is consistent at one or more of them in all three algorithms,
    and so is at least one of the fifteen.
    """
    table = paper["consistent"].query("noise == @SCALE")
    rng = np.random.default_rng(0)
    n = PAPER_SEEDS["SAC"]  # the numbers of seeds and the spread do not matter for the sign
    in_all = np.ones((PAPER_CONFIGURATIONS // len(RATES), DRAWS), bool)
    for _ in PAPER_SEEDS:
        draws = np.stack(
            [draw_improvements(1, 1, 1e9, n, PAPER_CONFIGURATIONS * [n], rng) for _ in range(5)]
        )
        consistent = 100 * (draws >= 0).mean(axis=0) >= CONSISTENT_PERCENT
        in_all &= consistent.reshape(-1, len(RATES), DRAWS).any(axis=1)
    rows = zip(table["algorithm"], table["noise_rate"], strict=True)
    worse = paper["consistently_worse"].query("noise == @SCALE")
    return {
        "where": ", ".join(f"{algorithm} at {rate}" for algorithm, rate in rows),
        "worse": ", ".join(
            f"{r.algorithm} at {r.noise_rate} ({r.average_improvement_percent:+.1f} %)"
            for r in worse.itertuples()
        ),
        "this": 100 * in_all.mean(),
        "any": 100 * in_all.any(axis=0).mean(),
    }


def worse_everywhere(paper):
    """At how many of six rates the paper finds a noise worse in all environments."""
    table = paper["consistently_worse"]
    counts = table.groupby(["noise", "algorithm"]).size().sort_values(ascending=False)
    return {
        "at_every_rate": (counts == len(RATES)).sum(),
        "next": counts[counts < len(RATES)].max(),
        "of": counts.groupby("noise").sum().to_dict(),
    }


def mixture(paper):
    """What the averages of mixup at p = 1 say about which mixture the paper ran.

    If four environments lose all (-100 %), the fifth follows from the average, and so does the
    standard deviation.
    """
    rows = paper["consistently_worse"].query("noise == @MIXUP")
    rows = rows[rows["noise_rate"].astype(float) == 1].set_index("algorithm")
    result = {}
    for algorithm in PAPER_SEEDS:
        average = rows.loc[algorithm, "average_improvement_percent"]
        fifth = 5 * average + 400
        result[algorithm] = {
            "average": average,
            "std": rows.loc[algorithm, "std_improvement_percent"],
            "fifth": fifth,
            "std_then": np.std([-100] * 4 + [fifth], ddof=1),
        }
    return result


def paper_spread(paper):
    """The standard deviations of the paper's best noises against their baselines: F tests."""
    best = paper["best"]
    ratio = best["noisy_std"] / best["baseline_std"]
    df = best["algorithm"].map(PAPER_SEEDS) - 1
    tail = stats.f.cdf(ratio**2, df, df)
    p = holm(2 * np.minimum(tail, 1 - tail))
    lower = best.assign(p=p)[(ratio < 1) & (p <= 0.05)].sort_values("p")
    return {
        "lower": (ratio < 1).sum(),
        "rows": len(best),
        "significant": (p <= 0.05).sum(),
        "names": ", ".join(
            f"{a} on {e.split('-')[0]} ({value:.2g})"
            for a, e, value in zip(
                lower["algorithm"], lower["environment"], lower["p"], strict=True
            )
        ),
        "next": p[p > 0.05].min(),
    }


def paper_speed(paper):
    """The first step of the paper's early-performance table at the baseline's final mean."""
    table = paper["early_performance"]
    columns = {"": [], "baseline after 1.0": [], "no noise": [], "p = 0.01": [], "p = 0.05": []}
    for environment, rows in table.groupby("environment"):
        means = rows.pivot(index="steps_millions", columns="noise_rate", values="mean")
        target = means.loc[1.0, "0.00"]
        columns[""].append(environment)
        columns["baseline after 1.0"].append(f"{target:,.0f}")
        for rate, title in (("0.00", "no noise"), ("0.01", "p = 0.01"), ("0.05", "p = 0.05")):
            reached = means.index[means[rate] >= target]
            columns[title].append(f"{reached[0]:.1f}" if len(reached) else "\u2013")
    final = table.query("environment == 'HalfCheetah-v2' and steps_millions == 1")
    final = final.assign(n=PAPER_SEEDS["SAC"]).set_index("noise_rate")[["mean", "std", "n"]]
    errors, p = welch(final.loc[["0.01"]], final.loc[["0.00"]].set_axis(["0.01"]))
    return {"table": markdown(columns), "errors": errors.iloc[0], "p": p[0]}


# ------------------------------------------------------------------------------------ PPO, our runs


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
        for at in (0.05, 0.05 / len(names))
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
            "p": tested["p"].to_numpy(float),
        }
    )
    corrected = holm(tested["p"].to_numpy(float))
    return {
        "table": text,
        "power": markdown(
            {
                "": names,
                "the paper's gain": cells("{:+,.1f}", paper_gain),
                "ours [95 %]": cells("{:+,.1f} [{:,.1f}, {:,.1f}]", gain, low, high),
                "power to find the paper's": cells("{:.2f}", found),
                "at p = 0.01": cells("{:.2f}", strict),
                "gains differ by SE": cells("{:+.1f}", (gain - paper_gain) / error),
            }
        ),
        "percent": (100 * gain / y["mean"].abs()).to_dict(),
        "paper_percent": percent.to_dict(),
        "p": tested["p"].to_dict(),
        "holm": dict(zip(names, corrected, strict=True)),
        "reward": {
            "n": len(rewarding),
            "higher": (gain[rewarding] > 0).sum(),
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
    text = markdown(
        {
            "": x.index,
            "without noise": cells("{:,.1f}", y["std"]),
            "with noise": cells("{:,.1f}", x["std"]),
            "change": cells("{:+.0f} %", 100 * (x["std"] / y["std"] - 1)),
            "the paper": cells("{:+.0f} %", 100 * (paper_noisy["std"] / paper_base["std"] - 1)),
            "p": p,
        }
    )
    return {"table": text, "power": power_of_levene(0.5, 10), "smallest": min(p)}


def speed(summary):
    """The first test at which PPO's mean over seeds is at the baseline's final mean."""
    start = summary[summary["noise"] == ""].set_index("environment")["steps_to_baseline"]
    noisy = summary[summary["noise"] != ""].set_index("environment")["steps_to_baseline"]
    return markdown(
        {
            "": noisy.index,
            "without noise": cells("{:,.0f}", start.loc[noisy.index]),
            "with noise": cells("{:,.0f}", noisy),
        }
    )


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
        found[noise]["lowest"] = list(change.index[noisy.max() < without.min()])
        found[noise]["alone"] = {e: mann_whitney(noisy[[e]], without[[e]])[0] for e in environments}
        found[noise]["finds"] = {e: finds(noisy[e], without[e], 0)[0] for e in environments}
        row = {"noise": f"`{noise}`"} | {name: "\u2013" for name in ENVIRONMENTS}
        row |= {name: f"{value:+.0f} %" for name, value in change.items()}
        row["average"] = f"{change.mean():+.0f} ± {change.std(ddof=1):.0f} %"
        row["the paper"] = "\u2013"
        if noise in theirs.index:
            row["the paper"] = spell_average(theirs.loc[noise])
            found[noise]["paper"] = theirs.loc[noise, "average_improvement_percent"]
        rows.append(row | {"p (exact)": f"{p:.2g}"})
    return {"table": markdown(rows), **found}


def mixtures(runs, paper):
    """PPO with the two kinds of mixup, in the environments that both were run in.

    Averages over environments of the change in percent of the mean without noise, which is taken as
    known, and the difference of the two with its interval (Welch, Satterthwaite). `needed` is what
    the plain kind's change in each other environment would have to be for the paper's average.
    """
    average = paper["consistently_worse"].query(
        "algorithm == 'PPO' and noise == @MIXUP and noise_rate == '1.00'"
    )["average_improvement_percent"]
    environments = WORSE[PLAIN_MIXUP]
    base = by_environment(runs[runs["noise"] == ""], FIXED_SEEDS)[environments].mean()
    noisy = (
        by_environment(runs.query("noise == @noise and noise_rate == '1.00'"), FEW_SEEDS)
        for noise in (MIXUP, PLAIN_MIXUP)
    )
    recursive, plain = (improvement_percent(returns[environments], base) for returns in noisy)
    others = len(ENVIRONMENTS) - len(environments)
    needed = (len(ENVIRONMENTS) * average.item() - plain.mean().sum()) / others
    samples = [table[name].to_numpy() for table in (recursive, plain) for name in environments]
    weight = 1 / len(environments)
    difference, _, low, high = contrast(samples, 3 * [weight] + 3 * [-weight])
    return {
        "recursive": recursive.mean().mean(),
        "plain": plain.mean().mean(),
        "needed": needed,
        "difference": difference,
        "low": low,
        "high": high,
    }


def by_environment(runs, seeds):
    """Return the test returns of these seeds: a row per seed, a column per environment."""
    chosen = runs[runs["seed"].isin(list(seeds))]
    return chosen.pivot(index="seed", columns="environment", values="test").reindex(
        columns=ENVIRONMENTS
    )


# ----------------------------------------------------------------------------------------- TD3, all


def td3(runs, paper):
    """TD3 on HalfCheetah with a noise that the paper finds worse everywhere at every rate."""
    theirs = paper["consistently_worse"].query("algorithm == 'TD3' and noise == @NORMAL")
    theirs = theirs.set_index("noise_rate")
    runs = runs.query("environment == 'HalfCheetah' and seed in @FEW_SEEDS")
    base = runs[runs["noise"] == ""]["test"]
    rows, found = [], {}
    for rate in ("0.01", "1.00"):
        noisy = runs.query("noise == @NORMAL and noise_rate == @rate")["test"]
        row, found[rate] = compare_rows(f"p = {float(rate):g}", noisy, base)
        rows.append(row | {"the paper": spell_average(theirs.loc[rate])})
    names = {"first": "with noise", "second": "without", "of the second": "change"}
    names["p"] = "p (exact)"
    return {"table": markdown(pd.DataFrame(rows).rename(columns=names)), **found}


# ----------------------------------------------------------------------------------------- SAC, all


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
        "finds": noisy["detectable_percent"].to_dict(),
    }


def noise_rates(folder):
    """The largest distance of a realised noise rate from p, in binomial standard deviations."""
    largest = 0
    for path in sorted(folder.glob("*/result.json")):
        args = json.loads((path.parent / "config.json").read_text())["args"]
        counts = json.loads(path.read_text())["noise_applied"].values()
        for rate, (applied, calls) in zip(args["noise_rate"], counts, strict=True):
            deviation = (calls * rate * (1 - rate)) ** 0.5
            if deviation:
                largest = max(largest, abs(applied - calls * rate) / deviation)
    return largest


def commits(names):
    """Count the commits that the runs of these names are from."""
    configs = [json.loads((DATA / "runs" / name / "config.json").read_text()) for name in names]
    return len({config["git_commit"] for config in configs})


def reward_scale():
    """The standard deviation by which PPO would divide its reward on Pusher (reward_scale.py)."""
    table = pd.read_csv(DATA / "reward_scale/reward_scale.csv").fillna({"noise": ""})
    return table.set_index(["noise", "begins_anew_when"])["std"].to_dict()


def numbers():
    """Compute all that the page says."""
    paper, luck = with_luck(read_paper(RESULTS / "paper"))
    best = plain(paper["best"]).query("algorithm == 'PPO'").set_index("environment").sort_index()
    best = best.assign(n=PAPER_SEEDS["PPO"])
    paper_base, paper_noisy = (
        best[[f"{name}_mean", f"{name}_std", "n"]].set_axis(["mean", "std", "n"], axis=1)
        for name in ("baseline", "noisy")
    )

    runs = read_runs(DATA / "runs")
    tables = make_tables(make_studies(runs)[0], read_paper(RESULTS / "paper"))
    statistics, early = (
        plain(tables[n].frame) for n in ("statistics", "compare_early_performance")
    )

    returns = read_returns(DATA / "runs")
    ppo = returns.query("algorithm == 'PPO'")
    chosen = list(zip(best.index, best["noise"], best["noise_rate"], strict=True))
    of_five = fixed_beforehand(ppo, chosen)
    base, noisy = of_five[of_five["noise"] == ""], of_five[of_five["noise"] != ""]
    five_runs = runs[runs["algorithm"] == "PPO"]
    five_runs = five_runs.loc[fixed_beforehand(plain(five_runs), chosen).index]
    five = make_tables(make_studies(five_runs)[0])
    five_statistics, five_summary = (plain(five[n].frame) for n in ("statistics", "summary_PPO"))
    five_statistics = five_statistics[five_statistics["p"].notna()]
    counts = returns.groupby("algorithm").size()
    return {
        "runs": ", ".join(f"{name} {n}" for name, n in counts.items()),
        "draws": f"{DRAWS:,}",
        "alarms": FALSE_ALARMS_IN_THE_PAPER,
        "finds_best": POWER_IN_THE_PAPER,
        "scaled_reward": SCALE,
        "normal": NORMAL,
        "mixup": MIXUP,
        "plain_mixup": PLAIN_MIXUP,
        "luck": luck_of_the_best(paper) | {"winners": luck_with_the_winners_spread(paper)},
        "smallest_consistent": paper["consistent"]["p_luck"].min(),
        "consistent": luck_of_the_consistent(luck),
        "rates": rates(paper),
        "kinds": kinds(paper),
        "scaled": scaled_rewards(paper),
        "worse": worse_everywhere(paper),
        "mixture": mixture(paper),
        "paper_spread": paper_spread(paper),
        "paper_speed": paper_speed(paper),
        "five": five_noises(
            base, noisy, paper_base, paper_noisy, best["improvement_percent"], five_statistics
        ),
        "spread": spread(base, noisy, paper_base, paper_noisy),
        "speed": speed(five_summary),
        "pusher": pusher(ppo) | {"step": other_step(read_returns(DATA / "choice"), ppo)},
        "half_cheetah": half_cheetah(ppo, best["improvement_percent"]["HalfCheetah"]),
        "worse_noises": worse_noises(ppo, paper),
        "mixtures": mixtures(ppo, paper),
        "td3": td3(returns.query("algorithm == 'TD3'"), paper),
        "sac": sac(early, statistics),
        "ablation": ablation.numbers(ablation.read_ablation(), paper),
        "headline": headline.numbers(headline.read_curves()),
        "rate_error": noise_rates(DATA / "runs"),
        "commits": commits(five_runs["run"]),
        "scale": reward_scale(),
    }


def page():
    """Return the text of README.md."""
    return render("README.md.jinja", numbers())


if __name__ == "__main__":
    ablation.draw_if_whole()
    (RESULTS / "README.md").write_text(page())
    print(f"Wrote {RESULTS / 'README.md'}")
