"""The runs of a sweep: the presets, the runs that the arguments name, their commands.

options.py reads the arguments, __main__.py shows how far the runs have come.
"""

import csv
import itertools
import os
import re
import shlex
from pathlib import Path
from typing import NamedTuple

from analysis.errors import fail
from analysis.folders import DamageError, logged, read_config, read_result, runs_of
from noisy_wrappers import BASELINE, MAY_DIFFER_IN_A_RUN, Configuration, run_name

PROJECT = Path(__file__).resolve().parent.parent
SEEDS = {"sac": range(1, 6), "td3": range(1, 6), "ppo": range(1, 11)}  # the paper's
ENVS = ["HalfCheetah-v5", "Hopper-v5", "Humanoid-v5", "Pusher-v5", "Walker2d-v5"]
RATES = [0.01, 0.05, 0.1, 0.2, 0.5, 1.0]
NOISES = [  # as the paper's authors ran them: dropout keeps 90 %, mixup remembers the mixture
    "RandomDropoutObservation(0.9)",
    "RandomEarlyTermination(1, 100)",
    "RandomEarlyTermination(50)",
    "RandomMixupObservation(0.0, recursive=True)",
    "RandomMixupObservation(0.5, recursive=True)",
    "RandomNormalNoisyObservation(0.001)",
    "RandomNormalNoisyObservation(1.0)",
    "RandomNormalNoisyReward(0.001)",
    "RandomNormalNoisyReward(1.0)",
    "RandomUniformNoisyObservation(-0.001, 0.001)",
    "RandomUniformNoisyReward(-0.001, 0.001)",
    "RandomUniformScaleObservation(0.5, 1.5)",
    "RandomUniformScaleObservation(0.8, 1.2)",
    "RandomUniformScaleReward(0.5, 1.5)",
    "RandomUniformScaleReward(0.8, 1.2)",
]
# What choose tries by default, and why: docs/sweeps.md
CHOOSE_NOISES = [
    "RandomUniformNoisyObservation(-0.001, 0.001)",
    "RandomUniformScaleObservation(0.8, 1.2)",
    "RandomMixupObservation(0.5, recursive=True)",
    "RandomNormalNoisyReward(1.0)",
    "RandomUniformNoisyReward(-0.001, 0.001)",
    "RandomUniformScaleReward(0.5, 1.5)",
    "RandomEarlyTermination(50)",
    "RandomNormalNoisyAction(0.1)",
    "RandomActionDelay(0, 2)",
    "RandomDynamics(0.7, 1.3)",
]
CHOOSE_RATES = [0.05, 1.0]
# The paper shows bars for several beta and names none of them: these are ours.
ABLATION = [(f"RandomUniformScaleReward({2 - b:.1f}, {b})", 0.05) for b in (1.1, 1.2, 1.5, 1.8, 2)]
ABLATION += [
    (f"RandomUniformNoisyObservation(-{b}, {b})", 1.0) for b in (0.0001, 0.001, 0.01, 0.1, 1.0)
]
PRESETS = {  # what a preset sets: its noises with their rates, and grid options
    "demo": {
        "pairs": [("RandomNormalNoisyObservation(1.0)", 1.0)],  # harms with any five seeds
        "algos": ["ppo"],
        "envs": ["InvertedPendulum-v5"],
        "seeds": [range(1, 6)],
        "total_timesteps": 50_000,
        "runs_dir": "runs/demo",  # never into a sweep's folders: these runs are shorter
    },
    "baseline": {},
    "best": {"pairs": None},  # the paper's, another one for each algorithm and environment
    "paper": {"pairs": list(itertools.product(NOISES, RATES))},
    "ablation": {"pairs": ABLATION, "algos": ["ppo"]},
    "custom": {},
    "choose": {
        "pairs": list(itertools.product(CHOOSE_NOISES, CHOOSE_RATES)),
        "runs_dir": "runs/choose",  # apart: analyze.py judges its runs otherwise
    },
}


class PlannedRun(NamedTuple):
    """One line of the grid."""

    folder: Path
    kind: tuple[str, str]  # algorithm, environment: runs of one kind are equally fast
    seed: int
    total_timesteps: int
    command: list[str]  # the script and its arguments
    options: dict[str, object]  # the script's own arguments, as options.script_options reads them
    damage: str = ""  # what is already known to be wrong with its files


def script_of(algorithm):
    """Return the file of an algorithm's training script."""
    return f"{algorithm}_continuous_noisy.py"


def best_of_the_paper(algorithm, env_id):
    """Return the paper's best noise for an algorithm in an environment, and its rate."""
    with open(PROJECT / "results/paper/best.csv", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            case = row["algorithm"].lower(), row["environment"].rpartition("-v")[0]
            if case == (algorithm, env_id.rpartition("-v")[0]):
                return row["noise_as_run"], float(row["noise_rate"])
    return fail(f"the paper has no best noise for {algorithm} on {env_id}")


def configurations(args, algorithm, env_id):
    """Return the configurations with noise of a grid, in the order given."""
    pairs = [best_of_the_paper(algorithm, env_id)] if args.pairs is None else args.pairs
    entries, rates = [[pair] for pair in pairs], []
    if args.noises or args.noise_rates:
        entries = args.noises or [[(noise, None)] for noise in dict(pairs)]
        rates = args.noise_rates or list(dict.fromkeys(own for _, own in pairs))
    crossed = [pairs for pairs in entries if any(rate is None for _, rate in pairs)]
    if crossed and not rates:
        fail('--noises needs --noise-rates, or a rate with each noise, as in "NOISE@0.1"')
    if args.noise_rates and not crossed:
        fail("--noise-rates needs --noises that have no rate of their own")
    return [
        configuration_of(pairs, common)
        for pairs in entries
        for common in (rates if pairs in crossed else [None])
    ]


def configuration_of(pairs, common=None):
    """Return a configuration; `common` is the rate of the noises without one of their own."""
    try:
        return Configuration.read(
            [noise for noise, _ in pairs],
            [common if rate is None else rate for _, rate in pairs],
        )
    except ValueError as error:
        fail(error)


def make_run(args, algorithm, env_id, configuration, seed, phase=""):
    """Return one run of the grid, or of a phase of a choice: that is a folder of its own."""
    runs_dir = f"{args.runs_dir}/{phase}" if phase else args.runs_dir
    script, steps = script_of(algorithm), args.total_timesteps
    noises, rates = configuration.texts
    command = [script, "--env-id", env_id, "--seed", str(seed)]
    if noises:
        command += ["--noise", *noises, "--noise-rate", *map(str, rates)]
    command += ["--total-timesteps", str(steps), "--runs-dir", runs_dir, *args.extra]
    folder = Path(runs_dir, run_name(env_id, script.removesuffix(".py"), noises, rates, seed))
    return PlannedRun(folder, (algorithm, env_id), seed, steps, command, args.options[algorithm])


def grid(args):
    """Return the runs, each once."""
    runs = {}
    for algorithm, env_id in itertools.product(args.algos, args.envs):
        noisy = configurations(args, algorithm, env_id)
        seeds = sorted(itertools.chain(*(args.seeds or [SEEDS[algorithm]])))
        for seed, configuration in itertools.product(seeds, [BASELINE, *noisy]):
            run = make_run(args, algorithm, env_id, configuration, seed)
            runs.setdefault(run.folder, run)
    return list(runs.values())


def runs_in(folder):
    """Return the runs that a folder or its logs tell of, for a status that names no grid."""
    folders = {*runs_of(Path(folder)), *logged(Path(folder))}
    if not folders:
        fail(f"no runs in {folder}; name their folder with --runs-dir")
    runs = []
    for path in sorted(folders):
        kind, steps, damage = ("", ""), 0, ""  # unknown: it has failed before it began
        if os.path.exists(path / "config.json"):
            try:
                config = read_config(path)
                kind, steps = (config["exp_name"], config["environment"]), config["total"]
            except DamageError as error:
                damage = f"{path}/{error}"
        runs.append(PlannedRun(path, kind, 0, steps, [], {}, damage))
    return runs


def result(run):
    """Return whether a run is finished, and what is wrong with its files, or "".

    Exits if the folder holds a finished run of another length or with other options.
    """
    if run.damage or not os.path.exists(run.folder / "result.json"):
        return False, run.damage
    try:
        config = read_config(run.folder)
        read_result(run.folder, config)
    except DamageError as error:
        return False, f"{run.folder}/{error}; move its folder away to run it again"
    if config["environment"] != run.kind[1]:  # two may give one folder name
        where = config["environment"]
        fail(f"{run.folder} holds a finished run in {where}; choose another --runs-dir")
    steps, made = config["total"], config["args"]
    if steps != run.total_timesteps:
        fail(f"{run.folder} holds a finished run of {steps} steps; choose another --runs-dir")
    differences = [
        f"--{name.replace('_', '-')} {made[name]}, not {wanted}"
        for name, wanted in run.options.items()
        if name not in MAY_DIFFER_IN_A_RUN
        and (name != "eval_frequency" or wanted is not None)  # without one, a run keeps its own
        and made.get(name, wanted) != wanted  # an older version did not have all options
    ]
    if differences:
        fail(
            f"{run.folder} holds a finished run with {' and '.join(differences)}; choose another "
            "--runs-dir, or the same options after the --"
        )
    return True, ""


def command_line(run):
    """Return a run's command, complete: it can be pasted into a shell in the project's folder."""
    words = [os.environ.get("PYTHON", "python"), *run.command]
    noises = any(re.match(r"[\w.]+:[^\W\d]", word) for word in run.command)  # module:Name(...)
    own = ":" in run.kind[1] or noises
    if own and "PYTHONPATH" in os.environ:  # where a module of the user's lies
        words = ["env", f"PYTHONPATH={os.environ['PYTHONPATH']}", *words]
    return shlex.join(words)
