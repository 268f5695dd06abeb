"""What the paper's own tables say, and what luck alone would make."""

import numpy as np
import pandas as pd
from common import cells, markdown, welch
from scipy import stats

from analysis.luck import CONSISTENT_PERCENT, DRAWS, draw_improvements, p_value
from analysis.paper import PAPER_CONFIGURATIONS, PAPER_SEEDS
from analysis.statistics import holm
from noisy_wrappers import parse_noise

RATES = [0.01, 0.05, 0.1, 0.2, 0.5, 1.0]
SCALE = "RandomUniformScaleReward(0.5, 1.5)"
# The paper's 15 noises by what they perturb; its text calls early termination dynamics noise.
KINDS = {"observation": 8, "reward": 5, "dynamics": 2}
MANY_DRAWS = 1_000_000  # of a small P


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
    """What the best noises of PPO and TD3 perturb: counts of five, and Fisher's exact p."""
    best = paper["best"]
    counts = pd.crosstab(best["algorithm"], best["noise"].map(kind)).reindex(columns=list(KINDS))
    fisher = {}
    for name in ("observation", "reward"):
        rest = counts.drop(columns=name).sum(axis=1)
        table = pd.DataFrame({name: counts[name], "rest": rest}).loc[["PPO", "TD3"]]
        fisher[name] = stats.fisher_exact(table).pvalue
    return {"counts": counts.T.to_dict(), "fisher": fisher}


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
    """SAC on HalfCheetah in the paper, at p = 0.01: when it reaches the baseline's final mean.

    `reached`: the first step of its table, in millions; `errors` and `p` compare the final returns.
    """
    table = paper["early_performance"].query("environment == 'HalfCheetah-v2'")
    means = table.pivot(index="steps_millions", columns="noise_rate", values="mean")
    reached = means.index[means["0.01"] >= means.loc[1.0, "0.00"]][0]
    final = table.query("steps_millions == 1").assign(n=PAPER_SEEDS["SAC"])
    final = final.set_index("noise_rate")[["mean", "std", "n"]]
    errors, p = welch(final.loc[["0.01"]], final.loc[["0.00"]].set_axis(["0.01"]))
    return {"reached": reached, "errors": errors.iloc[0], "p": p[0]}
