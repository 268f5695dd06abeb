"""Write results/baselines.md and its figure from the runs in data/: what trains without noise.

    python results/pages/baselines.py

The three algorithms beside the paper and CleanRL, and which way of testing PPO would explain the
paper's returns. baselines.md.jinja has the text, this file and ways.py every number in it.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import ways
from common import (
    DATA,
    ENVIRONMENTS,
    FIXED_SEEDS,
    RESULTS,
    cells,
    markdown,
    plain,
    read_returns,
    render,
    sample,
    spell,
    variance_share,
    welch,
    welch_interval,
)
from side_by_side import side_by_side

from analysis.effects import PALETTE
from analysis.paper import PAPER_SEEDS, read_paper
from analysis.runs import KEYS, read_runs
from analysis.statistics import holm

plt.rcParams["svg.hashsalt"] = "noisy"  # equal figures are equal files

CLEANRL_CSV = Path(__file__).with_name("cleanrl.csv")  # training returns in its documentation
CLEANRL_SEEDS = 3
FULL_LENGTH, SHORT_LENGTH = 1_000_000, 200_000
COLORS = dict(zip(("PPO", "SAC", "TD3"), PALETTE, strict=True))
VALUES = ["mean", "std", "n"]


# ------------------------------------------------------------------------------------------ reading


def read_baselines():
    """Return one row per finished run without noise: configuration, curve, test, training return.

    Of PPO on v5 these are seeds 1 to 10, as in its comparisons with noise.
    """
    found = []
    for folder in ("runs", "long", "v4"):
        runs = read_runs(DATA / folder).query("status == 'finished' and noise == ''")
        version = "v" + runs["environment"].str.split("-v").str[1]
        curves = plain(runs)[[*KEYS, "seed", "total", "steps", "returns"]].assign(version=version)
        found.append(curves.merge(read_returns(DATA / folder), on=[*KEYS, "seed"]))
    runs = pd.concat(found, ignore_index=True)
    ours = (runs["algorithm"] != "PPO") | runs["seed"].isin(FIXED_SEEDS)
    return runs[ours].assign(algorithm=runs["algorithm"].str.split().str[0])


def groups(runs):
    """Return pairs of (algorithm, total steps, environment, version) and its runs."""
    return runs.groupby(["algorithm", "total", "environment", "version"])


def read_cleanrl(path=CLEANRL_CSV):
    """Return the training returns of CleanRL's documentation, with the sample's deviation.

    It prints the population's (np.std in its rlops). PPO: releases v2 and v4 at commit 2d660b6
    (October 2023), the newer one since 35896b1 (November 2023). SAC and TD3: at fe8d8a0.
    """
    table = pd.read_csv(path)
    table["std"] = table["population_std"] * np.sqrt(CLEANRL_SEEDS / (CLEANRL_SEEDS - 1))
    return table.assign(n=CLEANRL_SEEDS)


def newest_of_cleanrl():
    """Return CleanRL's newest returns by (algorithm, environment)."""
    return read_cleanrl().groupby(["algorithm", "environment"]).last()


def paper_baselines(paper):
    """Return the paper's final returns without noise, by (algorithm, environment)."""
    best = plain(paper["best"])
    best = best.assign(n=best["algorithm"].map(PAPER_SEEDS))
    table = best.set_index(["algorithm", "environment"])[["baseline_mean", "baseline_std", "n"]]
    return table.set_axis(VALUES, axis=1)


def published(paper, algorithm, environment, total):
    """Return what is published for a row: (the paper's sample, CleanRL's, CleanRL's version).

    A sample is a frame of one row, or None. The paper's table of SAC's early performance has
    HalfCheetah after fewer steps, too.
    """
    name = [environment]
    if total < FULL_LENGTH:
        early = plain(paper["early_performance"]).query(
            "algorithm == @algorithm and environment == @environment and noise_rate == '0.00'"
        )
        early = early[np.isclose(early["steps_millions"] * 1e6, total)]
        sample = early.assign(n=PAPER_SEEDS[algorithm]).set_index("environment")[VALUES]
        return sample if len(sample) else None, None, None
    sample, newest = paper_baselines(paper).loc[algorithm].loc[name], newest_of_cleanrl()
    if (algorithm, environment) not in newest.index:
        return sample, None, None
    theirs = newest.loc[algorithm].loc[name]
    return sample, theirs[VALUES], theirs["version"].item()


# ----------------------------------------------------------------------------------------- the rows


def compare(ours, theirs):
    """Compare two samples, frames of one row: a text, the difference in standard errors, and p."""
    difference = ours["mean"].iloc[0] - theirs["mean"].iloc[0]
    low, high = (limit.iloc[0] for limit in welch_interval(ours, theirs))
    errors, p = welch(ours, theirs)
    d = 0 if abs(theirs["mean"].iloc[0]) >= 100 else 1
    text = f"{difference:+,.{d}f} [{low:,.{d}f}, {high:,.{d}f}]"
    return text, {"se": errors.iloc[0], "p": p[0]}


def table(runs, paper, total):
    """Compare runs of this many steps with the paper and CleanRL: a table, and its numbers.

    The numbers are {"PPO on Walker2d-v5": {"paper": {"se": ..., "p": ...}, "cleanrl": {...}}}.
    """
    rows, numbers = [], {}
    for (algorithm, length, environment, version), group in groups(runs):
        if length != total:
            continue
        test, training = sample(group, "test"), sample(group, "training")
        theirs, cleanrls, their_version = published(paper, algorithm, environment, total)
        name, found = f"{algorithm} on {environment}-{version}", {}
        row = {"": name, "n": len(group), "test return": spell(test)[0]}
        row |= {"the paper, v2 (n)": "\u2013", "difference [95 %]": "\u2013"}
        if theirs is not None:
            row["the paper, v2 (n)"] = f"{spell(theirs)[0]} ({theirs['n'].iloc[0]})"
            row["difference [95 %]"], found["paper"] = compare(test, theirs)
        row["training return"] = spell(training)[0]
        if total == FULL_LENGTH:  # CleanRL's documentation has nothing shorter
            row |= {"CleanRL (version, n)": "\u2013", "difference [95 %] ": "\u2013"}
        if cleanrls is not None:
            row["CleanRL (version, n)"] = f"{spell(cleanrls)[0]} ({their_version}, {CLEANRL_SEEDS})"
            row["difference [95 %] "], found["cleanrl"] = compare(training, cleanrls)
        rows.append(row)
        numbers[name] = found
    return {"table": markdown(rows), "numbers": numbers}


def far_from_both(numbers):
    """Name the rows that are more than two standard errors from the paper and from CleanRL."""
    return [
        name
        for name, found in numbers.items()
        if len(found) == 2 and all(abs(other["se"]) > 2 for other in found.values())
    ]


def cleanrls_versions(runs, paper):
    """PPO's training returns against all that CleanRL has published, and CleanRL's v2 and paper."""
    base = runs.query("algorithm == 'PPO' and version == 'v5'")
    training = sample(base, "training")
    columns, apart = {"": training.index, "ours, v5": spell(training)}, []
    releases = read_cleanrl().query("algorithm == 'PPO'").set_index(["release", "environment"])
    for release in dict.fromkeys(releases.index.get_level_values("release")):
        theirs = releases.loc[release].loc[training.index, VALUES]
        errors, p = welch(training, theirs)
        columns[f"CleanRL, {release} (SE)"] = cells("{} ({:+.1f})", spell(theirs), errors)
        for name, se, value in zip(training.index, errors, p, strict=True):
            apart.append((value, f"{se:+.1f} on {name} ({release}, p = {value:.2g})"))
    errors, p = welch(releases.loc["v2"], paper_baselines(paper).loc["PPO"])
    return {
        "table": markdown(columns),
        "v2_to_paper": pd.DataFrame({"se": errors, "p": p}).to_dict("index"),
        "smallest_p": min(apart)[0],
        "number": len(apart),
        "clearest": ", ".join(text for _, text in sorted(apart)[:3]),
    }


def corrected(numbers):
    """Return Holm's p of PPO's differences from the paper, over the five environments on v5."""
    names = [f"PPO on {environment}-v5" for environment in ENVIRONMENTS]
    p = np.array([numbers[name]["paper"]["p"] for name in names])
    return dict(zip(ENVIRONMENTS, holm(p), strict=True))


# ------------------------------------------------------------------------- how the paper tested PPO


def read_tests(folder):
    """Return the final test returns of paper_tests.py: a row per run, a column per way.

    The other columns are environment, noise (whether there was any) and seed.
    """
    rows = []
    for run in read_runs(folder).itertuples():
        tests = pd.read_csv(folder / run.run / "tests.csv")
        last = tests[tests["step"] == tests["step"].max()]
        means = last.groupby("way")["episodic_return"].mean()
        name = run.environment.split("-")[0]
        rows.append({"environment": name, "noise": run.noise != "", "seed": run.seed, **means})
    return pd.DataFrame(rows)


def in_words(way):
    """Return a way of testing as the page names it: statistics, actions."""
    return way.replace("_", " ").replace("-", ", ")


def judge_ways(tests, paper):
    """Judge each way of testing: a table, and {way: verdict}."""
    ppo = paper_baselines(paper).loc["PPO"]
    gain = plain(paper["best"]).set_index(["algorithm", "environment"])["improvement_percent"]
    gain = gain["PPO", ways.GAINING]
    rows, verdicts = [], {}
    for way in ways.WAYS:
        returns = {
            key: group[way].to_numpy() for key, group in tests.groupby(["environment", "noise"])
        }
        found = {
            name: ways.from_paper(returns[name, False], tuple(ppo.loc[name]))
            for name in (*ways.COMPARED, *ways.CONTROLS)
        }
        noisy, baseline = returns[ways.GAINING, True], returns[ways.GAINING, False]
        ours = 100 * (noisy.mean() / baseline.mean() - 1)
        p_none, p_paper = (ways.p_of_gain(noisy, baseline, percent) for percent in (0, gain))
        verdicts[way] = ways.verdict(
            [found[name] for name in ways.COMPARED],
            [found[name] for name in ways.CONTROLS],
            ours,
            p_none,
            p_paper,
        )
        row = {"statistics, actions": in_words(way)}
        row |= {
            f"{name} (SE)": f"{returns[name, False].mean():,.0f} ({found[name][0]:+.1f})"
            for name in found
        }
        row["gain on Walker2d"] = f"{ours:+.0f} %"
        row |= {"p of no gain": f"{p_none:.2g}", "p of the paper's": f"{p_paper:.2g}"}
        rows.append(row | {"the paper's way?": f"**{verdicts[way]}**"})
    left = [in_words(way) for way in ways.WAYS if verdicts[way] != "excluded"]
    return {"table": markdown(rows), "verdicts": verdicts, "left": left, "gain": gain}


# ----------------------------------------------------------------------------------------- the page


def numbers():
    """Compute all that the page says."""
    paper, runs = read_paper(RESULTS / "paper"), read_baselines()
    ppo = runs.query("algorithm == 'PPO' and version == 'v5'")
    share = variance_share(ppo)
    full, short = table(runs, paper, FULL_LENGTH), table(runs, paper, SHORT_LENGTH)
    tests = read_tests(DATA / "paper_tests")
    return {
        "full": full,
        "short": short,
        "far": far_from_both(full["numbers"]),
        "side": side_by_side(),
        "holm": corrected(full["numbers"]),
        "share": share.to_dict(),
        "highest_share": share.drop("Humanoid").max(),
        "cleanrl": cleanrls_versions(runs, paper),
        "ways": judge_ways(tests, paper),
        "seeds": tests.groupby("environment")["seed"].nunique().to_dict(),
        "level": ways.LEVEL,
    }


def page():
    """Return the text of baselines.md."""
    return render("baselines.md.jinja", numbers())


def draw():
    """Draw the learning curves without noise, a panel an environment, with published end points."""
    paper, cleanrls = paper_baselines(read_paper(RESULTS / "paper")), newest_of_cleanrl()
    runs = read_baselines().query("version == 'v5'")
    fig, axes = plt.subplots(2, 3, figsize=(10, 6), layout="constrained")
    panels = dict(zip(ENVIRONMENTS, axes.flat, strict=False))
    for environment, ax in panels.items():
        for place, (algorithm, color) in enumerate(COLORS.items()):
            mean, std, _ = paper.loc[algorithm, environment]
            ax.errorbar(1.04 + 0.025 * place, mean, std, fmt="o", color=color, markersize=4)
            if (algorithm, environment) in cleanrls.index:
                mean, std, _ = cleanrls.loc[(algorithm, environment), VALUES]
                ax.errorbar(1.14 + 0.025 * place, mean, std, fmt="x", color=color, markersize=5)
        ax.set_title(environment)
        ax.set_xlabel("training steps (millions)")
    for (algorithm, total, environment, _), group in groups(runs):
        curves = np.stack(list(group["returns"]))
        mean, std = curves.mean(axis=0), curves.std(axis=0, ddof=1)
        steps = group["steps"].iloc[0] / 1e6
        line = "-" if total == FULL_LENGTH else ":"
        ax, color = panels[environment], COLORS[algorithm]
        ax.plot(steps, mean, line, color=color)
        ax.fill_between(steps, mean - std, mean + std, color=color, alpha=0.15, linewidth=0)
    for ax in axes[:, 0]:
        ax.set_ylabel("test return")
    last = axes.flat[-1]
    last.axis("off")
    for algorithm, color in COLORS.items():
        last.plot([], [], color=color, label=algorithm)
    last.plot([], [], ":", color="grey", label="a run of 200,000 steps")
    last.plot([], [], "o", color="grey", markersize=4, label="the paper, v2, test")
    last.plot([], [], "x", color="grey", markersize=5, label="CleanRL, v2 or v4, training")
    last.legend(loc="center", frameon=False)
    fig.savefig(RESULTS / "figures/baselines.svg", metadata={"Date": None})
    plt.close(fig)


if __name__ == "__main__":
    draw()
    (RESULTS / "baselines.md").write_text(page())
    print(f"Wrote {RESULTS / 'baselines.md'}")
