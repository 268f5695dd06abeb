"""Reading a folder of runs for analyze.py: which runs count, and which may be compared.

Runs that may be compared are a study: they have the same algorithm and settings and are of the same
phase of a choice. Only finished runs (those with a result.json) count.
"""

import json
import re
from collections import Counter
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd

from noisy_wrappers import BASELINE, MAY_DIFFER_IN_A_TABLE, Configuration

STUDY = ["algorithm", "settings", "phase"]  # the columns that name a study: see study_name
KEYS = [*STUDY, "environment", "noise", "noise_rate"]
EVAL_HEADER = "step,episode,episodic_return,episodic_length\n"
# Arguments that have columns of their own, or may differ; the steps of tests are intersected.
NOT_SETTINGS = {"env_id", "seed", "noise", "noise_rate"} | MAY_DIFFER_IN_A_TABLE
RUN_COLUMNS = ["run", "status", "reason", *KEYS, "configuration", "seed", "episodes", "total"]
RUN_COLUMNS += ["arguments", "versions", "steps", "returns"]
CHOICE_COLUMNS = ["algorithm", "environment", "phase", "round", "noise", "noise_rate"]
CHOICE_COLUMNS += ["seeds", "score", "survives"]
ROBUSTNESS_COLUMNS = ["noise", "noise_rate", "episode", "episodic_return", "episodic_length"]
FIRST_CONFIRMATION_SEED = 1001  # of `./benchmark.sh choose`: lower seeds are those of its search


def study_name(algorithm, settings="", phase=""):
    """Name a study for people: "SAC", or "SAC [gamma=0.9, search]"."""
    parts = [part for part in (settings, phase) if part]
    return f"{algorithm} [{', '.join(parts)}]" if parts else algorithm


def rows_of(table, key):
    """Tell which rows of a table are about one study; `key` has the values of STUDY."""
    return pd.MultiIndex.from_frame(table[STUDY]).isin([tuple(key)])


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
    configuration = Configuration.stored(args["noise"], args["noise_rate"])
    return {
        "algorithm": config["algorithm"],
        "environment": args["env_id"],
        "noise": configuration.noise,
        "noise_rate": configuration.noise_rate,
        "configuration": configuration,
        "seed": int(args["seed"]),
        "episodes": int(args["eval_episodes"]),
        "total": int(args["total_timesteps"]),
        "arguments": json.dumps(settings, sort_keys=True),
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

    `settings` says what sets a run apart from others of its algorithm (differing_settings). For the
    algorithms and environments in the choice.csv of `./benchmark.sh choose`, `phase` is search or
    confirmation, by the seed; for others it is empty.
    """
    runs_dir = Path(runs_dir)
    rows = [read_run(folder) for folder in sorted(runs_dir.iterdir()) if is_run(folder)]
    rows += failed_without_a_folder(runs_dir)
    runs = pd.DataFrame(rows, columns=RUN_COLUMNS, dtype=object)
    runs["phase"] = ""
    choice = read_choice(runs_dir)
    if choice is not None:
        chosen = set(zip(choice["algorithm"], choice["environment"], strict=True))
        pairs = zip(runs["algorithm"], runs["environment"], strict=True)
        fresh = runs["seed"].fillna(0) >= FIRST_CONFIRMATION_SEED
        phases = np.where(fresh, "confirmation", "search")
        runs["phase"] = np.where([pair in chosen for pair in pairs], phases, "")
    for _, group in runs.groupby("algorithm"):
        runs.loc[group.index, "settings"] = differing_settings(group)
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
    pairs = zip(choice["noise"], choice["noise_rate"], strict=True)
    choice["noise_rate"] = [Configuration.parse(*pair).noise_rate for pair in pairs]
    return choice


def differing_settings(runs):
    """Say what sets each run of an algorithm apart, so that unlike runs never share a row.

    It is empty unless finished runs differ in an argument, or there is a newer version of the
    environment: then it is "gamma=0.9, environments v4", say. A run that is not finished also names
    its arguments that no finished run has; it changes nothing for the others.
    """
    finished = runs[runs["status"] == "finished"]
    finished = finished if len(finished) else runs
    arguments = {text: json.loads(text) for text in set(runs["arguments"])}
    names = sorted(set().union(*arguments.values()))
    known = {
        name: {str(arguments[text].get(name)) for text in set(finished["arguments"])}
        for name in names
    }
    newest = newest_versions(runs["environment"]) | newest_versions(finished["environment"])
    result = []
    for run in runs.itertuples():
        own = {name: arguments[run.arguments].get(name) for name in names}
        apart = [name for name in names if known[name] != {str(own[name])}]
        parts = [f"{name}={own[name]}" for name in apart]
        environment, version = split_version(run.environment)
        if version != newest[environment]:
            parts.append(f"environments v{version}")
        result.append(", ".join(parts))
    return result


def newest_versions(environments):
    """Return {name: newest version} of environment ids: ["Hopper-v4"] -> {"Hopper": "4"}."""
    newest = {}
    for name, version in map(split_version, set(environments)):
        newest[name] = max(newest.get(name, ""), version, key=lambda text: int(text or -1))
    return newest


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
    for study, group in runs[runs["algorithm"].notna()].groupby(STUDY):
        if group["phase"].iloc[0] == "search":
            continue
        cells = group.groupby(["environment", "configuration"])["seed"].agg(set).to_dict()
        baselines = {(environment, BASELINE) for environment, _ in cells}
        usual = [seeds for key, seeds in cells.items() if key not in baselines]
        if not usual:
            usual = list(cells.values())
        counts = Counter(seed for seeds in usual for seed in seeds)
        expected = {seed for seed, n in counts.items() if 2 * n >= len(usual)}
        for key in sorted(cells.keys() | baselines):
            environment, config = key
            keys = (*study, environment, config.noise, config.noise_rate)
            for seed in sorted(expected - cells.get(key, set())):
                rows.append((*keys, int(seed), "missing", "no run folder"))
    return pd.DataFrame(rows, columns=[*KEYS, "seed", "status", "reason"])


def left_out(runs):
    """List all runs that are in no table: one row per configuration and status.

    Also return a Counter with the number of these runs by status. Seeds are ranges ("1-5, 7"). A
    run whose config.json cannot be read has a row of its own.
    """
    out = pd.concat([runs[runs["status"] != "finished"], missing_runs(runs)], ignore_index=True)
    rows = []
    nameless = out["run"].where(out["algorithm"].isna())
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
    settings: str  # what sets it apart from other studies of the algorithm
    phase: str  # of `./benchmark.sh choose`: search, confirmation, or empty
    environments: list
    seeds: list
    steps: np.ndarray  # the evaluation steps that all runs share
    returns: dict  # Configuration -> array (steps x seeds x envs), NaN where there is no run

    @property
    def key(self):
        """What tells it from other studies, as the columns STUDY do."""
        return self.algorithm, self.settings, self.phase

    @property
    def name(self):
        """Its name for people."""
        return study_name(*self.key)

    def final(self, config):
        """Return the (seeds x envs) array of final test returns."""
        return self.returns[config][-1]


def make_studies(runs):
    """Arrange the finished runs into a list of Study, and list in words what had to be cut."""
    studies, notes = [], []
    finished = runs[runs["status"] == "finished"]
    for key, group in finished.groupby(STUDY):
        name = study_name(*key)
        grids = list({steps.tobytes(): steps for steps in group["steps"]}.values())
        grid = reduce(np.intersect1d, grids)
        longest = max(map(len, grids))
        if len(grid) < longest:
            notes.append(
                f"{name}: runs differ in their evaluation steps; curves are cut to the "
                f"{len(grid)} steps that all share (of up to {longest})"
            )
        envs, seeds = sorted(set(group["environment"])), sorted(set(group["seed"]))
        configs = {*group["configuration"], BASELINE}
        shape = (len(grid), len(seeds), len(envs))
        returns = {config: np.full(shape, np.nan) for config in sorted(configs)}
        for run in group.itertuples():
            place = seeds.index(run.seed), envs.index(run.environment)
            shared = np.isin(run.steps, grid)
            returns[run.configuration][:, *place] = run.returns[shared]
        study = Study(*key, envs, seeds, grid, returns)
        for env, values in zip(envs, study.final(BASELINE).T, strict=True):
            if np.isnan(values).all() and study.phase != "search":
                notes.append(f"{name}: no finished baseline on {env}, so no improvement there")
        notes += version_notes(name, group["versions"])
        studies.append(study)
    return studies, notes


AVERAGED = "some rows average runs"  # of different versions: in the notes that say so


def version_notes(name, versions):
    """Say in words where runs of one study differ in versions of code or libraries."""
    notes = []
    for library in sorted(set().union(*versions)):
        counts = Counter(str(version.get(library)) for version in versions)
        if len(counts) > 1:
            found = ", ".join(f"{version} (n = {n})" for version, n in sorted(counts.items()))
            what = f"with different {library}"
            if library == "git commit":
                what = "of different code versions"
            notes.append(f"{name}: {AVERAGED} {what}: {found}")
    return notes
