"""Write results/robustness.md and its figure from the runs in data/robustness/.

    python results/pages/robustness.py

PPO on three environments, trained without noise, with observation noise and with action noise, and
tested again by evaluate.py under these and a third noise. robustness.md.jinja has the text, this
file every number in it.
"""

import json
from functools import cache

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from common import (
    DATA,
    RESULTS,
    compare_rows,
    markdown,
    plain,
    read_returns,
    render,
    spelled,
)
from helpful import FAR_ABOVE

from analysis.effects import PALETTE
from analysis.figures import STYLE
from analysis.robustness import (
    CONDITION,
    condition_rows,
    is_seen,
    is_unseen,
    read_robustness,
    score_rows,
)
from analysis.runs import read_runs
from analysis.statistics import contrast, holm, mann_whitney

FOLDER = DATA / "robustness"
SHORT = {
    "": "no noise",
    "RandomNormalNoisyObservation(0.1)": "observation noise",
    "RandomNormalNoisyAction(0.3)": "action noise",
    "RandomDropoutObservation(0.9)": "dropout",
}
COLORS = {"no noise": "black", "observation noise": PALETTE[0], "action noise": PALETTE[1]}


def scores(found, counts):
    """Score the policies on the conditions that count; Holm's correction is over all environments.

    found is a frame of read_robustness; counts is is_unseen or is_seen of analysis.robustness.
    """
    table = pd.DataFrame(score_rows(found, counts))
    together = table["scope"] == "all"
    table["p_holm"] = float("nan")
    table.loc[together, "p_holm"] = holm(table.loc[together, "p"].to_numpy(float))
    return table


SCORE = {
    "score": ("{:.0f}", "score"),
    "without noise": ("{:.0f}", "baseline_score"),
    "difference [95 %]": (
        "{:+.0f} [{:.0f}, {:.0f}]",
        "difference",
        "difference_low",
        "difference_high",
    ),
    "p (exact)": ("{:.2g}", "p"),
}
PRIMARY = SCORE | {"Holm": ("{:.2g}", "p_holm"), "80 % power at": ("{:.0f}", "detectable")}
HARDER = {
    "worst condition": ("{:.0f}", "worst_score"),
    "worst condition, without noise": ("{:.0f}", "baseline_worst_score"),
    "worst tenth": ("{:.0f}", "cvar_score"),
    "worst tenth, without noise": ("{:.0f}", "baseline_cvar_score"),
}


def together(table, columns):
    """Spell the rows of all environments together, which are the tests fixed beforehand."""
    rows = table[table["scope"] == "all"]
    return markdown({"trained with": rows["noise"].map(SHORT), **spelled(rows, columns)})


def by_environment(table):
    """Spell the rows of one environment each, which are secondary and uncorrected."""
    rows = plain(table[table["scope"] != "all"])
    names = {"trained with": rows["noise"].map(SHORT), "": rows["environment"]}
    return markdown(names | spelled(rows, SCORE))


def clean_returns(runs):
    """Compare the returns without noise in the test with those of training without noise."""
    clean = plain(runs[runs["test_noise"] == ""])
    rows, p = [], []
    for environment, group in clean.groupby("environment"):
        baseline = group.loc[group["noise"] == "", "mean"]
        for noise, same in group[group["noise"] != ""].groupby("noise"):
            row, numbers = compare_rows(f"{environment}, {SHORT[noise]}", same["mean"], baseline)
            rows.append(row)
            p.append(numbers["p"])
    names = {"first": "trained with it", "second": "without noise", "of the second": "change"}
    table = pd.DataFrame(rows).rename(columns=names).assign(p=p)
    return {
        "table": markdown(table),
        "holm": dict(zip(table[""], holm(np.array(p)), strict=True)),
    }


def clean_changes(table):
    """Return {"observation noise": {"Hopper": percent}}: the change of the return without noise."""
    rows = plain(table[table["scope"] != "all"])
    rows = rows.assign(noise=rows["noise"].map(SHORT))
    return {
        noise: same.set_index("environment")["clean_change_percent"].to_dict()
        for noise, same in rows.groupby("noise")
    }


def returns(conditions):
    """Spell the returns in one environment: a row per test condition, a column per training."""
    table = {"tested with": []}
    for (noise, rate), tested in conditions.groupby(CONDITION, sort=False):
        table["tested with"].append(f"{SHORT[noise]}, p = {float(rate):g}" if noise else "no noise")
        for row in tested.itertuples():
            frame = "**" if row.tested_on in ("the same noise", "the same wrapper") else ""
            text = f"{frame}{row.mean:,.0f} ± {row.std:,.0f}{frame}"
            table.setdefault(f"trained with {SHORT[row.noise]}", []).append(text)
    return markdown(table)


def own_noise(found):
    """Compare policies with those trained without noise under the noise of their own training.

    One rate in the test at a time: {noise: {rate: {...}}} with the difference of the scores,
    averaged over environments, and the exact p.
    """
    without = found[found["noise"] == ""]
    clean = without[without["test_noise"] == ""].groupby("environment")["mean"].mean()
    result = {}
    tested = found[(found["test_noise"] != "") & found["test_noise"].isin(set(found["noise"]))]
    for (noise, rate), group in tested.groupby(["test_noise", "test_rate"]):
        x, y = (
            group[group["noise"] == name].pivot(index="seed", columns="environment", values="mean")
            for name in (noise, "")
        )
        difference = (100 * (x.mean() - y.mean()) / clean.abs()).mean()
        numbers = {"difference": difference, "p": mann_whitney(x, y)[0]}
        result.setdefault(SHORT[noise], {})[rate] = numbers
    return result


def own_noise_table(own):
    """Spell own_noise(): a row for each noise, a column for each rate in the test."""
    return markdown(
        [
            {"trained and tested with": noise}
            | {
                f"p = {float(rate):g}": f"{row['difference']:+.0f} ({row['p']:.2g})"
                for rate, row in rates.items()
            }
            for noise, rates in own.items()
        ]
    )


def kept(found, counts):
    """Compare the shares of their own clean return that policies keep under noise, in percent.

    The conditions that count and the averages are those of the score: `share` is a mean of the
    policies' ratios. `of_means` is the ratio of the policies' mean returns, which a policy with a
    small clean return does not dominate; it is averaged over environments.
    """
    policy = ["noise", "environment", "seed"]
    clean = found[found["test_noise"] == ""].set_index(policy)["mean"].rename("clean")
    tested = found[found["test_noise"] != ""].join(clean, on=policy)
    tested["share"] = 100 * tested["mean"] / tested["clean"]
    result = {}
    for config in sorted(set(found["configuration"])):
        if config.is_baseline:
            continue
        noise = config.noise
        mask = [counts(condition, config) for condition in tested["condition"]]
        shares = tested[mask].groupby(policy)["share"].mean()
        x, y = (shares[name].unstack("environment") for name in (noise, ""))
        n = x.shape[1]
        means = tested[mask].groupby(["noise", "environment"])[["mean", "clean"]].mean()
        of_means = 100 * (means["mean"] / means["clean"]).groupby("noise").mean()
        samples = [table[name].to_numpy() for table in (x, y) for name in table]
        difference, _, low, high = contrast(samples, [1 / n] * n + [-1 / n] * n)
        result[SHORT[noise]] = {
            "share": x.mean().mean(),
            "baseline_share": y.mean().mean(),
            "of_means": of_means[noise],
            "baseline_of_means": of_means[""],
            "difference": difference,
            "low": low,
            "high": high,
            "p": mann_whitney(x, y)[0],
        }
    return result


SHARES = {
    "share": ("{:.0f} %", "share"),
    "without noise": ("{:.0f} %", "baseline_share"),
    "difference [95 %]": ("{:+.0f} [{:.0f}, {:.0f}]", "difference", "low", "high"),
    "p (exact)": ("{:.1g}", "p"),
    "ratio of means": ("{:.0f} %", "of_means"),
    "ratio of means, without noise": ("{:.0f} %", "baseline_of_means"),
}


def shares_table(unseen, seen):
    """Spell the shares of kept(), under noise that was not in training and under its own."""
    rows = pd.DataFrame([*unseen.values(), *seen.values()])
    titles = len(unseen) * ["noise of another kind"] + len(seen) * ["the same noise"]
    names = {"trained with": [*unseen, *seen], "tested with": titles}
    return markdown(names | spelled(rows, SHARES))


def by_noise(table):
    """Return the rows of all environments together as {"observation noise": {column: value}}."""
    rows = table[table["scope"] == "all"]
    return rows.set_index(rows["noise"].map(SHORT)).to_dict("index")


@cache
def tests():
    """Read the robustness.csv.gz of all runs: one row per run and condition."""
    found, unreadable = read_robustness(FOLDER, read_runs(FOLDER))
    if unreadable:
        raise SystemExit("\n".join(unreadable))
    return found


def numbers():
    """Compute all that the page says."""
    found = tests()
    unseen, seen = scores(found, is_unseen), scores(found, is_seen)
    kept_unseen, kept_seen = kept(found, is_unseen), kept(found, is_seen)
    own = own_noise(found)
    final = plain(read_returns(FOLDER))
    cheetah = final.query("environment == 'HalfCheetah' and noise == ''")["test"]
    conditions = plain(pd.DataFrame(condition_rows(found)))
    results = [json.loads(path.read_text()) for path in FOLDER.glob("*/result.json")]
    return {
        "runs": len(results),
        "minutes": np.median([result["wall_time_seconds"] for result in results]) / 60,
        "unseen": {
            "table": together(unseen, PRIMARY),
            "environments": by_environment(unseen),
            "harder": together(unseen, HARDER),
            **by_noise(unseen),
        },
        "seen": {
            "table": together(seen, PRIMARY),
            "environments": by_environment(seen),
            "rates": own_noise_table(own),
            **by_noise(seen),
        },
        "clean": clean_returns(found),
        "change": clean_changes(unseen),
        "own": own,
        "far_above": int((cheetah > FAR_ABOVE).sum()),
        "cheetah_runs": len(cheetah),
        "kept": kept_unseen,
        "shares": shares_table(kept_unseen, kept_seen),
        "returns": {name: returns(rows) for name, rows in conditions.groupby("environment")},
    }


def page():
    """Return the text of robustness.md."""
    return render("robustness.md.jinja", numbers())


def draw():
    """Draw the return against the rate of each noise in the test: a row per noise."""
    table = plain(pd.DataFrame(condition_rows(tests())))
    table["rate"] = table["test_rate"].astype(float)
    clean = table[table["test_noise"] == ""]
    noises = [noise for noise in SHORT if noise]
    environments = sorted(set(table["environment"]))
    plt.rcParams.update(STYLE)
    fig, axes = plt.subplots(
        len(noises), len(environments), figsize=(9, 8), sharey="col", layout="constrained"
    )
    for noise, row in zip(noises, axes, strict=True):
        tested = pd.concat([clean, table[table["test_noise"] == noise]])
        for environment, ax in zip(environments, row, strict=True):
            for training, line in tested[tested["environment"] == environment].groupby("noise"):
                color, error = COLORS[SHORT[training]], line["std"] / np.sqrt(line["n"])
                label = f"trained with {SHORT[training]}"
                ax.errorbar(line["rate"], line["mean"], error, marker=".", color=color, label=label)
            ax.set_ylim(bottom=0)
            ax.set_xlabel(f"rate of {SHORT[noise]} in the test")
    for environment, ax in zip(environments, axes[0], strict=True):
        ax.set_title(environment)
    for ax in axes[:, 0]:
        ax.set_ylabel("return")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    fig.savefig(RESULTS / "figures/robustness.svg", metadata={"Date": None})


if __name__ == "__main__":
    draw()
    (RESULTS / "robustness.md").write_text(page())
    print(f"Wrote {RESULTS / 'robustness.md'}")
