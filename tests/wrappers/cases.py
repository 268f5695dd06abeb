"""What the tests of the wrappers share: noises with their formulas, and environments."""

import itertools
import zlib

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.utils.env_checker import data_equivalence

from noisy_wrappers import parse_noise, run_name

# A noise, and its formula(noise generator, o_t, o_(t-1)) for three numbers; a recursive one has
# what was seen at t-1 instead.
OBSERVATION_CASES = {
    "RandomNormalNoisyObservation(0.3)": lambda g, o, _: o + g.normal(0, 0.3, 3),
    "RandomNormalNoisyObservation((0.3, 0.0, 2.0), loc=-0.5)": (
        lambda g, o, _: o + g.normal(-0.5, [0.3, 0.0, 2.0])
    ),
    "RandomUniformNoisyObservation(-0.2, 0.7)": lambda g, o, _: o + g.uniform(-0.2, 0.7, 3),
    "RandomUniformScaleObservation(0.5, 1.7)": lambda g, o, _: o * g.uniform(0.5, 1.7),
    "RandomUniformScaleObservation(0.5, 1.7, per_dimension=True)": (
        lambda g, o, _: o * g.uniform(0.5, 1.7, 3)
    ),
    "RandomMixupObservation(0.3)": lambda g, o, previous: 0.3 * o + 0.7 * previous,
    "RandomMixupObservation(0.0)": lambda g, o, previous: previous,
    "RandomMixupObservation(0.0, recursive=True)": lambda g, o, seen: seen,  # a lost packet
    "RandomDropoutObservation(0.3)": lambda g, o, _: (g.random(3) < 0.3) * o,
}

REWARD_CASES = {
    "RandomNormalNoisyReward(0.3, loc=2.0)": lambda g, r: r + g.normal(2.0, 0.3),
    "RandomUniformNoisyReward(-0.2, 0.7)": lambda g, r: r + g.uniform(-0.2, 0.7),
    "RandomUniformScaleReward(0.5, 1.7)": lambda g, r: r * g.uniform(0.5, 1.7),
}

# One configuration per wrapper, and the variants.
NOISES = [
    *OBSERVATION_CASES,
    *REWARD_CASES,
    "RandomEarlyTermination(3, 9)",
    "RandomEarlyTermination(3, 9, truncate=True)",
    "RandomEarlyTermination(each_step=True)",
    "RandomNormalNoisyAction(0.3)",
    "RandomNormalNoisyAction(0.3, loc=-0.5)",
    "RandomActionDelay(1, 3)",
    "RandomDynamics(0.5, 1.5)",
    "RandomObservationBias(0.3)",
    "RandomObservationDelay(1, 3)",
]
# One of each base class, and of those that have a mechanism of their own.
BASES = [
    "RandomNormalNoisyObservation(0.3)",
    "RandomMixupObservation(0.3, recursive=True)",
    "RandomNormalNoisyReward(0.3)",
    "RandomEarlyTermination(3, 9)",
    *NOISES[-5:],
]

BOX = gym.spaces.Box(-1, 1, (3,), np.float32)

# A cart with a pole, and what mj_setConst computes for: a tendon, a camera, a light, a constraint.
MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3" mode="trackcom"/>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1" armature="0.2"/>
      <geom type="box" size="0.2 0.1 0.1"/>
      <camera name="track" mode="trackcom" pos="0 -3 0"/>
      <body name="pole" pos="0 0 0.1">
        <joint name="hinge" axis="0 1 0" stiffness="0.5"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.05"/>
      </body>
    </body>
    <body name="ball" pos="0 0 2">
      <freejoint/>
      <geom size="0.1"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="both"><joint joint="slide" coef="1"/><joint joint="hinge" coef="0.3"/></fixed>
  </tendon>
  <equality><connect body1="pole" body2="ball" anchor="0 0 1"/></equality>
  <actuator>
    <motor joint="slide" gear="50"/>
    <position joint="hinge" kp="3" dampratio="1"/>
  </actuator>
</mujoco>
"""


class GenericEnv(gym.Env):
    """An endless environment of random observations and rewards, with functions to replace."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, observation_space=None, observe=None, reward=None, step=None):
        self.observation_space = observation_space or gym.spaces.Box(-10, 10, (3,), np.float64)
        self.model = mujoco.MjModel.from_xml_string(MODEL)  # which nothing here simulates
        self._observe = observe or GenericEnv.draw
        self._reward = reward or (lambda env: float(env.np_random.normal()))
        self._step = step

    def draw(self):
        space = self.observation_space
        return self.np_random.uniform(-5, 5, space.shape).astype(space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(self), {}

    def step(self, action):
        if self._step:
            return self._step(self, action)
        return self._observe(self), self._reward(self), False, False, {}


class Cart(gym.Env):
    """Simulates MODEL. Unlike an environment of Gymnasium's, a copy goes on within an episode."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,))

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)

    def observe(self):
        return np.concatenate([self.data.qpos[:2], self.data.qvel[:2], self.data.qpos[4:5]])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[:2] = self.np_random.normal(size=2)
        return self.observe(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 5)
        return self.observe(), float(self.data.qpos[0]), False, False, {}


gym.register("Cart-v0", "cases:Cart", max_episode_steps=40)


def named(noise=(), noise_rate=(), **others):
    """Return the name of a run's folder, by the arguments that it does not share with the rest."""
    usual = {"env_id": "E", "exp_name": "x", "seed": 1}
    return run_name(usual | {"noise": noise, "noise_rate": noise_rate} | others)


def constant_env(value=2.0, shape=(3,)):
    space = gym.spaces.Box(-np.inf, np.inf, shape, np.float64)
    return GenericEnv(space, lambda env: np.full(shape, value), lambda env: value)


def build(text, env, rate):
    return parse_noise(text)(env, rate)


def registered(text):
    """A registered environment that a noise can work on, and an action."""
    if "Dynamics" in text:
        return "Cart-v0", np.array([0.5, 0.5], np.float32)
    if "Action" in text:
        return "Pendulum-v1", np.array([0.5], np.float32)
    return "CartPole-v1", 0


def streams(wrapper, seed, position=0):
    """The documented seeding of a class, or of a text: the gate's and the noise's generator."""
    name = wrapper.partition("(")[0] if isinstance(wrapper, str) else wrapper.__name__
    entropy = [seed, zlib.crc32(name.encode()), position]
    return [np.random.default_rng(child) for child in np.random.SeedSequence(entropy).spawn(2)]


def rollout(env, seed=None, steps=100, action=0):
    """What a reset and ``steps`` steps return, with resets where episodes end."""
    observation, info = env.reset(seed=seed)
    out = [(observation, None, False, False, info)]
    for _ in range(steps):
        out.append(env.step(action))
        if out[-1][2] or out[-1][3]:
            observation, info = env.reset()
            out.append((observation, None, False, False, info))
    return out


def same(first, second):
    """Two rollouts are equal bit for bit, types included."""
    return data_equivalence(first, second, exact=True)


def numbered_env():
    """Observations 1, 2, 3, ... from the first reset on, all in one array."""
    numbers, array = itertools.count(1), np.zeros(3)

    def observe(env):
        array[:] = next(numbers)
        return array

    return GenericEnv(observe=observe)


A = "RandomNormalNoisyReward(1)"
B = "RandomDropoutObservation(.5)"
C = "RandomEarlyTermination(9,9)"


def layers(env):
    """The names of an environment's wrappers, from the innermost on."""
    names = []
    while isinstance(env, gym.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    return names[::-1]
