"""The returns of the runs in results/data, one row a run."""

from pathlib import Path

import pandas as pd

from analysis.folders import read_run

RESULTS = Path(__file__).parents[1]
DATA = RESULTS / "data"
ENVIRONMENTS = ["HalfCheetah", "Hopper", "Humanoid", "Pusher", "Walker2d"]


def read_returns(*names, step=None):
    """Return the finished runs in these folders of data/.

    Columns: folder, algorithm ("PPO"), environment ("Hopper"), version ("v5"), noise (as in
    "RandomNormalNoisyReward(1.0)", several joined by " + ", "" without noise), rate (a text, too),
    seed, steps (of training), test: the mean test return at the end, or after `step` steps, and
    training: the mean of the last 100 training episodes.
    """
    rows = []
    for name in names:
        for path in sorted((DATA / name).rglob("result.json")):
            run = read_run(path.parent, with_curve=step is not None)
            environment, version = run.environment.split("-")
            noise, rate = run.configuration.columns
            row = {"folder": name, "algorithm": run.algorithm}
            row |= {"environment": environment, "version": version}
            row |= {"noise": noise, "rate": rate if noise else ""}
            row |= {"seed": run.seed, "steps": run.total_timesteps}
            row["test"] = run.result["final_return_mean"]
            if step is not None:
                row["test"] = curve_of(run)[step]
            rows.append(row | {"training": run.result["train_return_mean_last_100"]})
    return pd.DataFrame(rows)


def curve_of(run):
    """Return the mean test returns of a Run, indexed by step."""
    return pd.Series(run.curve.returns, index=run.curve.steps)


def each_run_once(runs):
    """Drop runs that another folder has, too: all settings, the seed and the return are equal.

    Two batches share them where they ran the same seeds at commits that compute the same.
    """
    same = ["algorithm", "environment", "version", "noise", "rate", "seed", "steps", "test"]
    return runs.drop_duplicates(same)


def select(runs, algorithm, environment, noise="", rate=""):
    """Return the test returns of one configuration, in the order of the seeds."""
    found = runs[
        (runs["algorithm"] == algorithm)
        & (runs["environment"] == environment)
        & (runs["noise"] == noise)
        & (runs["rate"] == rate)
    ]
    return found.sort_values("seed")["test"].to_numpy()
