"""Environments of the tests, for `--env-id toy_envs:Tiny-v0` and the like."""

import time

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box


class Tiny(gym.Env):
    """Three states, two actions with bounds of their own, random steps and random ends."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Box(np.array([-1.0, -0.5], np.float32), np.array([2.0, 0.3], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=3)
        return self.state.copy(), {}

    def step(self, action):
        x, y = np.asarray(action, np.float64)
        self.state = 0.8 * self.state + [x, y, x * y] + self.np_random.normal(0, 0.2, 3)
        reward = 1.0 - np.square(self.state).sum()
        return self.state.copy(), float(reward), bool(abs(self.state[0]) > 3), False, {}


class Push(gym.Env):
    """A mass is pushed and loses the more the farther it is from 0.

    A push moves it one step later: who looks at the next reward alone learns nothing.
    """

    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1, 1), 0.0])
        return self.state.copy(), {}

    def step(self, action):
        position, speed = self.state
        self.state = np.array([position + speed, 0.8 * speed + 0.3 * float(action[0])])
        return self.state.copy(), -abs(self.state[0]), False, False, {}


class Count(gym.Env):
    """Observes the step; 1.0 is every reward."""

    observation_space = Box(-np.inf, np.inf, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def observe(self):
        return np.full(self.observation_space.shape, self.steps, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        return self.observe(), 1.0, False, False, {}


class NanReward(Count):
    """Its sixth reward is no number."""

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, np.nan if self.steps == 6 else reward, *rest


class Other(Count):
    """Count with other spaces."""

    def __init__(self, **spaces):
        vars(self).update(spaces)


class Category(Other):
    """Observes one of three categories."""

    def reset(self, **kwargs):
        super().reset(**kwargs)
        return 1, {}

    def step(self, action):
        return 1, *super().step(action)[1:]


class Buggy(Count):
    """Its author made a mistake in step."""

    def step(self, action):
        return {}["missing"]


class Endless(Count):
    """Ends its episodes after `length` steps, and never without; it declares no time limit."""

    def __init__(self, length=np.inf):
        self.length = length

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self.steps >= self.length, False, info


class Slow(Count):
    """A step takes 5 ms."""

    def step(self, action):
        time.sleep(0.005)
        return super().step(action)


class Solves(Count):
    """Tells whether it is solved: in two of five episodes, or in the fifth and sixth.

    `only` tells it only where it is solved, as some do.
    """

    resets = 0

    def __init__(self, key, kind, only=False):
        self.key, self.kind, self.only = key, kind, only

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.resets += 1
        self.solved = self.resets in (5, 6) if self.only else self.np_random.random() < 0.4
        return observation, info

    def step(self, action):
        *rest, info = super().step(action)
        if self.solved or not self.only:
            info[self.key] = self.kind(self.solved)
        return *rest, info


def register(name, entry_point, steps, **kwargs):
    gym.register(f"{name}-v0", entry_point, max_episode_steps=steps, kwargs=kwargs)


register("Tiny", Tiny, 8)
register("Push", Push, 20)
register("Count", Count, 8)
register("NanReward", NanReward, 8)
register("CategoryObservation", Category, 8, observation_space=gym.spaces.Discrete(3))
register("Endless", Endless, None)
register("NoLimit", Endless, None, length=20)
register("DiscreteAction", Other, 8, action_space=gym.spaces.Discrete(3))
register("Unbounded", Other, 8, action_space=Box(-np.inf, np.inf, (1,)))
largest = float(np.finfo(np.float32).max)  # which stands for no bound
register("FloatMax", Other, 8, action_space=Box(-largest, largest, (1,)))
register("NoEnv", object, 8)
register("Buggy", Buggy, 8)
register("Slow", Slow, 100)
register("IsSuccess", Solves, 8, key="is_success", kind=np.bool_)
register("Success", Solves, 8, key="success", kind=int)
register("SuccessOnly", Solves, 8, key="is_success", kind=np.float32, only=True)
