"""Which runs of a folder count, which are left out and why.

Runs that may be compared are a study: those of one algorithm and one exp_name, with the same
arguments and of the same release. The two phases of a choice are the folders search/ and
confirmation/. Only finished runs (those with a result.json) count.
"""

import json
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from analysis import folders
from analysis.folders import NOT_SETTINGS, PHASES, DamageError, Run, script_name
from analysis.logs import STOPPED, read_log
from noisy_wrappers import BASELINE, different_arguments, run_name

STUDY = ["algorithm", "exp_name", "phase", "tested"]  # the columns that name a study: study_name
KEYS = [*STUDY, "environment", "noise", "noise_rate"]
LEFT_OUT_COLUMNS = ["status", *KEYS, "seed", "run", "reason"]
MORE_TO_COME = {"missing", "unfinished", "failed"}  # statuses of runs that a sweep still owes


def study_name(algorithm, exp_name="", phase="", tested=""):
    """Name a study for people: "SAC", or "SAC [my_experiment, search]"."""
    parts = [part for part in (exp_name, phase, tested) if part and part != script_name(algorithm)]
    return f"{algorithm} [{', '.join(parts)}]" if parts else algorithm


def where_tested(environment, elsewhere):
    """Name where runs were tested: in their own environment, or in another one."""
    return f"{environment}, tested in {elsewhere}" if elsewhere else environment


def rows_of(table, key):
    """Tell which rows of a table are about one study; `key` has the values of STUDY."""
    return pd.MultiIndex.from_frame(table[STUDY]).isin([tuple(key)])


def study_of(run):
    """Return the values of STUDY of a run."""
    return run.algorithm, run.exp_name, run.phase, run.tested


def by_study(runs):
    """Return {values of STUDY: runs}, sorted."""
    found = defaultdict(list)
    for run in runs:
        found[study_of(run)].append(run)
    return dict(sorted(found.items()))


@dataclass
class Entry:
    """A folder of a run, or the place of one that should be there, and whether it counts."""

    folder: str  # relative to that of all runs; empty where it is missing
    status: str  # finished (it counts), unfinished, corrupt, different, duplicate, failed, missing
    reason: str = ""
    run: Run | None = None  # what could be read


def finished(entries):
    """Return the runs that count."""
    return [entry.run for entry in entries if entry.status == "finished"]


def read_runs(runs_dir):
    """Read all run folders: a list of Entry."""
    runs_dir, entries = Path(runs_dir), []
    for folder in folders.runs_of(runs_dir):
        phase = "" if folder.parent == runs_dir else folder.parent.name
        entry = read_entry(folder, phase)
        entry.folder = str(folder.relative_to(runs_dir))
        entries.append(entry)
    entries += failed_without_a_folder(runs_dir)
    leave_out_different(entries)
    leave_out_duplicates(entries)
    return entries


def read_entry(folder, phase):
    """Read one run folder."""
    if not folders.has_begun(folder):
        return Entry("", "unfinished", "no config.json yet")
    try:
        run = folders.read_run(folder, phase)
    except DamageError as error:
        return Entry("", "corrupt", str(error), error.run)
    if not run.finished:
        log = read_log(folder)
        if has_failed(log):
            return Entry("", "failed", log.last_line, run)
        return Entry("", "unfinished", "no result.json", run)
    return Entry("", "finished", "", run)


def leave_out_different(entries):
    """Mark the finished runs whose release or arguments are not those of most of their study."""
    groups = defaultdict(list)
    for entry in entries:
        if entry.status == "finished":
            groups[entry.run.algorithm, entry.run.exp_name].append(entry)
    for (_, exp_name), group in groups.items():
        usual = Counter(entry.run.release for entry in group)
        release = max(usual, key=lambda name: (usual[name], name))
        same = [entry.run.config for entry in group if entry.run.release == release]
        reference = usual_config(same)
        for entry in group:
            difference = what_differs(entry.run.config, reference)
            if entry.run.release != release:
                difference = f"release is {entry.run.release}, not {release} (numbers differ)"
            if difference:
                entry.status = "different"
                entry.reason = (
                    f"{difference} as in the runs of {exp_name} that count: give such runs another "
                    "--exp-name"
                )


def settings_of(config):
    """Return the arguments that the runs of a study share."""
    return {name: value for name, value in config["args"].items() if name not in NOT_SETTINGS}


def what_differs(config, reference):
    """Say in which arguments a run differs from the reference of its study, or ""."""
    differing = different_arguments(config, reference, NOT_SETTINGS)
    return ", ".join(f"{name} is {ours}, not {usual}" for name, (ours, usual) in differing.items())


def usual_config(configs):
    """Return what most runs of a study have, as a config with "args" and "defaults".

    An argument that a config lacks, because a script has it since then, had the default that the
    others name, or, of runs of version 0.3, their value: where these differ, that of the longest.
    Of equally frequent sets of arguments, that of the longest runs is taken.
    """
    longest_first = sorted(configs, key=lambda c: -c["args"].get("total_timesteps", 0))
    named, defaults = {}, {}
    for config in reversed(longest_first):
        named |= settings_of(config)
        defaults |= config.get("defaults", {})
    lacking = named | defaults
    named = {name: lacking[name] for name in named}
    complete = Counter(json.dumps(named | settings_of(config)) for config in longest_first)
    args = json.loads(complete.most_common(1)[0][0])  # of equals, the first one counted
    return {"args": args, "defaults": lacking}


def leave_out_duplicates(entries):
    """Mark all but the first of finished runs with the same configuration and seed."""
    first = {}
    for entry in entries:
        if entry.status != "finished":
            continue
        run = entry.run
        key = (*study_of(run), run.environment, run.configuration, run.seed)
        if key in first:
            entry.status = "duplicate"
            entry.reason = f"same configuration and seed as {first[key]}, which counts"
        first.setdefault(key, entry.folder)


def failed_without_a_folder(runs_dir):
    """Return an Entry for each run of which only the log of a sweep tells that it failed.

    A run that ended well or was stopped, and has no folder, was moved or deleted by somebody.
    """
    logs = {path: read_log(path) for path in folders.logged(runs_dir) if not path.exists()}
    return [
        Entry(str(path.relative_to(runs_dir)), "failed", log.last_line)
        for path, log in logs.items()
        if has_failed(log)
    ]


def has_failed(log):
    """Tell whether a run's log says that it ended, neither well nor stopped."""
    return log.exit_status not in (None, 0, *STOPPED)


def missing_runs(entries):
    """Return an Entry for each seed that a configuration lacks in an environment.

    Expected are the seeds that at least half of a study's configurations with noise have, each
    environment counted apart. An environment in which anything was run should have the baseline
    with these seeds. `./benchmark.sh choose` gives few noises many seeds, and may stop early in one
    environment: nothing is missing there. Nor is a run that has a folder, by its name, which tells
    nothing or is left out.
    """
    missing = []
    left_out = {Path(e.folder).name for e in entries if e.run is None or e.status == "different"}
    runs = [e.run for e in entries if e.run is not None and e.status != "different"]
    for study in by_study(run for run in runs if run.phase not in PHASES).values():
        found, example = defaultdict(set), {}
        for run in study:
            found[run.environment, run.configuration].add(run.seed)
            example[run.environment] = run
        baselines = {(environment, BASELINE) for environment, _ in found}
        usual = [seeds for key, seeds in found.items() if key not in baselines]
        usual = usual or list(found.values())
        counts = Counter(seed for seeds in usual for seed in seeds)
        expected = {seed for seed, n in counts.items() if 2 * n >= len(usual)}
        for environment, configuration in sorted(found.keys() | baselines):
            seeds = found.get((environment, configuration), set())
            others = configuration == BASELINE and len(seeds) >= len(expected)
            for seed in sorted(set() if others else expected - seeds):
                run = replace(example[environment], configuration=configuration, seed=seed)
                if folder_of(run) not in left_out:
                    missing.append(Entry("", "missing", "no run folder", run))
    return missing


def folder_of(run):
    """Return the name that a run's script gives its folder."""
    own = {"env_id": run.environment, "exp_name": run.exp_name, "seed": run.seed}
    own["noise"], own["noise_rate"] = run.configuration.texts
    own["test_noise"], own["test_noise_rate"] = run.tested_under.texts
    return run_name(run.args | own)


def left_out(entries):
    """List all runs that are in no table: a frame with LEFT_OUT_COLUMNS, a row for each."""
    rows = []
    for entry in [e for e in entries if e.status != "finished"] + missing_runs(entries):
        row = {"status": entry.status, "run": entry.folder, "reason": entry.reason}
        if run := entry.run:
            columns = run.environment, run.configuration.noise, run.configuration.noise_rate
            row |= zip(KEYS, (*study_of(run), *columns), strict=True)
            row["seed"] = run.seed
        rows.append(row)
    return pd.DataFrame(rows, columns=LEFT_OUT_COLUMNS, dtype=object)


def in_short(missing):
    """Return a frame of left_out for people: a row for each configuration, status and reason.

    Seeds are ranges ("1-5, 7"). A run whose config.json cannot be read has a row of its own.
    """
    if missing.empty:
        return missing.rename(columns={"seed": "seeds"})
    missing = missing.assign(nameless=missing["run"].where(missing["algorithm"].isna(), ""))
    groups = missing.groupby(["status", *KEYS, "nameless"], sort=False, dropna=False)
    table = groups.agg(seeds=("seed", ranges), run=("run", few), reason=("reason", few))
    return table.droplevel("nameless").reset_index()


def few(texts):
    """Join one or two different texts; of more, give the first and the number of the others."""
    different = [text for text in texts.dropna().unique() if text]
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
