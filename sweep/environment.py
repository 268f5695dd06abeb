"""What an environment allows, and what its steps cost: asked before a sweep is planned.

`ask` makes an environment, tries noises on it and times it. `run_seconds` says from that what a run
takes until finished runs tell. `remember` keeps the answer, because `status` makes no environment.
"""

import contextlib
import itertools
import json
import math
import sys
import time
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

import gymnasium as gym

import noisy_wrappers as noisy
from analysis.errors import fail, with_place
from analysis.folders import read_json
from analysis.words import duration, slug
from sweep.scripts import number

# Seconds of learning for each step, without the environment's own, and what each number of an
# observation adds to them: docs/sweeps.md says on which machine
LEARNING = {"sac": (6.8e-3, 22e-6), "td3": (5.1e-3, 13e-6), "ppo": (0.103e-3, 0.2e-6)}
START_UP = 10  # seconds, with compilation
STEPS, SECONDS = 200, 1  # an environment is timed for at least so many steps, and so long
MANY = 10  # different rewards: with fewer, noise on them is mostly larger than what they tell


class Environment(NamedTuple):
    """What is known of an environment."""

    step_seconds: float  # of a step with random actions and its share of a reset
    episode_steps: int  # of a test: the time limit; without one, what the timed episodes had
    observed: int  # numbers in an observation
    bounded: bool  # are its actions? SAC and TD3 need that
    tried: dict[str, str]  # noises: why each cannot act here, or ""; by Configuration.noise
    rewards: int = MANY  # how many different rewards the timed steps had; MANY: as many or more


# ------------------------------------------------------------------------------------- the question


def ask(env_id, configurations=(), max_episode_steps=None, env_kwargs=()):
    """Make an environment as the scripts do, time it, and wrap configurations of noise around it.

    What it raises if it cannot be made or played passes through.
    """
    with contextlib.redirect_stdout(sys.stderr):
        options = noisy.parse_env_kwargs(env_kwargs) | {"max_episode_steps": max_episode_steps}
        made = gym.make(env_id, disable_env_checker=True, **options)
        declared = made.spec.max_episode_steps
        with noisy.make_flat(made) as env:
            seconds, length, rewards = time_steps(env)
            return Environment(
                step_seconds=seconds,
                episode_steps=declared or length,
                observed=math.prod(env.observation_space.shape),
                bounded=noisy.is_bounded(env.action_space),
                tried={one.noise: why_unfit(env, one) for one in configurations},
                rewards=rewards,
            )


def time_steps(env):
    """Return seconds a step, an episode's length and how many different rewards there were.

    Medians, because other programs may interrupt some steps. Each step bears its share of a reset:
    an episode is as long as those that ended while it was timed, or as the time limit if none did.
    Different rewards are counted up to MANY.
    """
    env.action_space.seed(1)
    env.reset(seed=1)
    env.step(env.action_space.sample())  # not timed: the first calls may load or compile something
    begin = now = time.perf_counter()
    steps, resets, rewards = [], [], set()  # of the first two, the seconds
    ended, episodes, last_end = True, 0, 0
    while now < begin + SECONDS or len(steps) < STEPS:
        if ended:
            start = time.perf_counter()
            env.reset()
            resets.append(time.perf_counter() - start)
        action = env.action_space.sample()
        start = time.perf_counter()
        _, reward, terminated, truncated, _ = env.step(action)
        now = time.perf_counter()
        steps.append(now - start)
        if len(rewards) < MANY:
            rewards.add(float(reward))
        if ended := terminated or truncated:
            episodes, last_end = episodes + 1, len(steps)
    length = last_end / episodes if episodes else env.spec.max_episode_steps
    return median(steps) + median(resets) / length, math.ceil(length), len(rewards)


def why_unfit(env, configuration):
    """Return why noises cannot act in an environment, or ""."""
    try:
        noisy_env = configuration.wrap(env)
    except Exception as error:
        return with_place(error, ValueError)
    limit = env.spec.max_episode_steps
    for wrapper in noisy.noise_wrappers(noisy_env).values():
        ends = isinstance(wrapper, noisy.RandomEarlyTermination) and not wrapper.each_step
        if ends and wrapper.low >= limit:  # its last step ends the episode anyway
            return f"an episode has at most {limit} steps"
    return ""


def ask_all(args, configurations):
    """Ask environments, and say how fast they are; returns {env_id: Environment}.

    configurations: {env_id: [Configuration]}. Exits with a line for each environment that cannot
    be trained in, and for each algorithm that cannot act there.
    """
    max_episode_steps, env_kwargs = options_of_environments(args)
    steps = number(max_episode_steps)
    answers, reasons = {}, []
    for env_id, noises in configurations.items():
        try:
            answer = ask(env_id, noises, steps, env_kwargs)
        except (Exception, SystemExit) as error:  # others may be wrong, too
            plain = (gym.error.Error, noisy.SpaceError, noisy.NotFiniteError, SystemExit)
            reason = with_place(error, plain)
            reasons.append(f"no algorithm can be trained in {env_id}: {reason}")
            continue
        milliseconds = float(f"{1000 * answer.step_seconds:.2g}")
        print(f"{env_id}: {milliseconds:g} ms a step", file=sys.stderr, flush=True)
        answers[env_id] = answer
        for algorithm in args.algos:
            if algorithm in ("sac", "td3") and not answer.bounded:
                name = algorithm.upper()
                reasons.append(f"{name} needs bounded actions; some actions of {env_id} are not")
    if reasons:
        fail("\nerror: ".join(reasons))
    return answers


def options_of_environments(args):
    """Return the words of the scripts' options about environments, the same for all algorithms."""
    given = args.given_words[args.algos[0]]
    return given.get("max_episode_steps", []), given.get("env_kwargs", [])


# ------------------------------------------------------------------------------------ what it costs


def run_seconds(run, environment):
    """Return about how many seconds a run takes: learning, the environment's steps, tests.

    None for an algorithm that was never measured.
    """
    if run.kind[0] not in LEARNING:
        return None
    steps, frequency = run.total_timesteps, run.number("eval_frequency")
    if frequency is None:
        frequency = max(1, min(run.script.eval_frequency or steps, steps // 10))
    tests = math.ceil(steps / frequency) if frequency else 1
    test_steps = tests * run.number("eval_episodes", 10) * environment.episode_steps
    learned = max(0, steps - run.number("learning_starts", 0))
    base, for_each = LEARNING[run.kind[0]]
    learning = learned * (base + for_each * environment.observed)
    return START_UP + learning + (steps + test_steps) * environment.step_seconds


def cost(args, done, todo):
    """Say what the runs to do will take: as long as finished ones of their kind, if there are any.

    The others are estimated, and their environments asked for that.
    """
    kinds = {run.kind: run for run in todo}
    seconds = {kind: mean_seconds([run for run in done if run.kind == kind]) for kind in kinds}
    new = [kind for kind in kinds if seconds[kind] is None]
    answers = ask_all(args, {env_id: [] for _, env_id in new})
    for kind in new:
        seconds[kind] = run_seconds(kinds[kind], answers[kind[1]])
    known = [seconds[run.kind] for run in todo if seconds[run.kind] is not None]
    told = [processor_time(sum(known))] if known else []
    unknown = sorted({algorithm for algorithm, env_id in kinds if not seconds[algorithm, env_id]})
    if unknown:
        told.append(f"what runs of {', '.join(unknown)} take is known once one is finished")
    return "; ".join(told)


def mean_seconds(runs):
    """Return how many seconds of a processor finished runs took on average, None if none tells."""
    taken = [read_json(run.folder / "result.json").get("processor_seconds") for run in runs]
    known = [seconds for seconds in taken if isinstance(seconds, int | float)]
    return fmean(known) if known else None


def processor_time(seconds):
    """Say what the runs that are left will take."""
    return f"about {duration(seconds)} of processor time left"


# --------------------------------------------------------------------------------------- the memory


def remember(args, env_id, environment):
    """Keep what was found, for a status."""
    path = file_of(args, env_id)
    with contextlib.suppress(OSError):  # benchmark.sh will say so
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(environment))


def remembered(args, env_id):
    """Return what was found when an environment was asked last; 0 seconds a step: nothing."""
    with contextlib.suppress(OSError, ValueError, TypeError):  # there is no file, or half of one
        return Environment(*json.loads(file_of(args, env_id).read_text()))
    return Environment(0.0, 0, 0, False, {})


def file_of(args, env_id):
    """Return the file of an environment with its options, beside the logs of its runs."""
    name = "_".join([env_id, *itertools.chain(*options_of_environments(args))])
    return Path(args.runs_dir, "logs", f"{slug(noisy.safe_name(name))}.json")
