"""Reading a folder of runs for analyze.py: which runs count, and which may be compared.

Runs that may be compared are a study: those of one algorithm and one exp_name, with the same
arguments. The two phases of a choice are the folders search/ and confirmation/. Only finished runs
(those with a result.json) count.
"""

import json
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd

from analysis import folders
from analysis.folders import PHASES, SEARCH, DamageError
from noisy_wrappers import BASELINE, Configuration

STUDY = ["algorithm", "exp_name", "phase"]  # the columns that name a study: see study_name
KEYS = [*STUDY, "environment", "noise", "noise_rate"]
SUCCESS = "success rate"  # what a Study may have in place of returns
EVAL_COLUMNS = ["step", "episode", "episodic_return", "episodic_length"]
RUN_COLUMNS = ["run", "status", "reason", *KEYS, "configuration", "seed", "settings", "versions"]
RUN_COLUMNS += ["steps", "returns", "success_rates"]
CHOICE_COLUMNS = ["algorithm", "environment", "phase", "round", "noise", "noise_rate"]
CHOICE_COLUMNS += ["seeds", "score", "survives"]
ROBUSTNESS_COLUMNS = ["noise", "noise_rate", "episode", "episodic_return", "episodic_length"]
VERSION = r"(?P<name>.*?)(?:-v(?P<version>\d{1,9}))?$"  # of an environment's id, if it has one
OLDER = "environments"  # before their version, in `phase`: see read_runs


def study_name(algorithm, exp_name="", phase=""):
    """Name a study for people: "SAC", or "SAC [my_experiment, search]"."""
    parts = [part for part in (exp_name, phase) if part and part != script_name(algorithm)]
    return f"{algorithm} [{', '.join(parts)}]" if parts else algorithm


def script_name(algorithm):
    """Return the exp_name that a training script gives its runs by default."""
    return f"{algorithm.lower()}_continuous_noisy"


def where_tested(environment, elsewhere):
    """Name where runs were tested: in their own environment, or in another one."""
    return f"{environment}, tested in {elsewhere}" if elsewhere else environment


def rows_of(table, key):
    """Tell which rows of a table are about one study; `key` has the values of STUDY."""
    return pd.MultiIndex.from_frame(table[STUDY]).isin([tuple(key)])


def read_evaluations(folder, episodes, total):
    """Read eval.csv: the steps of the tests, their mean returns, and their rates of success.

    Rates are in percent of the episodes, or None for an environment that does not tell success.
    Raises DamageError unless every evaluation is whole, in order, and the last is at step `total`.
    """
    with folders.naming(folder / "eval.csv"):
        text = (folder / "eval.csv").read_text("utf-8")
        header, *lines = text.splitlines() or [""]
        names = header.split(",")
        if names not in (EVAL_COLUMNS, [*EVAL_COLUMNS, "success"]):
            raise ValueError("unexpected header")
        if not text.endswith("\n"):
            raise ValueError("the last line is half-written")
        if not lines:
            raise ValueError("no evaluation")
        numbers = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
        whole = numbers.shape[1] == len(names) and len(numbers) % episodes == 0
        if not whole or not np.isfinite(numbers).all():
            raise ValueError("incomplete or non-numeric lines")
        table = np.moveaxis(numbers.reshape(-1, episodes, len(names)), 2, 0)
        step, episode, episodic_return, _, *success = table
        if (episode != np.arange(episodes)).any() or (step != step[:, :1]).any():
            raise ValueError("an evaluation is incomplete")
        if (np.diff(step[:, 0]) <= 0).any() or step[-1, 0] != total:
            raise ValueError(f"steps do not ascend to {total}")
    rates = 100 * success[0].mean(axis=1) if success else None
    return step[:, 0].astype(int), episodic_return.mean(axis=1), rates


def read_run(folder):
    """Read one run folder: a dict with some of RUN_COLUMNS."""
    if not folders.has_begun(folder):
        return {"status": "unfinished", "reason": "no config.json yet"}
    row = {}
    try:
        config = folders.read_config(folder)
        row = {name: config[name] for name in RUN_COLUMNS if name in config}
        row["noise"] = config["configuration"].noise
        row["noise_rate"] = config["configuration"].noise_rate
        result = folders.read_result(folder, config)
        if result is None:
            return row | {"status": "unfinished", "reason": "no result.json"}
        steps, returns, rates = read_evaluations(folder, config["episodes"], config["total"])
        if not np.isclose(returns[-1], result["final_return_mean"], rtol=1e-3, atol=1e-3):
            raise DamageError("eval.csv and result.json disagree on the final return")
        values = {"steps": steps, "returns": returns, "success_rates": rates}
        return row | {"status": "finished"} | values
    except DamageError as error:
        return row | {"status": "corrupt", "reason": str(error)}


def read_runs(runs_dir):
    """Read all run folders: a frame with RUN_COLUMNS.

    `status` is finished, unfinished, corrupt, different (from its study), duplicate or failed.
    `phase` is search or confirmation for the runs of `./benchmark.sh choose`, "environments v4",
    say, where their study has a newer version of an environment, and empty for all others.
    """
    runs_dir, rows = Path(runs_dir), []
    found = {folder: read_run(folder) for folder in folders.runs_of(runs_dir)}
    for folder, row in (found | failed_without_a_folder(runs_dir)).items():
        phase = "" if folder.parent == runs_dir else folder.parent.name
        rows.append(row | {"run": str(folder.relative_to(runs_dir)), "phase": phase})
    runs = pd.DataFrame(rows, columns=RUN_COLUMNS, dtype=object)
    leave_out_different(runs)
    set_older_versions_apart(runs)
    finished = runs[runs["status"] == "finished"]
    counted = finished.groupby([*KEYS, "seed"])["run"].transform("first")
    copies = counted[counted != finished["run"]]
    runs.loc[copies.index, "status"] = "duplicate"
    runs.loc[copies.index, "reason"] = "same configuration and seed as " + copies + ", which counts"
    return runs


def leave_out_different(runs):
    """Mark the finished runs whose arguments are not those of most runs of their exp_name."""
    finished = runs[runs["status"] == "finished"]
    for (_, exp_name), group in finished.groupby(["algorithm", "exp_name"]):
        usual = usual_settings(group["settings"])
        for index, own in group["settings"].items():
            differing = folders.difference(own, usual)
            said = ", ".join(f"{name} is {own[name]}, not {usual[name]}" for name in differing)
            said += f" as in the runs of {exp_name} that count: give such runs another --exp-name"
            if differing:
                runs.loc[index, ["status", "reason"]] = ["different", said]


def usual_settings(settings):
    """Return the most frequent arguments of a study.

    settings: a dict for each run. An argument that a run lacks, because an older version made it,
    is no difference: it has that argument's most frequent value. Of equally frequent ones, those of
    the longest runs are taken.
    """
    longest_first = sorted(settings, key=lambda run: -run.get("total_timesteps", 0))
    values = defaultdict(Counter)  # argument -> how many runs have a value, as text
    for run in longest_first:
        for name, value in run.items():
            values[name][json.dumps(value)] += 1
    usual = {name: json.loads(counts.most_common(1)[0][0]) for name, counts in values.items()}
    whole = Counter(json.dumps(usual | run) for run in longest_first)
    return json.loads(whole.most_common(1)[0][0])  # of equals, the first one counted


def set_older_versions_apart(runs):
    """Write into `phase` where there is a newer version of a run's environment in its study.

    So an average over environments has one version of each.
    """
    ours = runs[(runs["phase"] == "") & runs["environment"].notna()]
    parts = ours["environment"].str.extract(VERSION)
    version = parts["version"].fillna(-1).astype(int)
    finished = version.where(ours["status"] == "finished")  # NaN if it is not
    newest = finished.groupby([*(ours[name] for name in STUDY), parts["name"]]).transform("max")
    older = parts.loc[version < newest, "version"]
    runs.loc[older.index, "phase"] = f"{OLDER} " + ("v" + older).fillna("without version")


def failed_without_a_folder(runs_dir):
    """Return {folder: row} of the runs of a sweep of which only their logs tell that they failed.

    A run that ended well or was stopped, and has no folder, was moved or deleted by somebody.
    """
    logs = {path: folders.read_log(path) for path in folders.logged(runs_dir) if not path.exists()}
    return {
        path: {"status": "failed", "reason": log.last_line}
        for path, log in logs.items()
        if log.exit_status not in (None, 0, *folders.STOPPED)
    }


def choice_file(metric="return"):
    """Name the file of what was chosen by a metric: scores of two do not compare."""
    return "choice_by_success.csv" if metric == SUCCESS else "choice.csv"


def read_choice(runs_dir, metric="return"):
    """Read the choice_file of `./benchmark.sh choose`, or return None where there is none.

    Raises ValueError for a damaged file, and where an earlier version kept all runs in one folder.
    """
    path = Path(runs_dir) / choice_file(metric)
    if not path.exists():
        return None
    if not any((path.parent / phase).exists() for phase in PHASES):
        raise ValueError(folders.flat_choice(path.parent))
    text = dict.fromkeys(("round", "noise", "noise_rate", "survives"), str)
    with folders.naming(path):
        choice = pd.read_csv(path, dtype=text, keep_default_na=False)
    if list(choice.columns) != CHOICE_COLUMNS:
        raise ValueError(f"{path} does not have the columns {','.join(CHOICE_COLUMNS)}")
    pairs = zip(choice["noise"], choice["noise_rate"], strict=True)
    choice["noise_rate"] = [Configuration.parse(*pair).noise_rate for pair in pairs]
    return choice


def missing_runs(runs):
    """List seeds that a configuration lacks in an environment: those that most others have.

    That is, at least half of the algorithm's configurations with noise have them, each environment
    counted apart. An environment in which anything was run should have the baseline with these
    seeds. The search of `./benchmark.sh choose` gives few noises many seeds: nothing is missing.
    """
    rows = []
    runs = runs[runs["algorithm"].notna() & (runs["status"] != "different")]
    for study, group in runs[runs["phase"] != SEARCH].groupby(STUDY):
        found = group.groupby(["environment", "configuration"])["seed"].agg(set).to_dict()
        baselines = {(environment, BASELINE) for environment, _ in found}
        usual = [seeds for key, seeds in found.items() if key not in baselines]
        usual = usual or list(found.values())
        counts = Counter(seed for seeds in usual for seed in seeds)
        expected = {seed for seed, n in counts.items() if 2 * n >= len(usual)}
        for environment, config in sorted(found.keys() | baselines):
            keys = (*study, environment, config.noise, config.noise_rate)
            for seed in sorted(expected - found.get((environment, config), set())):
                rows.append((*keys, int(seed), "missing", "no run folder"))
    return pd.DataFrame(rows, columns=[*KEYS, "seed", "status", "reason"])


def left_out(runs):
    """List all runs that are in no table: one row per configuration and status.

    Also return a Counter with the number of these runs by status. Seeds are ranges ("1-5, 7"). A
    run whose config.json cannot be read has a row of its own.
    """
    out = pd.concat([runs[runs["status"] != "finished"], missing_runs(runs)], ignore_index=True)
    out["nameless"] = out["run"].where(out["algorithm"].isna(), "")
    groups = out.groupby(["status", *KEYS, "nameless"], sort=False, dropna=False)
    table = groups.agg(seeds=("seed", ranges), run=("run", few), reason=("reason", few))
    return table.droplevel("nameless").reset_index(), Counter(out["status"])


def few(texts):
    """Join one or two different texts; of more, give the first and the number of the others."""
    different = list(texts.dropna().unique())
    if len(different) > 2:
        return f"{different[0]} and {len(different) - 1} more"
    return "; ".join(different)


def ranges(numbers):
    """Write whole numbers as ranges: [1, 2, 3, 5] -> "1-3, 5"."""
    parts = []
    for number in sorted(set(numbers.dropna())):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in parts)


@dataclass
class Study:
    """The finished runs that may be compared: those of one algorithm and one exp_name."""

    algorithm: str
    exp_name: str
    phase: str  # as in read_runs
    environments: list
    seeds: list
    steps: np.ndarray  # the evaluation steps that all runs share
    returns: dict  # Configuration, the baseline first -> (steps x seeds x envs), NaN without a run
    metric: str = "return"  # or "success rate": then `returns` has rates of success in percent

    @property
    def key(self):
        """What tells it from other studies, as the columns STUDY do."""
        return self.algorithm, self.exp_name, self.phase

    @property
    def name(self):
        """Its name for people."""
        return study_name(*self.key)

    def all_equal(self):
        """Return the environments where all tests of two or more runs are equal: {name: value}."""
        found = {}
        for e, env in enumerate(self.environments):
            tests = np.concatenate([values[..., e] for values in self.returns.values()], axis=1)
            tests = tests[:, np.isfinite(tests[-1])]
            if tests.shape[1] > 1 and np.ptp(tests) <= 1e-12 * abs(tests).max():
                found[env] = tests[0, 0]
        return found

    def sample(self, config, e):
        """Return the final test returns (seeds,) in one environment, of the runs that exist."""
        returns = self.final(config)[:, e]
        return returns[np.isfinite(returns)]

    def final(self, config):
        """Return the (seeds x envs) array of final test returns."""
        return self.returns[config][-1]


def make_studies(runs, metric="return"):
    """Arrange the finished runs into a list of Study, and list in words what had to be cut.

    metric: what is compared, "return" or "success rate"; of the latter, only environments that tell
    it. A run there that never does was never successful, and a note says so.
    """
    studies, notes = [], []
    column = "success_rates" if metric == SUCCESS else "returns"
    finished = runs[runs["status"] == "finished"]
    told = finished[column].notna()
    others_tell = told.groupby(finished["environment"]).transform("any")
    silent = finished.loc[others_tell & ~told, "environment"]
    for env, n in silent.value_counts(sort=False).items():
        notes.append(
            f"runs on {env} that never tell success, as others do, count as 0 %: {n} (version "
            "0.2 noted no success: leave its runs out)"
        )
    for key, group in finished[others_tell].groupby(STUDY):
        name = study_name(*key)
        steps, longest = reduce(np.intersect1d, group["steps"]), group["steps"].map(len).max()
        if len(steps) < longest:
            notes.append(
                f"{name}: runs differ in their evaluation steps; curves are cut to "
                f"those that all share, {len(steps)} of up to {longest}"
            )
        envs, seeds = sorted(set(group["environment"])), sorted(set(group["seed"]))
        shape = (len(steps), len(seeds), len(envs))
        configs = sorted({*group["configuration"], BASELINE})
        returns = {config: np.full(shape, np.nan) for config in configs}
        for run in group.itertuples():
            place = seeds.index(run.seed), envs.index(run.environment)
            tests, shared = getattr(run, column), np.isin(run.steps, steps)
            returns[run.configuration][:, *place] = 0 if tests is None else tests[shared]
        study = Study(*key, envs, seeds, steps, returns, metric)
        for e, env in enumerate(envs):
            if study.phase != SEARCH and len(study.sample(BASELINE, e)) == 0:
                notes.append(f"{name}: no finished baseline on {env}, so no comparison there")
        if study.phase.startswith(OLDER):
            notes.append(
                f"{name} is apart, because averages over environments take the newest version of "
                f"each: {', '.join(envs)}"
            )
        studies.append(study)
    return studies, notes


def version_notes(runs):
    """Say in words where finished runs of one study differ in versions of code or libraries."""
    notes = []
    for key, group in runs[runs["status"] == "finished"].groupby(STUDY):
        for library in sorted(set().union(*group["versions"])):
            used = group["versions"].map(lambda versions, name=library: str(versions.get(name)))
            mixed = used.groupby(group["environment"]).transform("nunique") > 1
            if mixed.any():
                counts = Counter(used[mixed])
                found = ", ".join(f"{version} (n = {n})" for version, n in sorted(counts.items()))
                code = library == "git commit"
                what = "of different code versions" if code else f"with different {library}"
                notes.append(f"{study_name(*key)}: some rows average runs {what}: {found}")
    return notes
