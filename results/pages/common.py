"""What the scripts of the pages share: reading runs, comparing samples, writing tables and text."""

import json
import sys
from pathlib import Path

import jinja2
import numpy as np
import pandas as pd
from scipy import stats
from tabulate import tabulate

RESULTS = Path(__file__).resolve().parent.parent
DATA = RESULTS / "data"
FEW_SEEDS = range(1, 6)
FIXED_SEEDS = range(1, 11)
ENVIRONMENTS = ["HalfCheetah", "Hopper", "Humanoid", "Pusher", "Walker2d"]  # without version
sys.path.insert(0, str(RESULTS.parent))
from analysis.runs import KEYS, read_runs  # noqa: E402
from analysis.statistics import (  # noqa: E402
    holm,
    improvement_percent,
    mann_whitney,
    satterthwaite,
)


def plain(table):
    """Name environments without their version, as in "Hopper"."""
    return table.assign(environment=table["environment"].str.split("-").str[0])


def read_returns(folder):
    """Return one row per finished run: its configuration, seed, test and training return.

    `error` is the variance that the test's few episodes give the test return.
    """
    runs = read_runs(folder).query("status == 'finished'").copy()
    results = [json.loads((folder / run / "result.json").read_text()) for run in runs["run"]]
    runs["test"] = [result["final_return_mean"] for result in results]
    runs["training"] = [result["train_return_mean_last_100"] for result in results]
    runs["error"] = [test_error(folder / run) for run in runs["run"]]
    return plain(runs)[[*KEYS, "seed", "test", "training", "error"]]


def test_error(run):
    """Return the variance of the mean over the episodes of a run's last test."""
    table = pd.read_csv(run / "eval.csv")
    returns = table.loc[table["step"] == table["step"].max(), "episodic_return"]
    return returns.var(ddof=1) / len(returns)


def variance_share(runs):
    """Return the percent of the variance between seeds that the test's few episodes make."""
    environments = runs.groupby("environment")
    return 100 * environments["error"].mean() / environments["test"].var(ddof=1)


def sample(runs, column):
    """Describe the runs of each environment: mean, sample standard deviation and number."""
    groups = runs.groupby("environment")[column]
    return pd.DataFrame({"mean": groups.mean(), "std": groups.std(ddof=1), "n": groups.size()})


def standard_error(*samples):
    """Return the standard error of the samples' means, added or subtracted."""
    return np.sqrt(sum(x["std"] ** 2 / x["n"] for x in samples))


def welch_interval(x, y):
    """Return the 95 % interval of the difference of the samples' means, row by row."""
    sizes = np.array([x["n"], y["n"]])
    _, half = satterthwaite([z["std"] ** 2 / z["n"] for z in (x, y)], sizes)
    difference = x["mean"] - y["mean"]
    return difference - half, difference + half


def welch(x, y):
    """Compare samples row by row: the difference in standard errors, and Welch's p."""
    y = y.loc[x.index]
    values = [z[name].to_numpy(float) for z in (x, y) for name in ("mean", "std", "n")]
    p = stats.ttest_ind_from_stats(*values, equal_var=False).pvalue
    return (x["mean"] - y["mean"]) / standard_error(x, y), p


def compare_rows(name, x, y):
    """Compare samples x and y of test returns: a row of a table, and its numbers.

    They are the number `n` of x, the exact p, the `difference` of the means with its interval `low`
    to `high`, and the same in percent of the mean of y: `percent`, `low_percent`, `high_percent`.
    """
    p, _ = mann_whitney(np.array(x)[:, None], np.array(y)[:, None])
    mean, other = np.mean(x), np.mean(y)
    percent = improvement_percent(mean, other)
    low, high = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    d = 0 if abs(other) >= 100 else 1  # decimals, as in spell
    row = {
        "": name,
        "n": f"{len(x)}, {len(y)}",
        "first": f"{mean:,.{d}f} ± {np.std(x, ddof=1):,.{d}f}",
        "second": f"{other:,.{d}f} ± {np.std(y, ddof=1):,.{d}f}",
        "difference [95 %]": f"{mean - other:+,.{d}f} [{low:,.{d}f}, {high:,.{d}f}]",
        "of the second": f"{percent:+.1f} %",
        "p": f"{p:.2g}",
    }
    numbers = {"p": p, "percent": percent, "difference": mean - other}
    numbers |= {"low": low, "high": high, "n": len(x)}
    return row, numbers | {f"{k}_percent": 100 * numbers[k] / abs(other) for k in ("low", "high")}


def cells(form, *columns):
    """Write one text for each row of the columns; a dash where a value does not exist."""
    rows = zip(*columns, strict=True)
    return ["\u2013" if pd.isna(row[0]) else form.format(*row) for row in rows]


def spelled(rows, columns):
    """Write columns of a frame: {title: (format, names of columns...)} -> {title: texts}."""
    return {
        title: cells(form, *(rows[name] for name in names))
        for title, (form, *names) in columns.items()
    }


def spell(x):
    """Write a sample as mean ± standard deviation, with a decimal for returns of two digits."""
    digits = np.where(x["mean"].abs() >= 100, 0, 1)
    return [f"{m:,.{d}f} ± {s:,.{d}f}" for m, s, d in zip(x["mean"], x["std"], digits, strict=True)]


def by_environment(runs, seeds):
    """Return the test returns of these seeds: a row per seed, a column per environment."""
    chosen = runs[runs["seed"].isin(list(seeds))]
    return chosen.pivot(index="seed", columns="environment", values="test").reindex(
        columns=ENVIRONMENTS
    )


def spell_average(row):
    """Write a row of the paper's averages over environments: mean ± standard deviation."""
    average, std = row["average_improvement_percent"], row["std_improvement_percent"]
    return f"{average:+.0f} ± {std:.0f} %"


def markdown(columns):
    """Write columns, or a list of dicts, as a Markdown table; after numbers "p" comes "Holm"."""
    table = pd.DataFrame(columns)
    if "p" in table:
        table["Holm"] = cells("{:.2g}", holm(table["p"].to_numpy(float)))
        table["p"] = cells("{:.2g}", table["p"])
    return tabulate(table.values, table.columns, "pipe", disable_numparse=True)


def uncorrected(rows):
    """Write rows of compare_rows as a Markdown table, without a column for Holm's p."""
    return markdown(pd.DataFrame(rows).rename(columns={"p": "p (exact)"}))


def render(template, values):
    """Return the text of a Jinja template in this folder with these values."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    filters = {
        "p": lambda x: f"{x:.2g}",
        "g": lambda x: f"{x:g}",
        "whole": lambda x: f"{x:,.0f}",
        "tenth": lambda x: f"{x:.1f}",
        "signed": lambda x: f"{x:+.1f}",
        "signed_whole": lambda x: f"{x:+,.0f}",
    }
    options = {"undefined": jinja2.StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(loader=loader, keep_trailing_newline=True, **options)
    environment.filters |= filters
    return environment.get_template(template).render(values)
