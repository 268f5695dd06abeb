"""The runs of a sweep: the presets, the runs that the arguments name, their commands.

options.py reads the arguments, __main__.py shows how far the runs have come.
"""

import csv
import itertools
import math
import os
import shlex
from pathlib import Path
from typing import Any, NamedTuple

from analysis.errors import fail
from noisy_wrappers import BASELINE, Configuration, run_name
from sweep.scripts import PROJECT, Script, number

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
# What choose tries by default, in the units of whatever environment it is: docs/sweeps.md
CHOOSE_NOISES = [
    "RandomNormalNoisyObservation(0.01, relative=True)",
    "RandomNormalNoisyObservation(0.1, relative=True)",
    "RandomUniformScaleObservation(0.8, 1.2)",
    "RandomMixupObservation(0.5, recursive=True)",
    "RandomNormalNoisyReward(0.1, relative=True)",
    "RandomNormalNoisyReward(1.0, relative=True)",
    "RandomUniformScaleReward(0.5, 1.5)",
    "RandomEarlyTermination(50)",
    "RandomNormalNoisyAction(0.1, relative=True)",
    "RandomActionDelay(0, 2)",
    "RandomDynamics(0.7, 1.3)",
]
CHOOSE_RATES = [0.05, 1.0]
# The paper shows bars for several beta and names none of them: these are ours.
ABLATION = [(f"RandomUniformScaleReward({2 - b:.1f}, {b})", 0.05) for b in (1.1, 1.2, 1.5, 1.8, 2)]
ABLATION += [
    (f"RandomUniformNoisyObservation(-{b}, {b})", 1.0) for b in (0.0001, 0.001, 0.01, 0.1, 1.0)
]
# Times as many seeds without noise as with it, at most: with more, a test of few seeds claims too
# much where noise widens the spread, and the analysis warns (MOST_RATIO in analysis/verdicts.py)
MOST_BASELINES = 2.6
# Compiling would take longer than learning, which the other options make fast
DEMO_OPTIONS = ["--no-compile", "--learning-rate=2e-3"]
DEMO_OPTIONS += ["--num-minibatches=16", "--eval-episodes=5"]
PRESETS = {  # what a preset sets: its noises with their rates, grid options, the scripts' options
    "demo": {
        "pairs": [("RandomNormalNoisyObservation(1.0)", 1.0)],  # harms with any five seeds
        "algos": ["ppo"],
        "envs": ["InvertedPendulum-v5"],
        "seeds": [range(1, 6)],
        "total_timesteps": 20_480,
        "options": DEMO_OPTIONS,
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
    script: Script | None = None  # None: of a folder whose script nobody knows
    args: dict[str, Any] | None = None  # what the command sets, as scripts.read_words; None: any
    damage: str = ""  # what is already known to be wrong with its files

    def number(self, name, otherwise=None):
        """Return a number among its script's arguments, as far as the source tells them."""
        if name in self.args:
            return number(self.args[name], otherwise)
        value = self.script.defaults.get(name)
        return value if isinstance(value, int | float) else otherwise


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
        entries = args.noises or [
            [(noise, None)] for noise in dict.fromkeys(noise for noise, _ in pairs)
        ]
        rates = args.noise_rates or list(dict.fromkeys(own for _, own in args.pairs or []))
    crossed = [pairs for pairs in entries if any(rate is None for _, rate in pairs)]
    if crossed and not rates:
        for entry in crossed:
            configuration_of(entry, 1.0)  # a typing error is not a missing rate
        fail('--noises needs --noise-rates, or a rate with each noise, as in "NOISE@0.1"')
    if args.noise_rates and not crossed:
        fail("--noise-rates needs --noises that have no rate of their own")
    found = [
        configuration_of(pairs, common)
        for pairs in entries
        for common in (rates if pairs in crossed else [None])
    ]
    named = {}
    for configuration in found:
        other = named.setdefault(configuration.slug, configuration)
        if other != configuration:
            advice = "try one of them in a sweep with another --exp-name"
            fail(f"{configuration} and {other} would have the same folders: {advice}")
    return found


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
    script, steps = args.scripts[algorithm], args.total_timesteps
    noises, rates = configuration.texts
    command = [script.path, "--env-id", env_id, "--seed", str(seed)]
    if noises:
        command += ["--noise", *noises, "--noise-rate", *map(str, rates)]
    command += ["--total-timesteps", str(steps), "--runs-dir", runs_dir, *args.extra[algorithm]]
    own = {"env_id": env_id, "seed": str(seed), "total_timesteps": str(steps)}
    own |= args.given_words[algorithm] | {"exp_name": args.exp_names[algorithm]}
    folder = Path(runs_dir, name_of(args, algorithm, env_id, configuration, seed))
    return PlannedRun(folder, (algorithm, env_id), seed, steps, command, script, own)


def name_of(args, algorithm, env_id, configuration, seed):
    """Return the name of a run's folder."""
    noises, rates = configuration.texts
    own = {"env_id": env_id, "exp_name": args.exp_names[algorithm], "seed": seed}
    own |= {"noise": noises, "noise_rate": rates}
    try:
        return run_name(args.given_words[algorithm] | own)
    except ValueError as error:
        return fail(f"after the --: {error}")


def grid(args):
    """Return the runs, each once."""
    runs = {}
    for algorithm, env_id in itertools.product(args.algos, args.envs):
        noisy = dict.fromkeys(configurations(args, algorithm, env_id))
        noisy.pop(BASELINE, None)  # at rate 0 a noise is none
        seeds = sorted(set(itertools.chain(*(args.seeds or [SEEDS.get(algorithm, range(1, 6))]))))
        pairs = [(seed, BASELINE) for seed in baseline_seeds(args, seeds, len(noisy))]
        pairs += itertools.product(seeds, noisy)
        for seed, configuration in sorted(pairs, key=lambda pair: pair[0]):
            run = make_run(args, algorithm, env_id, configuration, seed)
            runs.setdefault(run.folder, run)
    return list(runs.values())


def baseline_seeds(args, seeds, configurations):
    """Return the seeds of the runs without noise, with which every configuration is compared.

    Without --baseline-seeds, `custom` takes the square root of the number of configurations times
    as many as each of them has (Dunnett, 1955), but no more than MOST_BASELINES times as many.
    """
    if args.baseline_seeds:
        return sorted(set(itertools.chain(*args.baseline_seeds)))
    if args.preset != "custom":
        return seeds
    # rounded, so that 3 * sqrt(9) does not become 10
    number = math.ceil(round(len(seeds) * math.sqrt(max(1, configurations)), 9))
    number = min(number, math.floor(round(len(seeds) * MOST_BASELINES, 9)))
    return [*seeds, *range(seeds[-1] + 1, seeds[-1] + 1 + number - len(seeds))]


def command_line(run):
    """Return a run's command, complete: it can be pasted into a shell in the project's folder."""
    words = [os.environ.get("PYTHON", "python"), *run.command]
    # A script that lies elsewhere needs noisy_wrappers, which lies here
    path = [str(PROJECT)] if os.path.dirname(run.script.path) else []
    path += filter(None, [os.environ.get("PYTHONPATH")])
    if path:
        words = ["env", f"PYTHONPATH={':'.join(path)}", *words]
    return shlex.join(words)
