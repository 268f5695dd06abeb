"""Reading a folder of runs for analyze.py: which runs count, and which may be compared.

A configuration is a pair (noise, noise_rate), both as text; runs that differ in any setting get
different names of the algorithm. Only finished runs (those with a result.json) count.
"""

import json
import re
from dataclasses import dataclass
from functools import reduce
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

KEYS = ["algorithm", "environment", "noise", "noise_rate"]
BASELINE = ("", "0.00")  # a configuration is (noise, noise_rate), both as text
EVAL_HEADER = "step,episode,episodic_return,episodic_length\n"
# Arguments that do not change what is learned; the grids of evaluation steps are intersected.
NOT_SETTINGS = {"env_id", "seed", "noise", "noise_rate", "runs_dir", "overwrite", "cuda", "compile"}
NOT_SETTINGS |= {"torch_threads", "checkpoint_frequency", "eval_frequency"}
RUN_COLUMNS = ["run", "status", "reason", "base", *KEYS, "seed", "episodes", "total", "settings"]
RUN_COLUMNS += ["versions", "steps", "returns"]


def rate_text(rates):
    """Spell noise rates as the paper does: [] -> "0.00", [0.5, 1] -> "0.50 + 1.00"."""
    texts = [f"{r:.2f}" if round(r, 2) == r else f"{r:g}" for r in map(float, rates)]
    return " + ".join(texts) or BASELINE[1]


def read_config(folder):
    """Read what identifies a run from its config.json."""
    config = json.loads((folder / "config.json").read_text())
    args, commit = config["args"], str(config.get("git_commit"))
    settings = {name: value for name, value in args.items() if name not in NOT_SETTINGS}
    return {
        "base": config["algorithm"],
        "environment": args["env_id"],
        "noise": " + ".join(args["noise"]),
        "noise_rate": rate_text(args["noise_rate"]),
        "seed": int(args["seed"]),
        "episodes": int(args["eval_episodes"]),
        "total": int(args["total_timesteps"]),
        "settings": json.dumps(settings, sort_keys=True),
        "versions": config["versions"]
        | {"matmul precision": config.get("matmul_precision")}
        | {"git commit": commit[:10] + commit[40:]},  # of 40 digits, perhaps with "-dirty"
    }


def read_evaluations(folder, episodes, total):
    """Read eval.csv: the evaluation steps and the mean return over the episodes of each.

    Raises ValueError unless every evaluation is whole, in order, and the last is at step `total`.
    """
    text = (folder / "eval.csv").read_text()
    if not text.startswith(EVAL_HEADER):
        raise ValueError("eval.csv: unexpected header")
    if not text.endswith("\n"):
        raise ValueError("eval.csv: the last line is half-written")
    if len(text) == len(EVAL_HEADER):
        raise ValueError("eval.csv: no evaluation")
    rows = np.loadtxt(folder / "eval.csv", delimiter=",", skiprows=1, ndmin=2, comments=None)
    if rows.shape[1] != 4 or len(rows) % episodes or not np.isfinite(rows).all():
        raise ValueError("eval.csv: incomplete or non-numeric lines")
    step, episode, episodic_return, _ = np.moveaxis(rows.reshape(-1, episodes, 4), 2, 0)
    if (episode != np.arange(episodes)).any() or (step != step[:, :1]).any():
        raise ValueError("eval.csv: an evaluation is incomplete")
    if (np.diff(step[:, 0]) <= 0).any() or step[-1, 0] != total:
        raise ValueError(f"eval.csv: steps do not ascend to {total}")
    return step[:, 0].astype(int), episodic_return.mean(axis=1)


def read_runs(runs_dir):
    """Read all run folders; `status` is finished, unfinished, corrupt or duplicate."""
    rows = []
    for folder in sorted(path for path in Path(runs_dir).iterdir() if path.is_dir()):
        if "__" not in folder.name and not (folder / "config.json").exists():
            continue  # the logs of a sweep, say
        row = {"run": folder.name, "status": "corrupt"}
        rows.append(row)
        try:
            row |= read_config(folder)
            if not (folder / "result.json").exists():
                row |= {"status": "unfinished", "reason": f"no result.json; {progress(folder)}"}
                continue
            result = json.loads((folder / "result.json").read_text())
            steps, returns = read_evaluations(folder, row["episodes"], row["total"])
            if not np.isclose(returns[-1], result["final_return_mean"], rtol=1e-3, atol=1e-3):
                raise ValueError("eval.csv and result.json disagree on the final return")
            row |= {"status": "finished", "steps": steps, "returns": returns}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
            row["reason"] = " ".join(f"{type(error).__name__}: {error}".split())
    runs = pd.DataFrame(rows, columns=RUN_COLUMNS, dtype=object)
    for base, group in runs.groupby("base"):
        runs.loc[group.index, "algorithm"] = labels(base, group)
    twice = (runs["status"] == "finished") & runs.duplicated(["status", *KEYS, "seed"])
    runs.loc[twice, ["status", "reason"]] = ["duplicate", "same configuration and seed as another"]
    return runs


def labels(base, group):
    """Name each run's algorithm so that runs with different settings never share a row.

    It is the plain name (SAC) unless runs differ in settings, or there is a newer version of the
    environment; then it says what differs (SAC [total_timesteps=100000]).
    """
    settings = {text: json.loads(text) for text in set(group["settings"])}
    names = sorted(set().union(*settings.values()))
    names = [n for n in names if len({str(values.get(n)) for values in settings.values()}) > 1]
    newest = {}
    for env, version in map(split_version, group["environment"]):
        newest[env] = max(newest.get(env, ""), version, key=lambda text: int(text or 0))
    result = []
    for text, env in zip(group["settings"], group["environment"], strict=True):
        parts = [f"{name}={settings[text].get(name)}" for name in names]
        name, version = split_version(env)
        parts += [f"environments v{version}"] if version != newest[name] else []
        result.append(base + (f" [{', '.join(parts)}]" if parts else ""))
    return result


def split_version(environment):
    """Split "Hopper-v5" into ("Hopper", "5"); an id without a version gives "" for it."""
    return re.fullmatch(r"(.*?)(?:-v(\d+))?", environment).groups("")


def progress(folder):
    """Say in words how far an unfinished run is."""
    try:
        last = (folder / "eval.csv").read_text().rsplit("\n", 2)[-2]
        return f"evaluated up to step {int(last.split(',')[0]):,}"
    except (OSError, ValueError, IndexError):
        return "no evaluation yet"


def missing_runs(runs):
    """List the seeds that a configuration lacks in an environment and that other runs have.

    An environment in which anything was run should have the baseline.
    """
    rows = []
    for algorithm, group in runs[runs["base"].notna()].groupby("algorithm"):
        found = set(group[[*KEYS[1:], "seed"]].itertuples(index=False, name=None))
        wanted = {(env, *config) for env, *config, _ in found for config in (config, BASELINE)}
        wanted = sorted(wanted, key=lambda key: (key[0], order(key[1:])))
        for key, seed in product(wanted, sorted(set(group["seed"]))):
            if (*key, seed) not in found:
                rows.append((algorithm, *key, int(seed), "missing", "no run folder"))
    return pd.DataFrame(rows, columns=[*KEYS, "seed", "status", "reason"])


def order(config):
    """Sort key of a configuration: by noise, then by rates as numbers; the baseline comes first."""
    return config[0], [float(rate) for rate in config[1].split(" + ")]


@dataclass
class Study:
    """The finished runs that may be compared: one algorithm with one set of settings."""

    algorithm: str
    base: str
    environments: list
    seeds: list
    steps: np.ndarray  # the evaluation steps that all runs share
    returns: dict  # (noise, noise_rate) -> array (steps x seeds x envs), NaN where there is no run

    def final(self, config):
        """Return the (seeds x envs) array of final test returns."""
        return self.returns[config][-1]


def make_studies(runs):
    """Arrange the finished runs into a list of Study, and list in words what had to be cut."""
    studies, notes = [], []
    finished = runs[runs["status"] == "finished"]
    for algorithm, group in finished.groupby("algorithm"):
        grids = list({steps.tobytes(): steps for steps in group["steps"]}.values())
        grid = reduce(np.intersect1d, grids)
        longest = max(map(len, grids))
        if len(grid) < longest:
            notes.append(
                f"{algorithm}: runs differ in their evaluation steps; curves are cut to the "
                f"{len(grid)} steps that all share (of up to {longest})"
            )
        envs, seeds = sorted(set(group["environment"])), sorted(set(group["seed"]))
        configs = {*zip(group["noise"], group["noise_rate"], strict=True), BASELINE}
        shape = (len(grid), len(seeds), len(envs))
        returns = {config: np.full(shape, np.nan) for config in sorted(configs, key=order)}
        for run in group.itertuples():
            place = seeds.index(run.seed), envs.index(run.environment)
            shared = np.isin(run.steps, grid)
            returns[run.noise, run.noise_rate][:, *place] = run.returns[shared]
        for env, values in zip(envs, returns[BASELINE][-1].T, strict=True):
            if np.isnan(values).all():
                notes.append(f"{algorithm}: no finished baseline on {env}, so no improvement there")
        for name in sorted(set().union(*group["versions"])):
            counts = group["versions"].map(lambda v, k=name: str(v.get(k))).value_counts()
            if len(counts) > 1:
                found = ", ".join(f"{version} (n = {n})" for version, n in sorted(counts.items()))
                notes.append(f"{algorithm}: runs with different {name} share rows: {found}")
        base = group["base"].iloc[0]
        studies.append(Study(algorithm, base, envs, seeds, grid, returns))
    return studies, notes
