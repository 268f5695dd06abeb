"""Fabricated sweeps of the paper's size, in which no noise does anything.

python tests/analysis/fabricated.py runs ppo           # 4,550 runs of PPO
python tests/analysis/fabricated.py runs sac td3 ppo   # 9,100 runs, as in the paper
python analyze.py --runs-dir runs
"""

import json
import sys
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from sweep.grid import ENVS, NOISES, RATES, SEEDS

LEVELS = dict(zip(ENVS, (9500, 2900, 4500, -25, 4500), strict=True))  # final returns
EPISODES = 10


def fabricate(root, algorithms=("ppo",), seeds=None, noises=NOISES, rates=RATES):
    """Write the run folders of the preset "paper", with returns that have nothing to do with noise.

    seeds: of every algorithm, by default the paper's. PPO is tested 20 times in a run, others 100.
    """
    rng = np.random.default_rng(0)
    configs = [([], []), *(([noise], [rate]) for noise, rate in product(noises, rates))]
    for algorithm in algorithms:
        every = 50_000 if algorithm == "ppo" else 10_000
        cells = product(ENVS, configs, seeds or SEEDS[algorithm])
        for number, (env, (noise, rate), seed) in enumerate(cells):
            folder = Path(root) / f"{algorithm}_{number}"
            write_run(folder, algorithm, env, noise, rate, seed, every, rng)


def write_run(folder, algorithm, env, noise, rate, seed, every, rng):
    """Write one run: its returns rise to the level of the environment, and spread by a tenth."""
    steps = np.arange(every, 1_000_001, every)
    level = LEVELS[env]
    missing = abs(level) * np.exp(-steps / 250_000)[:, None]
    spread = 0.1 * abs(level) * (rng.normal() + 0.3 * rng.normal(size=(len(steps), EPISODES)))
    lines = ["step,episode,episodic_return,episodic_length"]
    for step, returns in zip(steps, level - missing + spread, strict=True):
        lines += [f"{step},{i},{value:.3f},1000" for i, value in enumerate(returns)]
    final = [float(line.split(",")[2]) for line in lines[-EPISODES:]]
    args = {"env_id": env, "exp_name": f"{algorithm}_continuous_noisy", "seed": seed}
    args |= {"noise": noise, "noise_rate": rate, "total_timesteps": 1_000_000}
    args |= {"eval_frequency": every, "eval_episodes": EPISODES}
    config = {"algorithm": algorithm.upper(), "args": args, "versions": {}}
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "eval.csv").write_text("\n".join(lines) + "\n")
    (folder / "result.json").write_text(json.dumps({"final_return_mean": np.mean(final)}))


if __name__ == "__main__":
    fabricate(sys.argv[1], sys.argv[2:] or ["ppo"])
