"""How early termination changes the scale of PPO's reward.

    python -m results.experiments.reward_scale

PPO divides the reward by the standard deviation of the discounted return so far. Gymnasium begins
this return anew when an episode is terminated; gym and Gymnasium before 0.27 did so at any end of
an episode, which counts on Pusher, whose episodes are only ever truncated. Writes
data/reward_scale/reward_scale.csv: the standard deviation on Pusher-v5 with the actions of
an untrained policy (standard normal, clipped) under both rules.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd

from noisy_wrappers import make_noisy

STEPS, GAMMA = 100_000, 0.99
NOISES = ["", "RandomEarlyTermination(50)", "RandomEarlyTermination(50, truncate=True)"]


def discounted_returns(noise):
    """Return the discounted returns at each step, as a dict of rule -> list."""
    env = gym.make("Pusher-v5")
    if noise:
        env = make_noisy(env, [noise], [1.0])
    env.reset(seed=1)
    rng, space = np.random.default_rng(1), env.action_space
    returns = {"terminated": [], "any end": []}
    terminating = ending = 0.0
    for _ in range(STEPS):
        action = np.clip(rng.normal(size=space.shape), space.low, space.high)
        _, reward, terminated, truncated, _ = env.step(action)
        # As gymnasium.wrappers.NormalizeReward: the step that ends an episode begins the next sum.
        terminating = terminating * GAMMA * (1 - terminated) + reward
        ending = ending * GAMMA * (1 - (terminated or truncated)) + reward
        returns["terminated"].append(terminating)
        returns["any end"].append(ending)
        if terminated or truncated:
            env.reset()
    return returns


if __name__ == "__main__":
    rows = [
        {"noise": noise, "begins_anew_when": rule, "std": pd.Series(values).std()}
        for noise in NOISES
        for rule, values in discounted_returns(noise).items()
    ]
    path = Path(__file__).resolve().parents[1] / "data/reward_scale/reward_scale.csv"
    pd.DataFrame(rows).to_csv(path, index=False, float_format="%.4g", lineterminator="\n")
