"""The tables of results/README.md, from these runs and the tables beside: python results/claims.py.

The comparisons were fixed before the runs, one in each row. So p-values are corrected with Holm's
method over the rows; analyze.py corrects within an environment, for the choice of its best noise.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats
from tabulate import tabulate

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from analyze import KEYS, PAPER_SEEDS, read_runs  # noqa: E402

# Training returns of PPO in CleanRL's documentation, mean and standard deviation of three seeds:
# the first two at commit 2d660b6 (October 2023), the last since commit 35896b1 (November 2023).
CLEANRL = {
    "CleanRL, v2": {
        "HalfCheetah": (2262.50, 1196.81),
        "Hopper": (2311.49, 440.99),
        "Humanoid": (676.34, 78.68),
        "Pusher": (-60.49, 4.37),
        "Walker2d": (3312.32, 429.87),
    },
    "CleanRL, v4": {
        "HalfCheetah": (2905.85, 1129.37),
        "Hopper": (2051.80, 313.94),
        "Humanoid": (742.19, 155.77),
        "Pusher": (-55.60, 3.98),
        "Walker2d": (2890.97, 231.40),
    },
    "CleanRL, v4, newer": {
        "HalfCheetah": (1442.64, 46.03),
        "Hopper": (2382.86, 271.74),
        "Humanoid": (716.11, 49.08),
        "Pusher": (-40.38, 7.15),
        "Walker2d": (2287.95, 571.78),
    },
}


def read(name):
    """Read a table of this folder by configuration; no noise is "", and rates are text."""
    table = pd.read_csv(HERE / f"{name}.csv", dtype={"noise_rate": str})
    return table.fillna({"noise": ""}).set_index(KEYS)


def holm(p):
    """Correct p-values (n,) for n tests with Holm's step-down method."""
    order, adjusted = np.argsort(p), np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1, adjusted)


def describe(returns):
    """Return mean, sample standard deviation and number of lists of returns, as three arrays."""
    return np.array([(np.mean(x), np.std(x, ddof=1), len(x)) for x in returns]).T


def standard_error(*samples):
    """Return the standard error of a sum of means, from samples (mean, standard deviation, n)."""
    return np.sqrt(sum(std**2 / n for _, std, n in samples))


def spell(mean, std, *_):
    """Write means ± standard deviations, with a decimal for returns of two digits."""
    digits = np.where(np.abs(mean) >= 100, 0, 1)
    return [f"{m:,.{d}f} ± {s:,.{d}f}" for m, s, d in zip(mean, std, digits, strict=True)]


def cells(form, *columns):
    """Write a text for each row of the columns."""
    return [form.format(*values) for values in zip(*columns, strict=True)]


def show(title, columns):
    """Print a dict of columns as a Markdown table; a last one, p, is followed by Holm's."""
    if "p" in columns:
        columns["Holm"] = cells("{:.2g}", holm(columns["p"]))
        columns["p"] = cells("{:.2g}", columns["p"])
    text = tabulate(columns, "keys", "pipe", disable_numparse=True)
    print(f"{title}\n\n{text}\n")


runs = read_runs(HERE / "runs")
results = [json.loads((HERE / "runs" / run / "result.json").read_text()) for run in runs["run"]]
runs["test"] = [result["final_return_mean"] for result in results]
runs["training"] = [result["train_return_mean_last_100"] for result in results]
table = runs.groupby(KEYS)[["test", "training"]].agg(list)
for name in ("summary_PPO", "statistics", "compare_best"):
    table = table.join(read(name).drop(columns=table.columns, errors="ignore"))
table = table.loc["PPO"].reset_index()
table.index = table["environment"].str.split("-").str[0]
base, noisy = table[table["noise"] == ""], table[table["noise"] != ""]
names = list(base.index)

without, with_noise, training = map(describe, (base["test"], noisy["test"], base["training"]))
paper_without, paper_noise = (
    np.array([part["paper_mean"], part["paper_std"], [PAPER_SEEDS["PPO"]] * len(part)])
    for part in (base, noisy)
)
show(
    "PPO, baselines: test returns",
    {
        "": names,
        "n": cells("{:.0f}", without[2]),
        "ours, v5": spell(*without),
        "the paper, v2": spell(*paper_without),
        "difference in SE": cells("{:+.1f}", base["difference_se"]),
        "p": stats.ttest_ind_from_stats(*without, *paper_without, equal_var=False).pvalue,
    },
)
columns = {"": names, "ours, v5": spell(*training)}
for title, theirs in CLEANRL.items():
    theirs = np.array([(*theirs[name], 3) for name in names]).T
    errors = (training - theirs)[0] / standard_error(training, theirs)
    columns[f"{title} (SE)"] = cells("{} ({:+.1f})", spell(*theirs), errors)
show("PPO, baselines: training returns", columns)

best = pd.read_csv(HERE / "paper/best.csv").query("algorithm == 'PPO'")
gain, paper_gain = (with_noise - without)[0], (paper_noise - paper_without)[0]
errors = (gain - paper_gain) / standard_error(with_noise, without, paper_noise, paper_without)
show(
    "PPO, the paper's best noise",
    {
        "": names,
        "noise": cells("`{}`, p = {:g}", noisy["noise"], noisy["noise_rate"].astype(float)),
        "the paper": cells("{:+.1f} %", best["improvement_percent"]),
        "ours": cells("{:+.1f} %", noisy["improvement_percent"]),
        "difference in SE": cells("{:+.1f}", errors),
        "with noise": spell(*with_noise),
        "IQM [95 %]": cells(
            "{:+.1f} % [{:.0f}, {:.0f}]",
            *(noisy[f"improvement_{name}"] for name in ("iqm_percent", "low", "high")),
        ),
        "P(improvement) [95 %]": cells(
            "{:.2f} [{:.2f}, {:.2f}]",
            *(noisy[f"probability_{name}"] for name in ("of_improvement", "low", "high")),
        ),
        "p": noisy["p"].array,
    },
)
show(
    "PPO, standard deviation over seeds (test of Brown and Forsythe)",
    {
        "": names,
        "without noise": cells("{:,.1f}", without[1]),
        "with noise": cells("{:,.1f}", with_noise[1]),
        "change": cells("{:+.0f} %", noisy["std_change_percent"]),
        "p": [
            stats.levene(x, y, center="median").pvalue
            for x, y in zip(base["test"], noisy["test"], strict=True)
        ],
    },
)
show(
    "PPO, first test at which the mean over seeds reaches the baseline's final mean",
    {
        "": names,
        "without noise": cells("{:,.0f}", base["steps_to_baseline"]),
        "with noise": noisy["steps_to_baseline"].map("{:,.0f}".format).replace("nan", "never"),
    },
)

# ------------------------------------------------------------------------- SAC, early performance

early = read("compare_early_performance").loc["SAC"].dropna(subset="n").reset_index()
ours = early[["mean", "std", "n"]].T.to_numpy(float)
paper = np.array([early["paper_mean"], early["paper_std"], [PAPER_SEEDS["SAC"]] * len(early)])
show(
    "SAC on HalfCheetah after 200,000 steps, RandomUniformScaleReward(0.5, 1.5)",
    {
        "noise rate": early["noise_rate"],
        "n": cells("{:.0f}", ours[2]),
        "ours, v5": spell(*ours),
        "the paper, v2": spell(*paper),
        "difference in SE": cells("{:+.1f}", early["difference_se"]),
        "p": stats.ttest_ind_from_stats(*ours, *paper, equal_var=False).pvalue,
    },
)
