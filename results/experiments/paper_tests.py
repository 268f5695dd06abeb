"""Train PPO and play each of its tests in six ways, to find how the paper tested PPO.

    nice python -m results.experiments.paper_tests --runs-dir runs/paper_tests --jobs 2

50 runs of ppo_continuous_noisy.py, seed 1 of everything first. Beside the files of a run its folder
gets tests.csv, with the columns way, step, episode and episodic_return. The training is the
script's own: its eval.csv does not change. results/baselines.md has the rules and the results.

You can stop it at any time with Ctrl-C or SIGTERM. The same command again skips finished runs and
starts unfinished ones anew.
"""

import argparse
import multiprocessing
import signal
import sys
import traceback
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
from gymnasium.wrappers import NormalizeObservation

import ppo_continuous_noisy as ppo
from noisy_wrappers import run_name

# The statistics that normalize the observations of a test: those of training, frozen; the test
# environment's own, accumulated over all tests of a run; its own, begun anew in each test.
STATISTICS = ("training", "own", "own_per_test")
ACTIONS = ("mean", "sampled")
WAYS = tuple(f"{statistics}-{actions}" for statistics, actions in product(STATISTICS, ACTIONS))
COMPARED = {  # with and without the paper's best noise of PPO
    "Hopper-v5": ("RandomNormalNoisyReward(1.0)", 1.0),
    "Walker2d-v5": ("RandomUniformScaleReward(0.8, 1.2)", 0.05),
}
CONTROLS = ("HalfCheetah-v5", "Pusher-v5")  # without noise
SEEDS, CONTROL_SEEDS = range(1, 11), range(1, 6)

make_policy, evaluate = ppo.make_policy, ppo.evaluate  # the script's own


def planned_runs():
    """Return (env_id, noise, noise_rate, seed) of every run, seed 1 of everything first.

    noise and noise_rate are tuples, as in the script's Args.
    """
    runs = []
    for seed in SEEDS:
        for env_id, (noise, rate) in COMPARED.items():
            runs += [(env_id, (), (), seed), (env_id, (noise,), (rate,), seed)]
        if seed in CONTROL_SEEDS:
            runs += [(env_id, (), (), seed) for env_id in CONTROLS]
    return runs


class SixWays:
    """Stands in for the script's make_policy and evaluate, and plays every test in all six ways.

    It has environments and a random generator of its own, so that training does not notice.
    """

    def __init__(self, args):
        def make_env():
            return ppo.make_env(args.env_id, max_episode_steps=args.max_episode_steps)

        self.clean = make_env()
        self.accumulating = {actions: NormalizeObservation(make_env()) for actions in ACTIONS}
        self.rng = np.random.default_rng(args.seed)
        self.tests = []  # of each test: {way: returns of its episodes}

    def make_policy(self, agent, observation_stats, env):
        """Return the script's policy; remember what the other ways need."""
        self.agent, self.observation_stats = agent, observation_stats
        return make_policy(agent, observation_stats, env)

    def evaluate(self, policy, env, episodes, stop):
        """Return the results of the script's test, and play it in the other ways."""
        results = evaluate(policy, env, episodes, stop)
        played = {"training-mean": results[:, 0]}
        for way in WAYS[1:]:
            played[way] = self.play(*way.split("-"), episodes)[:, 0]
        self.tests.append(played)
        return results

    def play(self, statistics, actions, episodes):
        """Play one test in one way -> (episodes, 2): returns, lengths."""
        act, std = ppo.in_numpy(self.agent.actor_mean), self.agent.actor_logstd.exp().cpu().numpy()
        low, high = self.clean.action_space.low, self.clean.action_space.high
        if statistics == "training":
            env, normalize = self.clean, self.observation_stats.normalize
        else:  # the environment normalizes, and the script clips at 10 standard deviations
            env = self.accumulating[actions]
            if statistics == "own_per_test":
                env = NormalizeObservation(self.clean)

            def normalize(observation):
                return observation.clip(-10, 10).astype(np.float32)

        def policy(observation):
            action = act(normalize(observation))
            if actions == "sampled":
                action = action + std * self.rng.standard_normal(std.shape, np.float32)
            return action.clip(low, high)

        return evaluate(policy, env, episodes)


def folder_of(args):
    """Return the folder of a run."""
    run = (args.env_id, args.exp_name, args.noise, args.noise_rate, args.seed)
    return Path(args.runs_dir, run_name(*run))


def is_finished(args):
    """Return whether a run's tests.csv is there, which is written last."""
    return (folder_of(args) / "tests.csv").exists()


def train(args):
    """Train and test one run from its beginning; write its files."""
    ways = SixWays(args)
    with mock.patch.multiple(ppo, make_policy=ways.make_policy, evaluate=ways.evaluate):
        ppo.train(args)
    folder = folder_of(args)
    steps = np.loadtxt(folder / "eval.csv", delimiter=",", skiprows=1, usecols=0, dtype=int)
    text = "way,step,episode,episodic_return\n"
    for step, played in zip(np.unique(steps), ways.tests, strict=True):
        for way, returns in played.items():
            text += "".join(f"{way},{step},{i},{x}\n" for i, x in enumerate(returns.tolist()))
    temporary = folder / "tests.csv.tmp"  # whole or not at all: a kill leaves no half of it
    temporary.write_text(text)
    temporary.replace(folder / "tests.csv")


def try_to_train(args):
    """Train one run; return whether it succeeded."""
    try:
        train(args)
        return True
    except (Exception, SystemExit):  # the script exits where a folder is in use, say
        traceback.print_exc()
        return False


def main():
    """Train all runs that are not finished; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs-dir", default="runs/paper_tests", help="where the runs are stored")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    options = parser.parse_args()
    if options.jobs < 1:
        print(f"error: --jobs must be at least 1, not {options.jobs}", file=sys.stderr)
        return 2
    runs = [
        ppo.Args(env_id, seed, noise=noise, noise_rate=rate, runs_dir=options.runs_dir)
        for env_id, noise, rate, seed in planned_runs()
    ]
    todo = [args for args in runs if not is_finished(args)]
    for args in todo:
        args.overwrite = True  # the statistics of earlier tests are lost: begin anew
    print(f"{len(runs) - len(todo)} of {len(runs)} runs are finished", flush=True)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    # a process for each run: whatever one leaves behind, the next does not see
    context = multiprocessing.get_context("spawn")
    failed = 0
    with context.Pool(options.jobs, maxtasksperchild=1) as pool:  # its end ends the runs, too
        for succeeded in pool.imap_unordered(try_to_train, todo, chunksize=1):
            failed += not succeeded
    if failed:
        print(f"error: {failed} runs failed (see above); run the same command again")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
