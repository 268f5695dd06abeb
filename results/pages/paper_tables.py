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
        "algorithm": best["algorithm"],
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
            "most_frequent": rows.mode().tolist(),
            "expected": len(rows) / len(RATES),
            "p": stats.binomtest(count, len(rows), 1 / len(RATES)).pvalue,
        }
    return found


def kind(noise):
    """Say what a noise perturbs: "RandomNormalNoisyReward(1.0)" -> "reward"."""
    return parse_noise(noise).wrapper.kind


def kinds(paper):
    """What the best noises of PPO and TD3 perturb: counts of five, and Fisher's exact p."""
    counts = counts_of_kinds(paper)
    fisher = {}
    for name in ("observation", "reward"):
        rest = counts.drop(columns=name).sum(axis=1)
        table = pd.DataFrame({name: counts[name], "rest": rest}).loc[["PPO", "TD3"]]
        fisher[name] = stats.fisher_exact(table).pvalue
    return {"counts": counts.T.to_dict(), "fisher": fisher}


def counts_of_kinds(paper):
    """Count the best noises by what they perturb: a row per algorithm, a column per kind."""
    best = paper["best"]
    return pd.crosstab(best["algorithm"], best["noise"].map(kind)).reindex(columns=list(KINDS))


def kinds_by_chance(paper):
    """P(at least so many best noises of a kind), if each of the 15 is as likely to be the best.

    A row per algorithm and kind. fisher_p_ppo_td3 compares PPO with TD3: this kind against others.
    """
    table = counts_of_kinds(paper).stack().rename("best_noises").reset_index()
    table.columns = ["algorithm", "kind", "best_noises"]
    table["of"] = table.groupby("algorithm")["best_noises"].transform("sum")
    share = table["kind"].map(KINDS) / sum(KINDS.values())
    table["p_at_least"] = stats.binom.sf(table["best_noises"] - 1, table["of"], share)
    fisher = table["kind"].map(kinds(paper)["fisher"])
    return table.assign(fisher_p_ppo_td3=fisher.where(table["algorithm"] != "SAC"))


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
        "rates": counts.to_dict(),
        "at_every_rate": (counts == len(RATES)).sum(),
        "next": counts[counts < len(RATES)].max(),
        "of": counts.groupby("noise").sum().to_dict(),
    }


def spread_tests(paper):
    """The standard deviations of the paper's best noises against their baselines: F tests.

    Printed standard deviations allow no other test; this one assumes that returns are normal.
    """
    columns = ["algorithm", "environment", "noise", "noise_rate", "baseline_std", "noisy_std"]
    table = paper["best"][columns].copy()
    df = table["algorithm"].map(PAPER_SEEDS) - 1
    tail = stats.f.cdf((table["noisy_std"] / table["baseline_std"]) ** 2, df, df)
    table["f_p"] = 2 * np.minimum(tail, 1 - tail)
    return table.assign(f_p_holm=holm(table["f_p"].to_numpy()))


def paper_spread(paper):
    """How many of the paper's best noises lower the standard deviation, how many significantly."""
    table = spread_tests(paper)
    lower = table["noisy_std"] < table["baseline_std"]
    return {
        "lower": lower.sum(),
        "rows": len(table),
        "significant": (lower & (table["f_p_holm"] <= 0.05)).sum(),
    }


def steps_to_the_baseline(paper):
    """When the paper's SAC first reaches the baseline's final mean, in millions of steps.

    A row per environment, a column per noise rate; NaN where it never does.
    """
    rows = []
    for name, table in paper["early_performance"].groupby("environment"):
        means = table.pivot(index="steps_millions", columns="noise_rate", values="mean")
        final = means["0.00"].iloc[-1]
        reached = (means >= final).idxmax().where((means >= final).any())
        rows.append({"environment": name, "baseline_final_mean": final, **reached.add_prefix("p_")})
    return pd.DataFrame(rows)


def paper_speed(paper):
    """SAC on HalfCheetah in the paper, at p = 0.01: when it reaches the baseline's final mean.

    `reached`: the first step of its table, in millions; `errors` and `p` compare the final returns.
    """
    table = paper["early_performance"].query("environment == 'HalfCheetah-v2'")
    [reached] = steps_to_the_baseline({"early_performance": table})["p_0.01"]
    final = table.query("steps_millions == 1").assign(n=PAPER_SEEDS["SAC"])
    final = final.set_index("noise_rate")[["mean", "std", "n"]]
    errors, p = welch(final.loc[["0.01"]], final.loc[["0.00"]].set_axis(["0.01"]))
    return {"reached": reached, "errors": errors.iloc[0], "p": p[0]}
