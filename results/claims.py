"""The tables of results/README.md, from the runs beside it: python results/claims.py.

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
from analyze import make_tables  # noqa: E402
from analyze_compare import PAPER_SEEDS, read_paper  # noqa: E402
from analyze_runs import KEYS, make_studies, read_runs  # noqa: E402

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


def plain(table):
    """Name environments without their version, as in "Hopper"."""
    return table.assign(environment=table["environment"].str.split("-").str[0])


def read_returns(folder):
    """Return final test and training returns of each configuration, as lists over seeds."""
    runs = read_runs(folder).query("status == 'finished'")
    results = [json.loads((folder / run / "result.json").read_text()) for run in runs["run"]]
    runs["test"] = [result["final_return_mean"] for result in results]
    runs["training"] = [result["train_return_mean_last_100"] for result in results]
    return plain(runs).groupby(KEYS)[["test", "training"]].agg(list)


def sample(returns):
    """Describe lists of returns: mean, sample standard deviation and number of each."""
    std = returns.map(lambda values: np.std(values, ddof=1))
    return pd.DataFrame({"mean": returns.map(np.mean), "std": std, "n": returns.map(len)})


def standard_error(*samples):
    """Return the standard error of the samples' means, added or subtracted."""
    return np.sqrt(sum(x["std"] ** 2 / x["n"] for x in samples))


def welch(x, y):
    """Compare samples row by row: the difference in standard errors, and Welch's p."""
    y = y.loc[x.index]
    values = [z[name].to_numpy(float) for z in (x, y) for name in ("mean", "std", "n")]
    p = stats.ttest_ind_from_stats(*values, equal_var=False).pvalue
    return (x["mean"] - y["mean"]) / standard_error(x, y), p


def holm(p):
    """Correct p-values (n,) for n tests with Holm's step-down method."""
    order, adjusted = np.argsort(p), np.empty(len(p))
    adjusted[order] = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1))
    return np.minimum(1, adjusted)


def cells(form, *columns):
    """Write one text for each row of the columns; a dash where a value does not exist."""
    rows = zip(*columns, strict=True)
    return ["\u2013" if pd.isna(row[0]) else form.format(*row) for row in rows]


def spell(x):
    """Write a sample as mean ± standard deviation, with a decimal for returns of two digits."""
    digits = np.where(x["mean"].abs() >= 100, 0, 1)
    return [f"{m:,.{d}f} ± {s:,.{d}f}" for m, s, d in zip(x["mean"], x["std"], digits, strict=True)]


def show(title, columns):
    """Print a dict of columns as a Markdown table; a last one, p, is followed by Holm's."""
    if "p" in columns:
        columns["Holm"] = cells("{:.2g}", holm(columns["p"]))
        columns["p"] = cells("{:.2g}", columns["p"])
    table = pd.DataFrame(columns)
    text = tabulate(table.values, table.columns, "pipe", disable_numparse=True)
    print(f"{title}\n\n{text}\n")


def against_cleanrl(training):
    """Return columns with CleanRL's training returns, and ours minus them in standard errors."""
    columns = {}
    for title, theirs in CLEANRL.items():
        theirs = pd.DataFrame(theirs, index=["mean", "std"]).T.assign(n=3).loc[training.index]
        errors, _ = welch(training, theirs)
        columns[f"{title} (SE)"] = cells("{} ({:+.1f})", spell(theirs), errors)
    return columns


def improvements(table):
    """Return the columns of analyze.py's statistics that compare noise with the baseline."""
    iqm = [table[f"improvement_{name}"] for name in ("iqm_percent", "low", "high")]
    better = [table[f"probability_{name}"] for name in ("of_improvement", "low", "high")]
    return {
        "IQM [95 %]": cells("{:+.1f} % [{:.0f}, {:.0f}]", *iqm),
        "P(improvement) [95 %]": cells("{:.2f} [{:.2f}, {:.2f}]", *better),
    }


studies, _ = make_studies(read_runs(HERE / "runs"))
tables = make_tables(studies, read_paper(HERE / "paper"))
statistics, summary, early = (
    plain(tables[name][0]) for name in ("statistics", "summary_PPO", "compare_early_performance")
)

# ---------------------------------------------------------------------------------- PPO, baselines

ppo = read_returns(HERE / "runs").loc["PPO"].reset_index().set_index("environment")
base = ppo[ppo["noise"] == ""]
noisy = ppo[ppo["noise"] != ""].loc[base.index]
names = base.index
best = pd.read_csv(HERE / "paper/best.csv").query("algorithm == 'PPO'")
best = plain(best).set_index("environment").loc[names].assign(n=PAPER_SEEDS["PPO"])
paper_base, paper_noisy = (
    best[[f"{name}_mean", f"{name}_std", "n"]].set_axis(["mean", "std", "n"], axis=1)
    for name in ("baseline", "noisy")
)

without, training = sample(base["test"]), sample(base["training"])
errors, p = welch(without, paper_base)
show(
    "PPO, baselines: test returns",
    {
        "": names,
        "n": without["n"].array,
        "ours, v5": spell(without),
        "the paper, v2": spell(paper_base),
        "difference in SE": cells("{:+.1f}", errors),
        "p": p,
    },
)
show(
    "PPO, baselines: training returns",
    {"": names, "ours, v5": spell(training), **against_cleanrl(training)},
)
older = read_returns(HERE / "v4").loc["PPO"].reset_index().set_index("environment")
test, training = sample(older["test"]), sample(older["training"])
show(
    "PPO, baselines on v4",
    {
        "": [f"{name}-v4" for name in older.index],
        "n": test["n"].array,
        "test": spell(test),
        "from the paper's in SE": cells("{:+.1f}", welch(test, paper_base)[0]),
        "training": spell(training),
        **against_cleanrl(training),
    },
)

# -------------------------------------------------------------------------- PPO, noise and baseline

with_noise = sample(noisy["test"])
gain, paper_gain = with_noise["mean"] - without["mean"], paper_noisy["mean"] - paper_base["mean"]
errors = (gain - paper_gain) / standard_error(with_noise, without, paper_noisy, paper_base)
tested, changes = (
    table.query("algorithm == 'PPO' and noise != ''").set_index("environment").loc[names]
    for table in (statistics, summary)
)
show(
    "PPO, the paper's best noise",
    {
        "": names,
        "noise": cells("`{}`, rate {:g}", noisy["noise"], noisy["noise_rate"].astype(float)),
        "the paper": cells("{} ({:+.1f} %)", spell(paper_noisy), best["improvement_percent"]),
        "ours": cells("{} ({:+.1f} %)", spell(with_noise), changes["improvement_percent"]),
        "gains differ by SE": cells("{:+.1f}", errors),
        **improvements(tested),
        "p": tested["p"].array,
    },
)
show(
    "PPO, standard deviation over seeds",
    {
        "": names,
        "without noise": cells("{:,.1f}", without["std"]),
        "with noise": cells("{:,.1f}", with_noise["std"]),
        "change": cells("{:+.0f} %", changes["std_change_percent"]),
        "the paper": cells("{:+.0f} %", 100 * (paper_noisy["std"] / paper_base["std"] - 1)),
        "p": [
            stats.levene(x, y, center="median").pvalue
            for x, y in zip(base["test"], noisy["test"], strict=True)
        ],
    },
)
start = summary.query("algorithm == 'PPO' and noise == ''").set_index("environment").loc[names]
show(
    "PPO, first test at which the mean over seeds is at the baseline's final mean",
    {
        "": names,
        "without noise": cells("{:,.0f}", start["steps_to_baseline"]),
        "with noise": cells("{:,.0f}", changes["steps_to_baseline"]),
    },
)

# -------------------------------------------------------------------------- SAC, early performance

early = early.query("steps_millions == 0.2 and n.notna()")
tested = statistics.query("algorithm == 'SAC'").set_index("noise_rate").loc[early["noise_rate"]]
ours = early[["mean", "std", "n"]].astype(float)
paper = early[["paper_mean", "paper_std"]].set_axis(["mean", "std"], axis=1)
errors, p = welch(ours, paper.assign(n=PAPER_SEEDS["SAC"]))
show(
    "SAC on HalfCheetah after 200,000 steps, RandomUniformScaleReward(0.5, 1.5)",
    {
        "noise rate": early["noise_rate"].array,
        "n": cells("{:.0f}", ours["n"]),
        "ours, v5": spell(ours),
        "the paper, v2": spell(paper),
        **improvements(tested),
        "difference from the paper in SE": cells("{:+.1f}", errors),
        "p": p,
    },
)
