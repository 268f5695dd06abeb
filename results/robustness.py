"""Write results/robustness.md and its figures from the runs in robustness/.

    python results/robustness.py

PPO on three environments, trained without noise, with observation noise and with action noise, and
tested again by evaluate.py under these and a third noise. robustness.md.jinja has the text, this
file every number in it.
"""

import json

import numpy as np
import pandas as pd
from claims import HERE, compare_rows, markdown, plain, render

from analyze_report import robustness_curves
from analyze_robustness import (
    CONDITION,
    condition_rows,
    is_seen,
    is_unseen,
    read_robustness,
    score_rows,
)
from analyze_runs import read_runs
from analyze_statistics import holm

FOLDER = HERE / "robustness"
SHORT = {
    "": "no noise",
    "RandomNormalNoisyObservation(0.1)": "observation noise",
    "RandomNormalNoisyAction(0.3)": "action noise",
    "RandomDropoutObservation(0.9)": "dropout",
}


def scores(found, counts):
    """Score the policies on the conditions that count; Holm's correction is over all environments.

    found is a frame of read_robustness; counts is is_unseen or is_seen of analyze_robustness.
    """
    table = pd.DataFrame(score_rows(found, counts))
    together = table["environment"] == "all"
    table["p_holm"] = float("nan")
    table.loc[together, "p_holm"] = holm(table.loc[together, "p"].to_numpy(float))
    return table


def answers(table):
    """Spell the rows of all environments together, which are the tests fixed beforehand."""
    rows = table[table["environment"] == "all"]
    return markdown(
        {
            "trained with": [SHORT[noise] for noise in rows["noise"]],
            **score_columns(rows),
            "p (exact)": [f"{p:.2g}" for p in rows["p"]],
            "Holm": [f"{p:.2g}" for p in rows["p_holm"]],
            "80 % power at": [f"{value:.0f}" for value in rows["detectable"]],
        }
    )


def by_environment(table):
    """Spell the rows of one environment each, which are secondary and uncorrected."""
    rows = plain(table[table["environment"] != "all"])
    return markdown(
        {
            "trained with": [SHORT[noise] for noise in rows["noise"]],
            "": rows["environment"],
            **score_columns(rows),
            "p (exact)": [f"{p:.2g}" for p in rows["p"]],
        }
    )


def score_columns(rows):
    """Spell scores beside those of the policies that were trained without noise."""
    differences = zip(
        rows["difference"], rows["difference_low"], rows["difference_high"], strict=True
    )
    return {
        "score": [f"{value:.0f}" for value in rows["score"]],
        "of no noise": [f"{value:.0f}" for value in rows["baseline_score"]],
        "difference [95 %]": [f"{d:+.0f} [{low:.0f}, {high:.0f}]" for d, low, high in differences],
    }


def harder(table):
    """Spell the worst condition and the worst episodes, over all environments together."""
    rows = table[table["environment"] == "all"]
    return markdown(
        {
            "trained with": [SHORT[noise] for noise in rows["noise"]],
            "worst condition": [f"{value:.0f}" for value in rows["worst_score"]],
            "of no noise": [f"{value:.0f}" for value in rows["baseline_worst_score"]],
            "worst tenth of the episodes": [f"{value:.0f}" for value in rows["cvar_score"]],
            "its of no noise": [f"{value:.0f}" for value in rows["baseline_cvar_score"]],
        }
    )


def clean_returns(runs):
    """Compare the returns without noise in the test with those of training without noise."""
    clean = plain(runs[runs["test_noise"] == ""])
    rows = []
    for environment, group in clean.groupby("environment"):
        baseline = group.loc[group["noise"] == "", "mean"]
        for noise, same in group[group["noise"] != ""].groupby("noise"):
            row, _ = compare_rows(f"{environment}, {SHORT[noise]}", same["mean"], baseline)
            rows.append(row)
    table = pd.DataFrame(rows).rename(columns={"p": "p (exact)"})
    return markdown(table.to_dict("series"))


def clean_changes(table):
    """Return {"observation noise": {"Hopper": percent}}: the change of the return without noise."""
    rows = plain(table[table["environment"] != "all"])
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


def own_noise_at_full_rate(conditions):
    """Return the mean returns under the noise of training at p = 1, and those without training.

    {"observation noise": {"Hopper": {"trained": mean, "untrained": mean}}}
    """
    found = {}
    for (noise, environment), rows in conditions.groupby(["test_noise", "environment"]):
        means = rows[rows["test_rate"] == "1.00"].set_index("noise")["mean"]
        if noise in means:
            values = {"trained": means[noise], "untrained": means[""]}
            found.setdefault(SHORT[noise], {})[environment] = values
    return found


def by_noise(table):
    """Return the rows of all environments together as {"observation noise": {column: value}}."""
    rows = table[table["environment"] == "all"]
    return rows.set_index(rows["noise"].map(SHORT)).to_dict("index")


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
    conditions = plain(pd.DataFrame(condition_rows(found)))
    results = [json.loads(path.read_text()) for path in FOLDER.glob("*/result.json")]
    return {
        "runs": len(results),
        "minutes": np.median([result["wall_time_seconds"] for result in results]) / 60,
        "unseen": {
            "table": answers(unseen),
            "environments": by_environment(unseen),
            "harder": harder(unseen),
            **by_noise(unseen),
        },
        "seen": {
            "table": answers(seen),
            "environments": by_environment(seen),
            **by_noise(seen),
        },
        "clean": clean_returns(found),
        "change": clean_changes(unseen),
        "strong": own_noise_at_full_rate(conditions),
        "returns": {name: returns(rows) for name, rows in conditions.groupby("environment")},
    }


def page():
    """Return the text of robustness.md."""
    return render("robustness.md.jinja", numbers())


def draw():
    """Write one figure for each test noise: the return against its rate."""
    table = plain(pd.DataFrame(condition_rows(tests())))
    for noise, rows in table[table["test_noise"] != ""].groupby("test_noise"):
        clean = table[table["test_noise"] == ""]
        _, fig, _ = robustness_curves("PPO", noise, pd.concat([clean, rows]))
        name = SHORT[noise].replace(" ", "_")
        fig.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    draw()
    (HERE / "robustness.md").write_text(page())
    print(f"Wrote {HERE / 'robustness.md'}")
