"""Reading a folder of runs for analyze.py: which runs count, and which may be compared.

A configuration is a pair (noise, noise_rate), both as text; runs that differ in any setting get
different names of the algorithm. Only finished runs (those with a result.json) count.
"""

import json
import re
from collections import Counter
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd

from noisy_wrappers import MAY_DIFFER_IN_A_TABLE

KEYS = ["algorithm", "environment", "noise", "noise_rate"]
BASELINE = ("", "0.00")  # a configuration is (noise, noise_rate), both as text
EVAL_HEADER = "step,episode,episodic_return,episodic_length\n"
# Arguments that have columns of their own, or may differ; the steps of tests are intersected.
NOT_SETTINGS = {"env_id", "seed", "noise", "noise_rate"} | MAY_DIFFER_IN_A_TABLE
RUN_COLUMNS = ["run", "status", "reason", "base", "phase", *KEYS, "seed", "episodes", "total"]
RUN_COLUMNS += ["settings", "versions", "steps", "returns"]
CHOICE_COLUMNS = [*KEYS[:2], "phase", "round", *KEYS[2:], "seeds", "score", "survives"]
FIRST_CONFIRMATION_SEED = 1001  # of `./benchmark.sh choose`: lower seeds are those of its search


def rate_text(rates):
    """Spell noise rates as the paper does: [] -> "0.00", [0.5, 1] -> "0.50 + 1.00".

    A rate that changes during training, "1.0:0.0", becomes "1.00 to 0.00".
    """
    texts = []
    for rate in rates:
        ends = [float(end) for end in str(rate).split(":")]
        texts.append(" to ".join(f"{r:.2f}" if round(r, 2) == r else f"{r:g}" for r in ends))
    return " + ".join(texts) or BASELINE[1]


def rate_order(text):
    """Sort key of a text from rate_text: (start, end) of each rate, as numbers."""
    ends = [[float(end) for end in rate.split(" to ")] for rate in text.split(" + ")]
    return [(rate[0], rate[-1]) for rate in ends]


def order(config):
    """Sort key of a configuration: by noise, then by rates; the baseline comes first."""
    noise, rate = config
    return noise, rate_order(rate)


def read_config(folder):
    """Read what identifies a run from its config.json."""
    config = json.loads((folder / "config.json").read_text())
    args = config["args"]
    commit = str(config.get("git_commit"))  # 40 digits, perhaps with "-dirty"
    versions = {
        **config["versions"],
        "matmul precision": config.get("matmul_precision"),
        "git commit": commit[:10] + commit[40:],
    }
    for name, value in (("algorithm", config["algorithm"]), ("env_id", args["env_id"])):
        if not isinstance(value, str):
            raise ValueError(f"config.json: {name} is {value!r}")
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
        "versions": versions,
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


def read_run(folder):
    """Read one run folder: a dict with some of RUN_COLUMNS."""
    row = {"run": folder.name}
    try:
        row |= read_config(folder)
        if not (folder / "result.json").exists():
            reason = f"no result.json; {progress(folder)}"
            return row | {"status": "unfinished", "reason": reason}
        result = json.loads((folder / "result.json").read_text())
        steps, returns = read_evaluations(folder, row["episodes"], row["total"])
        if not np.isclose(returns[-1], result["final_return_mean"], rtol=1e-3, atol=1e-3):
            raise ValueError("eval.csv and result.json disagree on the final return")
        return row | {"status": "finished", "steps": steps, "returns": returns}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return row | {"status": "corrupt", "reason": reason}


def is_run(folder):
    """Tell run folders from others, such as the logs of a sweep."""
    return folder.is_dir() and ("__" in folder.name or (folder / "config.json").exists())


def read_runs(runs_dir):
    """Read all run folders; `status` is finished, unfinished, corrupt, duplicate or failed.

    For the algorithms and environments in the choice.csv of `./benchmark.sh choose`, `phase` is
    search or confirmation, by the seed; for others it is empty.
    """
    runs_dir = Path(runs_dir)
    rows = [read_run(folder) for folder in sorted(runs_dir.iterdir()) if is_run(folder)]
    rows += failed_without_a_folder(runs_dir)
    runs = pd.DataFrame(rows, columns=RUN_COLUMNS, dtype=object)
    runs["phase"] = ""
    choice = read_choice(runs_dir)
    if choice is not None:
        chosen = set(zip(choice["algorithm"], choice["environment"], strict=True))
        pairs = zip(runs["base"], runs["environment"], strict=True)
        fresh = runs["seed"].fillna(0) >= FIRST_CONFIRMATION_SEED
        phases = np.where(fresh, "confirmation", "search")
        runs["phase"] = np.where([pair in chosen for pair in pairs], phases, "")
    for base, group in runs.groupby("base"):
        runs.loc[group.index, "algorithm"] = labels(base, group)
    twice = (runs["status"] == "finished") & runs.duplicated(["status", *KEYS, "seed"])
    runs.loc[twice, ["status", "reason"]] = ["duplicate", "same configuration and seed as another"]
    return runs


def failed_without_a_folder(runs_dir):
    """Return the runs of a sweep that failed before they wrote anything: only their logs tell."""
    rows = []
    for path in sorted(runs_dir.glob("logs/*__*.log")):
        # benchmark.sh frames a run's output by lines with "#"; "(" begins notes below a traceback
        lines = path.read_text(errors="replace").splitlines()
        told = [line for line in lines if line.strip() and not line.startswith(("# ", "("))]
        if not (runs_dir / path.stem).exists() and told:
            rows.append({"run": path.stem, "status": "failed", "reason": told[-1].strip()})
    return rows


def read_choice(runs_dir):
    """Read the choice.csv of `./benchmark.sh choose`, or return None where there is none.

    Raises ValueError for a file with other columns.
    """
    path = Path(runs_dir) / "choice.csv"
    if not path.exists():
        return None
    text = dict.fromkeys(("round", "noise", "noise_rate", "survives"), str)
    choice = pd.read_csv(path, dtype=text, keep_default_na=False)
    if list(choice.columns) != CHOICE_COLUMNS:
        raise ValueError(f"{path} does not have the columns {','.join(CHOICE_COLUMNS)}")
    choice["noise_rate"] = [rate_text(rates.split(" + ")) for rates in choice["noise_rate"]]
    return choice


def labels(base, group):
    """Name each run's algorithm so that runs with different settings never share a row.

    It is the plain name (SAC) unless runs differ in settings, or there is a newer version of the
    environment, or noise was chosen; then it says what differs (SAC [total_timesteps=100000]).
    """
    settings = {text: json.loads(text) for text in set(group["settings"])}
    differing = []
    for name in sorted(set().union(*settings.values())):
        if len({str(values.get(name)) for values in settings.values()}) > 1:
            differing.append(name)
    versions = [split_version(environment) for environment in group["environment"]]
    newest = {name: "" for name, _ in versions}
    for name, version in versions:
        newest[name] = max(newest[name], version, key=lambda text: int(text or -1))
    result = []
    for run in group.itertuples():
        parts = [f"{name}={settings[run.settings].get(name)}" for name in differing]
        env, version = split_version(run.environment)
        if version != newest[env]:
            parts.append(f"environments v{version}")
        if run.phase:
            parts.append(run.phase)
        result.append(f"{base} [{', '.join(parts)}]" if parts else base)
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
    """List seeds that a configuration lacks in an environment: those that most others have.

    That is, at least half of the algorithm's configurations with noise have them, each environment
    counted apart. An environment in which anything was run should have the baseline with these
    seeds. The search of `./benchmark.sh choose` gives few noises many seeds: nothing is missing.
    """
    rows = []
    for algorithm, group in runs[runs["base"].notna()].groupby("algorithm"):
        if group["phase"].iloc[0] == "search":
            continue
        cells = group.groupby(KEYS[1:])["seed"].agg(set).to_dict()
        baselines = {(env, *BASELINE) for env, _, _ in cells}
        usual = [seeds for key, seeds in cells.items() if key not in baselines]
        if not usual:
            usual = list(cells.values())
        counts = Counter(seed for seeds in usual for seed in seeds)
        expected = {seed for seed, n in counts.items() if 2 * n >= len(usual)}
        for key in sorted(cells.keys() | baselines, key=lambda key: (key[0], order(key[1:]))):
            for seed in sorted(expected - cells.get(key, set())):
                rows.append((algorithm, *key, int(seed), "missing", "no run folder"))
    return pd.DataFrame(rows, columns=[*KEYS, "seed", "status", "reason"])


def left_out(runs):
    """List all runs that are in no table: one row per configuration and status.

    Also return a Counter with the number of these runs by status. Seeds are ranges ("1-5, 7"). A
    run whose config.json cannot be read has a row of its own.
    """
    out = pd.concat([runs[runs["status"] != "finished"], missing_runs(runs)], ignore_index=True)
    rows = []
    nameless = out["run"].where(out["base"].isna())
    keys = [out["status"], *(out[name] for name in KEYS), nameless.fillna("")]
    for (status, *config, _), group in out.groupby(keys, sort=False, dropna=False):
        rows.append(
            {
                "status": status,
                **dict(zip(KEYS, config, strict=True)),
                "seeds": ranges(group["seed"].dropna()),
                "run": few(group["run"].dropna()),
                "reason": few(group["reason"]),
            }
        )
    table = pd.DataFrame(rows, columns=["status", *KEYS, "seeds", "run", "reason"])
    return table, Counter(out["status"])


def few(texts):
    """Join one or two different texts; of more, give the first and the number of the others."""
    different = list(dict.fromkeys(texts))
    if len(different) > 2:
        return f"{different[0]} and {len(different) - 1} more"
    return ", ".join(different)


def ranges(numbers):
    """Write whole numbers as ranges: [1, 2, 3, 5] -> "1-3, 5"."""
    parts = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in parts)


@dataclass
class Study:
    """The finished runs that may be compared: one algorithm with one set of settings."""

    algorithm: str
    base: str
    phase: str  # of `./benchmark.sh choose`: search, confirmation, or empty
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
        base, phase = group[["base", "phase"]].iloc[0]
        for env, values in zip(envs, returns[BASELINE][-1].T, strict=True):
            if np.isnan(values).all() and phase != "search":
                notes.append(f"{algorithm}: no finished baseline on {env}, so no improvement there")
        notes += version_notes(algorithm, group["versions"])
        studies.append(Study(algorithm, base, phase, envs, seeds, grid, returns))
    return studies, notes


def version_notes(algorithm, versions):
    """Say in words where runs of one algorithm differ in versions of code or libraries."""
    notes = []
    for name in sorted(set().union(*versions)):
        counts = Counter(str(version.get(name)) for version in versions)
        if len(counts) > 1:
            found = ", ".join(f"{version} (n = {n})" for version, n in sorted(counts.items()))
            what = f"with different {name}"
            if name == "git commit":
                what = "of different code versions"
            notes.append(f"{algorithm}: some rows average runs {what}: {found}")
    return notes
