"""Gymnasium wrappers that perturb observations, rewards, actions, physics and ends of episodes.

>>> env = make_noisy(gym.make("Pendulum-v1"), ["RandomNormalNoisyReward(0.1)"], [0.5])
>>> observation, info = env.reset(seed=1)
>>> for _ in range(3):
...     observation, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
>>> info["noise"], noise_statistics(env)["rate"]  # the noises that acted on this step; their rate
(('RandomNormalNoisyReward',), 0.5)

With probability p = ``noise_rate`` a step (or an episode) is perturbed, otherwise the data of the
environment pass through untouched. Every wrapper is ``Wrapper(env, noise_rate, <its parameters>)``,
which raises ValueError or TypeError about a bad one; they combine by nesting, or with
:func:`make_noisy`. Nine implement section 3 of Khraishi and Okhrati, "Simple Noisy Environment
Augmentation for Reinforcement Learning"; the others are our own. README.md has a table of all.

A rate that changes during training is written "start:end": ``"1.0:0.0"`` goes linearly from 1 to 0;
:func:`set_progress` says how much of the training is done. On a perturbed step ``info["noise"]`` is
the tuple of the names of the wrappers that acted, innermost first; on other steps it is absent.

Randomness. A wrapper owns two generators, made at ``reset(seed=seed)`` by
``np.random.SeedSequence([seed, zlib.crc32(class_name.encode()), position]).spawn(2)``, in which
``position`` is the number of noise wrappers inside this one. The first, the gate, draws one uniform
number per opportunity, whatever the rate, so under one seed a higher rate perturbs the same steps
and more; the second, ``noise``, draws the noise, for episodes that are not chosen, too. ``reset()``
without a seed continues both streams. The environment's own generator is never touched, so initial
states are the same with and without noise.

``relative=True`` counts additive noise in standard deviations of each number of the observations,
or of the rewards, over all that a wrapper has received; the first 99 stay clean. For actions it
counts in halves of each dimension's range.
"""

import ast
import contextlib
import copy
import difflib
import functools
import hashlib
import importlib
import importlib.metadata
import inspect
import json
import math
import operator
import os
import random
import re
import subprocess
import sys
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np
from gymnasium.envs import registration
from gymnasium.utils import RecordConstructorArgs
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

__version__ = "0.4.0"

# The paper's, then our own; what the scripts and tools use besides is not listed.
__all__ = [
    "RandomNormalNoisyObservation",
    "RandomUniformNoisyObservation",
    "RandomUniformScaleObservation",
    "RandomMixupObservation",
    "RandomDropoutObservation",
    "RandomNormalNoisyReward",
    "RandomUniformNoisyReward",
    "RandomUniformScaleReward",
    "RandomEarlyTermination",
    "RandomNormalNoisyAction",
    "RandomActionDelay",
    "RandomDynamics",
    "RandomObservationBias",
    "RandomObservationDelay",
    "NoiseWrapper",
    "ObservationNoise",
    "RewardNoise",
    "parse_noise",
    "make_noisy",
    "set_progress",
    "noise_wrappers",
    "noise_statistics",
]

Env = gym.Env[Any, Any]
Info = dict[str, Any]
Step = tuple[Any, Any, bool, bool, Info]  # observation, reward, terminated, truncated, info
Array = NDArray[Any]
Rate = float | str  # a number, or "start:end"
Scale = float | tuple[float, ...]  # one number, or one for each dimension
Keys = tuple[str | int, ...] | None  # of a Dict observation; of a Tuple, indices
Config = Mapping[str, Any]  # the content of a config.json, or a script's arguments by name
EntryPath = tuple[Any, ...]  # the keys that lead to an entry of nested observations


# --------------------------------------------------------------------------- the base of all noises


class NoiseWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Base of the noise wrappers, ours and your own: the rate, the random streams, the counters.

    A wrapper calls :meth:`acts` at every opportunity, to decide whether the noise acts now, and
    :meth:`mark` where it has changed something. It draws from ``self.noise``, and passes its own
    arguments on to ``super().__init__``, which records them. docs/wrappers.md has an example.

    Attributes:
        schedule: the rates at the beginning and at the end of training, both in [0, 1].
        parameters: the wrapper's own arguments by name, as its spec records them.
        opportunities: how often the noise might have acted: steps, or episodes.
        times_applied: at how many of them it changed something.
    """

    kind: ClassVar[str]  # what it perturbs: "observation", "reward", "action" or "dynamics"

    def __init__(self, env: Env, noise_rate: Rate, **parameters: Any):
        if _layers(env, gym.wrappers.Autoreset):
            raise ValueError("noise must see every reset: apply gymnasium.wrappers.Autoreset last")
        gym.Wrapper.__init__(self, env)
        self.schedule = _schedule(noise_rate)
        self._progress = 0.0  # the fraction of training done
        self._noise_rate = self.schedule[0]
        RecordConstructorArgs.__init__(self, noise_rate=_as_written(self.schedule), **parameters)
        self.parameters = parameters
        self.opportunities = 0
        self.times_applied = 0
        self._counted = True  # since the last opportunity, in times_applied
        self._spread: _Spread | None = None  # of what it receives, if the noise is relative to it
        self._position = len(_layers(env, NoiseWrapper))
        self._seed(None)

    @property
    def noise_rate(self) -> float:
        """The probability p of perturbing a step (or an episode), as it is now.

        A number may be assigned to this wrapper (see :func:`noise_wrappers`) at any time: it holds
        at once and for the rest of training. 0 is the bare environment bit for bit, 1 perturbs
        every time.
        """
        return self._noise_rate

    @noise_rate.setter
    def noise_rate(self, value: float) -> None:
        rate = _number("noise_rate", value, low=0, high=1)
        self.schedule = (rate, rate)
        self._noise_rate = rate

    def set_progress(self, fraction: float) -> None:
        """Call :func:`set_progress` with this environment, as a vector environment can do."""
        set_progress(self, fraction)

    def noise_statistics(self) -> dict[str, float]:
        """Return :func:`noise_statistics` of this environment."""
        return noise_statistics(self)

    @property
    def applied_fraction(self) -> float:
        """The realised rate, times_applied / opportunities; 0 before the first opportunity."""
        return self.times_applied / max(1, self.opportunities)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment; a seed also reseeds the noise. The rate follows its schedule."""
        self._begin(seed)
        return self.env.reset(seed=seed, options=options)

    def _begin(self, seed: int | None) -> None:
        """Begin an episode, before the environment does; a wrapper may decide here what to do."""
        self._noise_rate = float(np.interp(self._progress, (0.0, 1.0), self.schedule))
        if seed is not None:
            self._seed(seed)

    def _seed(self, seed: int | None) -> None:
        name = zlib.crc32(type(self).__name__.encode())
        entropy = None if seed is None else [seed, name, self._position]
        for_gate, for_noise = np.random.SeedSequence(entropy).spawn(2)
        self._gate, self.noise = np.random.default_rng(for_gate), np.random.default_rng(for_noise)

    def _in_units(self, noise: Any) -> Any:
        """Return additive noise in the units of what is received."""
        return noise if self._spread is None else noise * self._spread.deviation

    def acts(self) -> bool:
        """Decide with probability p whether the noise acts now: on this step, or in this episode.

        Each call is an opportunity. It draws one uniform number, whatever the rate.
        """
        self.opportunities += 1
        self._counted = False
        return self._gate.random() < self._noise_rate

    def mark(self, info: Info) -> Info:
        """Return a step's info with the name of this noise, which has changed something.

        That is a new dict: the environment may reuse its own. The first mark after an opportunity
        counts in ``times_applied``.
        """
        if not self._counted:
            self._counted = True
            self.times_applied += 1
        below = info.get("noise")
        if not isinstance(below, tuple):  # nothing, or the environment's own
            below = ()
        return {**info, "noise": (*below, type(self).__name__)}

    def state_dict(self) -> dict[str, Any]:
        """Return counters, rates and estimates; :class:`EnvState` keeps the streams, too."""
        state = {
            "opportunities": self.opportunities,
            "times_applied": self.times_applied,
            "schedule": list(self.schedule),  # a number may have been assigned to noise_rate
        }
        if self._spread is not None:
            state["spread"] = _without_arrays(vars(self._spread))
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what a :meth:`state_dict` holds; the next call must be ``reset()``."""
        self.opportunities = state["opportunities"]
        self.times_applied = state["times_applied"]
        self.schedule = tuple(state["schedule"])
        if self._spread is not None:
            self._spread = _Spread(**state["spread"])


class _Spread:
    """The standard deviation of each dimension of what a wrapper received (Welford's algorithm).

    It is 0 until 100 samples are in. A sample that is not finite does not count.
    """

    def __init__(self, count: int = 0, mean: Any = 0.0, squares: Any = 0.0):
        self.count = count
        self.mean = np.array(mean) if isinstance(mean, list) else mean
        self.squares = np.array(squares) if isinstance(squares, list) else squares

    def add(self, sample: Any) -> None:
        """Take in an array or a number."""
        total = sample if isinstance(sample, float) else np.add.reduce(sample, axis=None)
        if math.isfinite(total):
            self.count += 1
            difference = sample - self.mean
            self.mean = self.mean + difference / self.count
            self.squares = self.squares + difference * (sample - self.mean)

    @property
    def deviation(self) -> Any:
        return (self.squares / (self.count - 1)) ** 0.5 if self.count >= 100 else 0.0


# ---------------------------------------------------------------------------- noise on observations


class ObservationNoise(NoiseWrapper):
    """Base of the observation wrappers: subclasses define ``_perturb``.

    What they perturb are numbers: a Box of floats or integers. In a Dict or Tuple observation these
    are all entries of this kind, as one vector in the order of the space, with one decision a step;
    ``keys`` restricts them to some of the top level (of a Tuple: indices). All other entries stay.
    What is perturbed has the dtype of its space; integers are computed in float64, rounded and
    clipped to their dtype. The space is widened to what noise can reach. ValueError if there are no
    numbers, or none of these ``keys``.
    """

    kind = "observation"

    def __init__(self, env: Env, noise_rate: Rate, *, keys: Keys = None, **parameters: Any):
        self.keys = _keys(keys)
        if self.keys is not None:  # a wrapper of your own need not take them
            parameters["keys"] = self.keys
        super().__init__(env, noise_rate, **parameters)
        self._boxes = {} if isinstance(env, _ProbeEnv) else self._find_boxes(env)
        self._places: dict[EntryPath, Any] = {}  # of the boxes in the vector: slice, shape, dtype
        size = 0
        for path, box in self._boxes.items():
            place = slice(size, size + math.prod(box.shape))
            self._places[path] = place, box.shape, box.dtype
            size = place.stop
        # of what is perturbed
        self._shape = self._boxes[()].shape if () in self._boxes else (size,)
        if type(self).__module__ != __name__:  # nobody knows what yours can reach
            self._widen(lambda bound: (-np.inf, np.inf))

    def _find_boxes(self, env: Env) -> dict[EntryPath, gym.spaces.Box]:
        """Return the entries to perturb: {path in the observation: their space}."""
        space = env.observation_space
        entries = dict(_entries(space))
        if self.keys is not None:
            known = [*dict.fromkeys(path[0] for path in entries if path)]  # each key once
            if not self.keys or not set(self.keys) <= set(known):
                raise ValueError(f"keys={self.keys!r}: these observations have the keys {known}")
            entries = {path: part for path, part in entries.items() if path[0] in self.keys}
        boxes = {path: part for path, part in entries.items() if _is_box(part, "fiu")}
        if not boxes:
            needed = "needs observations of floats or integers"
            raise ValueError(f"{type(self).__name__} {needed}, got {space}: use another noise")
        return boxes

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment and perturb the first observation with probability p."""
        observation, info = super().reset(seed=seed, options=options)
        return self._observe(observation, info)

    def step(self, action: Any) -> Step:
        """Step the environment and perturb the observation with probability p."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        observation, info = self._observe(observation, info)
        return observation, reward, terminated, truncated, info

    def _observe(self, observation: Any, info: Info) -> tuple[Any, Info]:
        """Return what is seen of an observation, and the info."""
        if self._spread is not None:
            self._spread.add(self._numbers(observation))
        if not self._acts_now():
            return observation, info
        return self._perturbed(observation, self._numbers(observation), info)

    def _acts_now(self) -> bool:
        return self.acts()

    def _perturbed(self, observation: Any, given: Array, info: Info) -> tuple[Any, Info]:
        """Return an observation with noise, of which ``given`` are the numbers, and the info."""
        numbers = np.asarray(self._perturb(given))
        if numbers.shape != given.shape:
            wanted = f"an array of shape {given.shape}, not {numbers.shape}"
            raise ValueError(f"{type(self).__name__}._perturb must return {wanted}")
        parts, clean = self._parts(numbers), self._parts(given)
        changed = any(np.count_nonzero(part != clean[path]) for path, part in parts.items())
        return _replaced(observation, parts), (self.mark(info) if changed else info)

    def _parts(self, numbers: Array) -> dict[EntryPath, Array]:
        """Return the entries that consist of these numbers, in the dtype of their space."""
        if () in self._boxes:
            return {(): _cast(numbers, self._boxes[()].dtype)}
        return {
            path: _cast(numbers[place].reshape(shape), dtype)
            for path, (place, shape, dtype) in self._places.items()
        }

    def _perturb(self, observation: Array) -> Array:
        """Return the numbers of an observation with noise, a new array.

        They are float64 in the shape of the Box; those of a Dict or Tuple are one vector.
        """
        raise NotImplementedError

    def _numbers(self, observation: Any) -> Array:
        """Return a copy of the entries to perturb, which must not be written to."""
        if () in self._boxes:
            numbers = np.array(observation, np.float64)
        else:
            parts = [functools.reduce(operator.getitem, path, observation) for path in self._boxes]
            numbers = np.concatenate(parts, axis=None, dtype=np.float64, casting="unsafe")
        numbers.flags.writeable = False
        return numbers

    def _check_scale(self, scale: Scale) -> None:
        """Raise ValueError unless a tuple of scales fits."""
        if isinstance(scale, tuple) and self._boxes and self._shape != (len(scale),):
            problem = f"scale has {len(scale)} numbers and the observation has shape {self._shape}"
            raise ValueError(f"{problem}: give one number for all dimensions or one for each")

    def _widen(self, ends_of: Callable[[Array], Sequence[Any]]) -> None:
        """Extend the observation space to what ``ends_of`` says noise makes of its bounds."""
        widened = {}
        for path, box in self._boxes.items():
            with np.errstate(over="ignore", invalid="ignore"):
                ends = [*ends_of(box.low.astype(np.float64)), *ends_of(box.high.astype(np.float64))]
                reached = np.stack([np.broadcast_to(end, box.shape) for end in ends])
                reached[np.isnan(reached)] = 0.0  # 0 * inf is 0 here
                low = np.minimum(box.low, _cast(reached.min(axis=0), box.dtype))
                high = np.maximum(box.high, _cast(reached.max(axis=0), box.dtype))
            widened[path] = gym.spaces.Box(np.asarray(low), np.asarray(high), dtype=box.dtype.type)
        if widened:
            self.observation_space = _replaced(self.env.observation_space, widened)


class RandomNormalNoisyObservation(ObservationNoise):
    """Adds Gaussian noise to the observation: o + e with e ~ N(loc, scale^2 I) (section 3.1).

    ``scale`` is the paper's sigma: one number for all dimensions, or a tuple with one for each of a
    one-dimensional observation. e = ``noise.normal(loc, scale, o.shape)``. noisyenv 0.1.1 takes loc
    first.

    >>> env = RandomNormalNoisyObservation(gym.make("CartPole-v1"), 1.0, 0.1)
    >>> env.reset(seed=0)[0]
    array([ 0.00053917,  0.05760334,  0.07080678, -0.0334335 ], dtype=float32)
    """

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        scale: Scale,
        *,
        loc: float = 0.0,
        relative: bool = False,
        keys: Keys = None,
    ):
        self.scale, self.loc = _scale_or_scales(scale), _number("loc", loc)
        parameters = {"scale": self.scale, "loc": self.loc, "relative": relative}
        super().__init__(env, noise_rate, **parameters, keys=keys)
        self._spread = _Spread() if _flag("relative", relative) else None
        self._check_scale(self.scale)
        self._widen(lambda bound: (-np.inf, np.inf))

    def _perturb(self, observation: Array) -> Array:
        noise = self.noise.normal(self.loc, self.scale, observation.shape)
        return observation + self._in_units(noise)


class RandomUniformNoisyObservation(ObservationNoise):
    """Adds uniform noise: o + e with each e_i ~ U(low, high) (section 3.1).

    ``low``, ``high``: the paper's alpha and beta. e = ``noise.uniform(low, high, o.shape)``.
    """

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        low: float,
        high: float,
        *,
        relative: bool = False,
        keys: Keys = None,
    ):
        self.low, self.high = _interval(low, high)
        parameters = {"low": self.low, "high": self.high, "relative": relative}
        super().__init__(env, noise_rate, **parameters, keys=keys)
        self._spread = _Spread() if _flag("relative", relative) else None
        unknown = (-np.inf, np.inf)  # the standard deviations
        self._widen(lambda bound: unknown if relative else (bound + self.low, bound + self.high))

    def _perturb(self, observation: Array) -> Array:
        noise = self.noise.uniform(self.low, self.high, observation.shape)
        return observation + self._in_units(noise)


class RandomUniformScaleObservation(ObservationNoise):
    """Scales the observation: o * e with e ~ U(low, high) (section 3.1).

    e is one factor for the whole observation, ``noise.uniform(low, high)``, or with
    ``per_dimension`` one for each element, ``noise.uniform(low, high, o.shape)``.
    """

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        low: float,
        high: float,
        *,
        per_dimension: bool = False,
        keys: Keys = None,
    ):
        self.low, self.high = _interval(low, high)
        self.per_dimension = _flag("per_dimension", per_dimension)
        parameters = {"low": self.low, "high": self.high, "per_dimension": per_dimension}
        super().__init__(env, noise_rate, **parameters, keys=keys)
        self._widen(lambda bound: (bound * self.low, bound * self.high))

    def _perturb(self, observation: Array) -> Array:
        size = observation.shape if self.per_dimension else None
        return observation * self.noise.uniform(self.low, self.high, size)


class RandomMixupObservation(ObservationNoise):
    """Blends in the last observation: factor * o_t + (1 - factor) * o_(t-1) (section 3.1).

    ``factor`` is the paper's lambda. o_(t-1) is what this wrapper received at the last step;
    ``recursive=True`` blends with what it returned instead, as noisyenv 0.1.1 does. The first
    observation of an episode passes untouched and is no opportunity. With factor = 0 the agent sees
    the observation before; with ``recursive``, the last one that arrived: a packet was lost.
    """

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        factor: float,
        *,
        recursive: bool = False,
        keys: Keys = None,
    ):
        self.factor = _number("factor", factor, low=0, high=1)
        self.recursive = _flag("recursive", recursive)
        super().__init__(env, noise_rate, factor=self.factor, recursive=recursive, keys=keys)
        self._previous: Array | None = None

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        self._previous = None

    def _observe(self, observation: Any, info: Info) -> tuple[Any, Info]:
        received = self._numbers(observation)  # a copy: the environment may reuse its array
        if self._previous is not None and self.acts():
            observation, info = self._perturbed(observation, received, info)
        self._previous = self._numbers(observation) if self.recursive else received
        return observation, info

    def _perturb(self, observation: Array) -> Array:
        assert self._previous is not None
        if self.factor in (0, 1):  # 0 * inf would be NaN
            return (observation if self.factor == 1 else self._previous).copy()
        mixture = self.factor * observation + (1 - self.factor) * self._previous
        low, high = np.minimum(observation, self._previous), np.maximum(observation, self._previous)
        return np.minimum(np.maximum(mixture, low), high)  # rounding must not leave the space


class RandomDropoutObservation(ObservationNoise):
    """Sets elements of the observation to 0: r * o with r_i ~ Bernoulli(keep_prob) (section 3.1).

    ``keep_prob`` is the paper's eta, the probability that an element is *kept*;
    r = ``noise.random(o.shape) < keep_prob``. noisyenv 0.1.1 takes the probability of *dropping*.
    """

    def __init__(self, env: Env, noise_rate: Rate, keep_prob: float, *, keys: Keys = None):
        self.keep_prob = _number("keep_prob", keep_prob, low=0, high=1)
        super().__init__(env, noise_rate, keep_prob=self.keep_prob, keys=keys)
        self._widen(lambda bound: (0.0,))

    def _perturb(self, observation: Array) -> Array:
        return np.where(self.noise.random(observation.shape) < self.keep_prob, observation, 0.0)


class RandomObservationBias(ObservationNoise):
    """Adds the same e ~ N(0, scale^2 I) to all observations of an episode. Not in the paper.

    At ``reset()`` the episode is chosen with probability p, and e is drawn, ``noise.normal(0,
    scale, o.shape)``, one ``scale`` or a tuple of them; ``relative`` to the standard deviations
    when the episode began. ``times_applied`` counts episodes. So fails a sensor that is badly
    calibrated.
    """

    def __init__(
        self, env: Env, noise_rate: Rate, scale: Scale, *, relative: bool = False, keys: Keys = None
    ):
        self.scale = _scale_or_scales(scale)
        super().__init__(env, noise_rate, scale=self.scale, relative=relative, keys=keys)
        self._spread = _Spread() if _flag("relative", relative) else None
        self._check_scale(self.scale)
        self._widen(lambda bound: (-np.inf, np.inf))
        self._bias: Array | None = None  # of the episode, if it is chosen

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        bias = self._in_units(self.noise.normal(0, self.scale, self._shape))
        self._bias = bias if self.acts() else None

    def _acts_now(self) -> bool:
        return self._bias is not None

    def _perturb(self, observation: Array) -> Array:
        return observation + self._bias


class RandomObservationDelay(ObservationNoise):
    """Shows the observations of an episode k steps late, k uniform on low, ..., high. Our own.

    At ``reset()`` the episode is chosen with probability p, and k is drawn, ``noise.integers(low,
    high, endpoint=True)``. In a chosen episode the agent sees what was there k steps before, and
    until then what ``reset()`` gave: with k = 2 it sees o0 o0 o0 o1 o2. ``high`` is ``low`` by
    default. ``times_applied`` counts episodes.
    """

    def __init__(
        self, env: Env, noise_rate: Rate, low: int, high: int | None = None, *, keys: Keys = None
    ):
        self.low, self.high = _whole_interval(low, high, least=0)
        written = None if self.high == self.low else self.high
        super().__init__(env, noise_rate, low=self.low, high=written, keys=keys)
        self._delay = 0
        self._received: deque[Array] = deque()  # what is seen now, and what waits

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        delay = int(self.noise.integers(self.low, self.high, endpoint=True))
        self._delay = delay if self.acts() else 0
        self._received = deque(maxlen=self._delay + 1)

    def _observe(self, observation: Any, info: Info) -> tuple[Any, Info]:
        if not self._delay:
            return observation, info
        self._received.append(self._numbers(observation))
        return self._perturbed(observation, self._received[-1], info)

    def _perturb(self, observation: Array) -> Array:
        return self._received[0].copy()


# --------------------------------------------------------------------------------- noise on rewards


class RewardNoise(NoiseWrapper):
    """Base of the reward wrappers: subclasses define ``_perturb``.

    The reward may be an array of one number; perturbed it is a float.
    """

    kind = "reward"

    def step(self, action: Any) -> Step:
        """Step the environment and perturb the reward with probability p."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._spread is not None:
            self._spread.add(float(_number_in(reward)))
        if self.acts():
            given = float(_number_in(reward))
            reward = self._perturb(given)
            if reward != given:
                info = self.mark(info)
        return observation, reward, terminated, truncated, info

    def _perturb(self, reward: float) -> float:
        """Return a reward with noise."""
        raise NotImplementedError


class RandomNormalNoisyReward(RewardNoise):
    """Adds Gaussian noise to the reward: r + e with e ~ N(loc, scale^2) (section 3.2).

    ``scale``: the paper's sigma. e = ``noise.normal(loc, scale)``. noisyenv 0.1.1 takes loc first.
    """

    def __init__(
        self, env: Env, noise_rate: Rate, scale: float, *, loc: float = 0.0, relative: bool = False
    ):
        self.scale, self.loc = _number("scale", scale, low=0), _number("loc", loc)
        super().__init__(env, noise_rate, scale=self.scale, loc=self.loc, relative=relative)
        self._spread = _Spread() if _flag("relative", relative) else None

    def _perturb(self, reward: float) -> float:
        return reward + self._in_units(self.noise.normal(self.loc, self.scale))


class RandomUniformNoisyReward(RewardNoise):
    """Adds uniform noise to the reward: r + e with e ~ U(low, high) (section 3.2).

    ``low``, ``high``: the paper's alpha and beta. e = ``noise.uniform(low, high)``.
    """

    def __init__(
        self, env: Env, noise_rate: Rate, low: float, high: float, *, relative: bool = False
    ):
        self.low, self.high = _interval(low, high)
        super().__init__(env, noise_rate, low=self.low, high=self.high, relative=relative)
        self._spread = _Spread() if _flag("relative", relative) else None

    def _perturb(self, reward: float) -> float:
        return reward + self._in_units(self.noise.uniform(self.low, self.high))


class RandomUniformScaleReward(RewardNoise):
    """Scales the reward: r * e with e = ``noise.uniform(low, high)`` (section 3.2)."""

    def __init__(self, env: Env, noise_rate: Rate, low: float, high: float):
        self.low, self.high = _interval(low, high)
        super().__init__(env, noise_rate, low=self.low, high=self.high)

    def _perturb(self, reward: float) -> float:
        return reward * self.noise.uniform(self.low, self.high)


# -------------------------------------------------------- noise on actions, and on ends of episodes


class RandomNormalNoisyAction(NoiseWrapper):
    """Adds Gaussian noise to the action: a + e with e ~ N(loc, scale^2 I). Not in the paper.

    The environment receives a + e clipped to its action space, in the space's dtype; the caller's
    action is left as it is, and without noise passes unclipped. e = ``noise.normal(loc, scale,
    a.shape)``; ``relative`` needs finite bounds.
    """

    kind = "action"

    def __init__(
        self, env: Env, noise_rate: Rate, scale: float, *, loc: float = 0.0, relative: bool = False
    ):
        self.scale, self.loc = _number("scale", scale, low=0), _number("loc", loc)
        super().__init__(env, noise_rate, scale=self.scale, loc=self.loc, relative=relative)
        space = self._space = env.action_space
        if not _is_box(space, "f"):
            raise ValueError(f"RandomNormalNoisyAction needs Box actions of floats, got {space}")
        if _flag("relative", relative) and not is_bounded(space):
            raise ValueError(f"relative=True needs bounded actions, got {space}")
        self._low, self._high = space.low.astype(np.float64), space.high.astype(np.float64)
        self._unit = (self._high - self._low) / 2 if relative else None

    def step(self, action: Any) -> Step:
        """Perturb the action with probability p and step the environment."""
        if not self.acts():
            return self.env.step(action)
        dtype = self._space.dtype
        noise = self.noise.normal(self.loc, self.scale, self._space.shape)
        if self._unit is not None:
            noise *= self._unit
        unclipped = np.asarray(action, np.float64) + noise
        noisy = np.minimum(np.maximum(unclipped, self._low), self._high).astype(dtype)
        observation, reward, terminated, truncated, info = self.env.step(noisy)
        if np.count_nonzero(noisy != np.asarray(action, dtype)):
            info = self.mark(info)
        return observation, reward, terminated, truncated, info


class RandomActionDelay(NoiseWrapper):
    """Delays the actions of an episode by k steps, k uniform on low, ..., high. Not in the paper.

    At ``reset()`` the episode is chosen with probability p, and k is drawn, ``noise.integers(low,
    high, endpoint=True)``. In a chosen episode every action takes effect k steps later, and until
    then the first one acts: with k = 2 the environment receives a0 a0 a0 a1 a2. ``high`` is ``low``
    by default. ``times_applied`` counts the episodes in which a delayed action took effect.
    Bouteiller et al., "Reinforcement Learning with Random Delays", 2021.
    """

    kind = "action"

    def __init__(self, env: Env, noise_rate: Rate, low: int, high: int | None = None):
        self.low, self.high = _whole_interval(low, high, least=0)
        written = None if self.high == self.low else self.high
        super().__init__(env, noise_rate, low=self.low, high=written)
        self._delay = 0
        self._actions: deque[Any] = deque()  # the one that acts now, and those that wait

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        delay = int(self.noise.integers(self.low, self.high, endpoint=True))
        self._delay = delay if self.acts() else 0
        self._actions = deque(maxlen=self._delay + 1)

    def step(self, action: Any) -> Step:
        """Step the environment with the action of some steps ago."""
        if not self._delay:
            return self.env.step(action)
        self._actions.append(copy.deepcopy(action))  # the caller may reuse an array
        delayed = copy.deepcopy(self._actions[0])
        observation, reward, terminated, truncated, info = self.env.step(delayed)
        if len(self._actions) > 1:  # so this step's action waits
            info = self.mark(info)
        return observation, reward, terminated, truncated, info


class RandomEarlyTermination(NoiseWrapper):
    """Ends an episode early, at a step drawn from the integers low, ..., high (section 3.3).

    At ``reset()`` the episode is chosen with probability p, and its last step is drawn,
    k = ``noise.integers(low, high, endpoint=True)``. A chosen episode that is still going at its
    k-th step ends there: ``terminated`` is set, or ``truncated`` if ``truncate=True``. ``high`` is
    ``low`` by default. ``each_step=True``, without low and high, is the paper's alternative: every
    step ends the episode with probability p. ``times_applied`` counts the episodes that it ended.
    """

    kind = "dynamics"

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        low: int | None = None,
        high: int | None = None,
        *,
        each_step: bool = False,
        truncate: bool = False,
    ):
        if _records_episodes(env):
            raise ValueError(
                "RandomEarlyTermination needs to be inside of what records episodes "
                "(RecordEpisodeStatistics, Monitor): the record would miss those that it ends"
            )
        self.each_step, self.truncate = _flag("each_step", each_step), _flag("truncate", truncate)
        if not each_step:
            low, high = _whole_interval(low, high, least=1)
        elif low is not None or high is not None:
            raise ValueError(f"each_step=True excludes low and high, got low={low}, high={high}")
        self.low, self.high = low, high
        written = None if high == low else high  # (50, 50) is written (50)
        flags = {"each_step": each_step, "truncate": truncate}
        super().__init__(env, noise_rate, low=low, high=written, **flags)
        self._steps = 0
        self._last_step: int | None = None

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        self._steps = 0
        if not self.each_step:
            last_step = int(self.noise.integers(self.low, self.high, endpoint=True))
            self._last_step = last_step if self.acts() else None

    def step(self, action: Any) -> Step:
        """Step the environment and end the episode if its time has come."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._steps += 1
        ends = self.acts() if self.each_step else self._steps == self._last_step
        if ends and self.truncate and not (terminated or truncated):
            truncated, info = True, self.mark(info)
        if ends and not self.truncate and not terminated:
            terminated, info = True, self.mark(info)
        return observation, reward, terminated, truncated, info


# --------------------------------------------------------------------------------- noise on physics


class RandomDynamics(NoiseWrapper):
    """Scales masses, frictions and the like of a MuJoCo model for an episode. Not in the paper.

    At ``reset()`` the episode is chosen with probability p. In a chosen one, each row of the named
    ``fields`` of the model (that of a body, a degree of freedom, an actuator) is its own value
    times e ~ U(low, high), ``noise.uniform(low, high, number of rows)`` for each field in turn, and
    what MuJoCo derives from these values is derived anew. All is undone at the next ``reset()``. An
    environment whose own ``reset()`` sets a field is a SpaceError. ``info["dynamics"]`` of a chosen
    episode's reset has the factors, {field: array}. ``times_applied`` counts episodes.
    docs/wrappers.md says what the fields mean, what is scaled along, and where a model is found.
    Peng et al., "Sim-to-Real Transfer with Dynamics Randomization", 2018.

    >>> env = RandomDynamics(gym.make("InvertedPendulum-v5"), 1.0, 0.5, 1.5)
    >>> env.reset(seed=0)[1]["dynamics"]["body_mass"].round(2)  # of the world, the cart, the pole
    array([0.84, 0.53, 0.81])
    """

    kind = "dynamics"

    def __init__(
        self,
        env: Env,
        noise_rate: Rate,
        low: float,
        high: float,
        *,
        fields: tuple[str, ...] = ("body_mass", "geom_friction"),
    ):
        self.low, self.high = _interval(low, high, least=0)
        self.fields = _fields(fields)
        super().__init__(env, noise_rate, low=self.low, high=self.high, fields=self.fields)
        self._factors: dict[str, Array] = {}  # of the episode; none if it is not chosen
        self._outer: list[RandomDynamics] = []  # wrappers whose reset() waits for this one's
        for inner in _layers(env, RandomDynamics):
            if common := _with_those_along(self.fields) & _with_those_along(inner.fields):
                problem = "another RandomDynamics of this environment scales"
                raise ValueError(f"fields={self.fields}: {problem} {', '.join(common)}, too")
        if not isinstance(env, _ProbeEnv):
            self._restore()  # what another wrapper has left of this environment
            _check_fields(self._model(), self.fields)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Restore the model, perhaps change it anew, and reset the environment."""
        self._begin(seed)
        drawn = self._draw(self._model())
        chosen = self.acts() and any((factors != 1).any() for factors in drawn.values())
        self._factors = drawn if chosen else {}
        inner = _layers(self.env, RandomDynamics)
        if inner:  # the innermost changes the model for all of them, at once
            inner[-1]._outer.append(self)
            try:
                observation, info = self.env.reset(seed=seed, options=options)
            finally:
                inner[-1]._outer.remove(self)
        else:
            observation, info = self._reset_scaled(seed, options)
        if self._factors:
            info = self.mark(info)
            others = info["dynamics"] if any(wrapper._factors for wrapper in inner) else {}
            info["dynamics"] = {**others, **self._factors}
        return observation, info

    def step(self, action: Any) -> Step:
        """Step the environment; every step of a chosen episode is a perturbed one."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._factors:
            info = self.mark(info)
        return observation, reward, terminated, truncated, info

    def _draw(self, model: Any) -> dict[str, Array]:
        """Return factors for all rows of the fields."""
        factors = {}
        for field in self.fields:
            rows = len(getattr(model, field))
            drawn = self.noise.uniform(self.low, self.high, 1 if field in _FRICTIONS else rows)
            factors[field] = np.broadcast_to(drawn, rows).copy()
        return factors

    def _model(self) -> Any:
        """Return the environment's mujoco.MjModel."""
        mujoco = sys.modules.get("mujoco")  # an environment that has a model has imported it
        base = self.env.unwrapped
        physics = getattr(getattr(base, "_env", base), "physics", None)  # of dm_control
        for model in (getattr(base, "model", None), getattr(physics, "model", None)):
            model = getattr(model, "ptr", model)  # dm_control wraps it
            if mujoco and isinstance(model, mujoco.MjModel):
                return model
        where = "as its .model or .physics.model"
        raise ValueError(f"RandomDynamics needs a MuJoCo model, {where}, and {base} has none")

    def _reset_scaled(self, seed: int | None, options: Info | None) -> tuple[Any, Info]:
        """Scale the model by the factors of this wrapper and the outer ones, and reset."""
        wrappers = [*self._outer, self]
        self._restore()
        model = self._model()
        self._scale(model, wrappers)  # before the environment's own reset, which needs it
        named = _with_those_along(field for wrapper in wrappers for field in wrapper.fields)
        before = {field: _values(model, field) for field in named}
        observation, info = self.env.reset(seed=seed, options=options)
        now = self._model()
        if now is not model:  # the environment has built another one
            self._restore()
            for wrapper in wrappers:
                if any(len(f) != len(_values(now, name)) for name, f in wrapper._factors.items()):
                    wrapper._factors = wrapper._draw(now)
            self._scale(now, wrappers)
        elif changed := [f for f in before if (_values(model, f) != before[f]).any()]:
            reason = f"this environment's reset() sets {changed[0]} itself: name other fields"
            raise SpaceError(f"fields: {reason}")  # no factor would be left
        return observation, info

    def _scale(self, model: Any, wrappers: "list[RandomDynamics]") -> None:
        factors = {name: f for wrapper in wrappers for name, f in wrapper._factors.items()}
        if not factors:
            return
        # by the environment, because another wrapper may have to undo it
        self.unwrapped._scaled_model = model, _scale_model(model, factors)

    def _restore(self) -> None:
        """Undo what was written; what the environment has written since then stays."""
        model, written = getattr(self.unwrapped, "_scaled_model", (None, {}))
        for name, (before, new) in written.items():
            values = _values(model, name)
            _set_values(model, name, np.where(values == new, before, values))
        written.clear()


_FIELDS: tuple[str, ...] = ("body_mass", "body_inertia", "geom_friction", "pair_friction")
_FIELDS += ("jnt_stiffness", "dof_damping", "dof_frictionloss", "dof_armature")
_FIELDS += ("tendon_stiffness", "tendon_damping", "tendon_frictionloss")
_FIELDS += ("actuator_gainprm", "actuator_forcerange", "actuator_gear")
_FRICTIONS = ("geom_friction", "pair_friction")
_SCALED_ALONG = {"body_mass": "body_inertia", "actuator_gainprm": "actuator_biasprm"}
# What mj_setConst derives from them, in the model and in its stat; older versions lack some.
_DERIVED_FIELDS: tuple[str, ...] = ("body_subtreemass", "body_invweight0", "dof_invweight0")
_DERIVED_FIELDS += ("dof_M0", "actuator_acc0", "actuator_length0", "tendon_invweight0")
_DERIVED_FIELDS += ("flexedge_invweight0", "cam_poscom0", "light_poscom0")
_DERIVED_STATISTICS = ("meaninertia", "meanmass")
# Which of an actuator's ten parameters are its strength, by its type: of the gain a fixed one, an
# affine one, a muscle; of the bias none, an affine one (of a servo), a muscle.
_STRENGTH_IN_GAIN = {0: (0, 1, 2), 1: (0, 1, 2), 2: (2, 3)}
_STRENGTH_IN_BIAS = {0: (), 1: (1, 2), 2: (2, 3)}


def _scale_model(model: Any, factors: dict[str, Array]) -> dict[str, Any]:
    """Multiply the rows of a model's fields by their factors, {field: factors}.

    Return {name: (values before, values written)} of all that was changed.
    """
    mujoco = sys.modules["mujoco"]
    written = {}
    trial = copy.copy(model)  # mj_setConst also writes what the environment may have set itself
    for name, of_elements in _factors_of_elements(model, factors).items():
        before = _values(model, name)
        written[name] = before, before * of_elements
        _set_values(trial, name, before * of_elements)
    mujoco.mj_setConst(trial, mujoco.MjData(trial))
    for name in (*_DERIVED_FIELDS, *_DERIVED_STATISTICS):
        if name in _DERIVED_STATISTICS or hasattr(model, name):
            written[name] = _values(model, name), _values(trial, name)
    for name, (_, new) in written.items():
        _set_values(model, name, new)
    return written


def _values(model: Any, name: str) -> Array:
    """Return a copy of a field of MuJoCo's model, or of one of its statistics."""
    return np.array(getattr(model.stat if name in _DERIVED_STATISTICS else model, name))


def _set_values(model: Any, name: str, values: Array) -> None:
    setattr(model.stat if name in _DERIVED_STATISTICS else model, name, values)


def _with_those_along(fields: Iterable[str]) -> set[str]:
    found = set(fields)
    return found | {along for field, along in _SCALED_ALONG.items() if field in found}


def _factors_of_elements(model: Any, factors: dict[str, Array]) -> dict[str, Array]:
    """Return the factors of all elements of the fields, and of those that are scaled along."""
    found = {}
    for field, of_rows in factors.items():
        for name in _with_those_along([field]):
            ones = np.ones_like(getattr(model, name))  # a row is one number or several
            found[name] = (ones.T * of_rows).T
    if "actuator_gainprm" in factors:  # not the shape of a muscle, nor a servo's constant force
        gain, bias = found["actuator_gainprm"], found["actuator_biasprm"]
        types = (model.actuator_gaintype.tolist(), model.actuator_biastype.tolist())
        for i, (type_of_gain, type_of_bias) in enumerate(zip(*types, strict=True)):
            gain[i, np.setdiff1d(range(10), _STRENGTH_IN_GAIN[type_of_gain])] = 1
            bias[i, np.setdiff1d(range(10), _STRENGTH_IN_BIAS[type_of_bias])] = 1
    return found


def _check_fields(model: Any, fields: tuple[str, ...]) -> None:
    """Raise ValueError unless scaling the fields changes a model as it should."""
    for field in fields:
        if not getattr(model, field).any():
            problem = f"this environment's model has no {field}, or zeros only"
            raise ValueError(f"fields: {problem}: name other fields")
        if np.any(getattr(model, f"{field}poly", 0)):  # of stiffness and damping
            raise ValueError(f"fields: {field} of this environment's model is a polynomial")
    types = {*model.actuator_gaintype.tolist(), *model.actuator_biastype.tolist()}
    constant = model.actuator_biasprm[model.actuator_biastype == 1, 0]  # of affine ones
    if "actuator_gainprm" in fields and (constant.any() or not types <= _STRENGTH_IN_GAIN.keys()):
        needed = "motors, muscles, or servos without a constant bias"
        raise ValueError(f"fields: actuator_gainprm needs an environment's model to have {needed}")


# -------------------------------------------------------------------- noises in words, and combined


WRAPPERS: dict[str, type[NoiseWrapper]] = {
    name: globals()[name] for name in __all__ if name.startswith("Random")
}


def signatures() -> list[str]:
    """Return the wrappers with their parameters, as a noise is written."""
    found = []
    for name, wrapper in WRAPPERS.items():
        parameters = [p.replace(annotation=p.empty) for p in _parameters(wrapper)]
        text = f"{name}{inspect.Signature(parameters)}"
        # as early termination and the delays mean it
        found.append(re.sub("low(=None)?, high=None", "low, high=low", text))
    return found


@dataclass(frozen=True)
class Noise:
    """A wrapper and its parameters, without environment and rate; equal ones are equal objects."""

    wrapper: type[NoiseWrapper]
    text: str  # canonical, e.g. "RandomMixupObservation(0.0, recursive=True)"

    def __call__(self, env: Env, noise_rate: Rate) -> NoiseWrapper:
        """Wrap an environment."""
        _, _, args, kwargs = _read_call(self.text)
        return self.wrapper(env, noise_rate, *args, **kwargs)

    def __str__(self) -> str:
        return self.text


def parse_noise(text: str) -> Noise:
    """Read the paper's notation: only literals, nothing is evaluated.

    "my_noises:StickyAction(3)" is a wrapper of your own: the module is imported, and what it raises
    passes through. Unknown modules and names and bad arguments are a ValueError, which lists our
    wrappers below its first line if the noise is one of ours.

    >>> str(parse_noise("RandomUniformScaleReward(.50, high=1.5)"))
    'RandomUniformScaleReward(0.5, 1.5)'
    """
    module, name, _, _ = _read_call(text)
    wrapper = _import_wrapper(module, name, text) if module else WRAPPERS.get(name)
    return _read_noise(text, wrapper)  # of a module that was reloaded, the new class


@functools.cache  # the runs of a large sweep have few different noises
def _read_noise(text: str, wrapper: type[NoiseWrapper] | None) -> Noise:
    module, name, args, kwargs = _read_call(text)
    if wrapper is None:
        near = difflib.get_close_matches(name, WRAPPERS, n=1)
        advice = f" (did you mean {near[0]}?)" if near else ""
        raise _bad_noise(text, f"unknown name{advice}")
    try:
        given = inspect.signature(wrapper).bind(None, 1.0, *args, **kwargs).arguments
        recorded = wrapper(_ProbeEnv(), 1.0, *args, **kwargs).parameters
    except (TypeError, ValueError) as error:
        raise _bad_noise(text, str(error)) from error
    parameters = _parameters(wrapper)
    values = {p.name: {**given, **recorded}.get(p.name, p.default) for p in parameters}
    positional = [p for p in parameters if p.kind is not p.KEYWORD_ONLY]
    while positional and values[positional[-1].name] == positional[-1].default:
        positional.pop()  # but not a default before another value, which would take its place
    keywords = [p for p in parameters if p.kind is p.KEYWORD_ONLY and values[p.name] != p.default]
    written = [repr(values[p.name]) for p in positional]
    written += [f"{p.name}={values[p.name]!r}" for p in keywords]
    owner = "" if wrapper is WRAPPERS.get(name) else f"{module}:"
    noise = Noise(wrapper, f"{owner}{wrapper.__name__}({', '.join(written)})")
    if owner:
        with contextlib.suppress(TypeError, ValueError):
            if noise(_ProbeEnv(), 1.0).parameters == recorded:
                return noise
        wanted = "name its arguments (no *args or **kwargs) and pass them on as they came"
        raise _bad_noise(text, f"its constructor must {wanted}; {noise} would be another noise")
    return noise


def _read_call(text: str) -> tuple[str, str, list[Any], dict[str, Any]]:
    """Return the module, the name, the positional and the keyword arguments of literals."""
    try:
        module, colon, rest = text.strip().partition(":")
        if not colon or "(" in module:
            module, rest = "", text.strip()
        call = ast.parse(rest, mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            raise ValueError("not a call of a name")
        kwargs = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
        if None in kwargs or len(kwargs) < len(call.keywords):
            raise ValueError("an unpacked or repeated keyword")
        return module, call.func.id, [ast.literal_eval(arg) for arg in call.args], kwargs
    except (AttributeError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
        raise _bad_noise(text, "expected Name(number, ..., keyword=value)") from None


def _import_wrapper(module: str, name: str, text: str) -> type[NoiseWrapper]:
    """Return a wrapper of the user's own."""
    _import_module(module, f"bad noise {text!r}")
    wrapper = getattr(sys.modules[module], name, None)
    if not (isinstance(wrapper, type) and issubclass(wrapper, NoiseWrapper)):
        raise _bad_noise(text, f"{module} has no subclass {name} of noisy_wrappers.NoiseWrapper")
    kind, kinds = getattr(wrapper, "kind", None), ("observation", "reward", "action", "dynamics")
    if kind not in kinds:
        raise _bad_noise(text, f"{name}.kind must be one of {', '.join(kinds)}, not {kind!r}")
    return wrapper


def _bad_noise(text: str, reason: str) -> ValueError:
    if ":" in str(text).partition("(")[0]:  # the user's own, which is none of the list
        return ValueError(f"bad noise {text!r}: {reason}")
    return ValueError("\n  ".join([f"bad noise {text!r}: {reason}; valid are", *signatures()]))


@dataclass(frozen=True, order=True)
class Configuration:
    """The noises of a run or of a test, each with its rate; without any it is the baseline.

    It is made of what a user writes or config.json holds (:meth:`read`) or of two cells of a csv
    file (:meth:`parse`). They are ordered by noise, then by rate, the baseline first.
    """

    noises: tuple[str, ...] = ()  # in canonical notation, in the order in which they wrap
    rates: tuple[tuple[float, float], ...] = ()  # of each, at the start and the end of training

    @classmethod
    def read(cls, noises: Sequence[str], rates: Sequence[Rate], *, stored: bool = False) -> Self:
        """Check noises and rates and make them canonical; ValueError says what is wrong.

        One rate serves all noises. Noises of rate 0 are dropped (they are the baseline). Dynamics
        and action noise come first, where :func:`make_noisy` applies them. ``stored`` are those of
        a config.json: one of the user's own is taken as it stands, because its module need not be
        where its runs are analysed.
        """
        noises = _listed("noises", noises, '["RandomNormalNoisyReward(0.1)"]')
        rates = _listed("rates", rates, "[0.5]")
        if noises and len(rates) == 1:
            rates = rates * len(noises)
        if len(rates) != len(noises):
            counts = f"(noises: {len(noises)}, noise rates: {len(rates)})"
            raise ValueError(f"give one noise rate for all noises, or one for each {counts}")
        schedules = [_schedule(rate) for rate in rates]
        parsed = [n if stored and _read_call(n)[0] else parse_noise(n) for n in noises]
        both = zip(parsed, schedules, strict=True)
        pairs = [(noise, rate) for noise, rate in both if rate != (0.0, 0.0)]
        if not stored:
            pairs.sort(key=lambda pair: _place(pair[0].wrapper))
        return cls(tuple(str(noise) for noise, _ in pairs), tuple(rate for _, rate in pairs))

    @classmethod
    def parse(cls, noise: str, noise_rate: Rate) -> Self:
        """Read two cells of a csv file, :attr:`columns` or :attr:`noise` and :attr:`noise_rate`."""
        if not noise:
            return cls()
        noises, rates = split_noises(noise), parse_rates(noise_rate)
        if len(rates) != len(noises):
            raise ValueError(f"{noise!r} needs a rate for each noise, got {noise_rate!r}")
        return cls(tuple(noises), rates)

    def for_tests(self) -> Self:
        """Return it, or raise ValueError if no policy can be tested under it.

        A running scale would depend on the policy, and a rate that changes needs a training.
        """
        for noise, rate in zip(*self.texts, strict=True):
            if isinstance(rate, str):
                raise ValueError(f"policies are tested at constant rates, not at {rate}")
            module, name, _, arguments = _read_call(noise)
            if arguments.get("relative") and not module and name != "RandomNormalNoisyAction":
                reason = "relative=True would depend on the policy and on earlier tests"
                raise ValueError(f"{noise} is no noise for a test: {reason}")
        return self

    @property
    def texts(self) -> tuple[list[str], list[Rate]]:
        """The noises and the rates as config.json holds them and the scripts read them."""
        return list(self.noises), [_as_written(rate) for rate in self.rates]

    @property
    def columns(self) -> tuple[str, str]:
        """The cells of robustness.csv and choice.csv: "A(1.0) + B()", "0.05 + 1.0:0.0"."""
        return self.noise, " + ".join(map(str, self.texts[1] or [0.0]))

    @property
    def noise(self) -> str:
        """The noises as tables have them; the baseline's is empty."""
        return " + ".join(self.noises)

    @property
    def noise_rate(self) -> str:
        """The rates as tables and the paper have them: "0.05"; the baseline's is "0.00"."""

        def text(rate: float) -> str:
            return f"{rate:.2f}" if round(rate, 2) == rate else str(rate)

        ends = self.rates or [(0.0, 0.0)]
        return " + ".join(text(a) if a == b else f"{text(a)} to {text(b)}" for a, b in ends)

    @property
    def slug(self) -> str:
        """Part of a file's name: "p0.05_NormalNoisyReward_1.0", or "" for the baseline."""
        if not self.noises:
            return ""
        rates = "+".join(map(str, self.texts[1])).replace(":", "to")
        names = [_words(noise).removeprefix("Random") for noise in self.noises]
        return f"p{rates}_{'+'.join(names)}"

    def wrap(self, env: Env, *, record_statistics: bool = True) -> Env:
        """Stack the noises on an environment, as :func:`make_noisy` says."""
        flatten = gym.wrappers.FlattenObservation
        if isinstance(env, flatten) and not isinstance(env.env.observation_space, gym.spaces.Box):
            return flatten(self.wrap(env.env, record_statistics=record_statistics))
        pairs = [(parse_noise(noise), rate) for noise, rate in zip(*self.texts, strict=True)]
        for noise, rate in pairs:
            if noise.wrapper.kind in ("dynamics", "action"):
                env = noise(env, rate)
        recorder = gym.wrappers.RecordEpisodeStatistics
        inside = next(layer for layer in _layers(env) if not isinstance(layer, NoiseWrapper))
        if record_statistics and not isinstance(inside, recorder):
            if _records_episodes(env):
                advice = "let make_noisy do, or say record_statistics=False"
                raise ValueError(f"this environment records its returns: {advice}")
            env = recorder(env)
        for noise, rate in pairs:
            if noise.wrapper.kind in ("observation", "reward"):
                env = noise(env, rate)
        return env

    def __str__(self) -> str:
        """Return it as a sentence has it: "A(1.0) + B() at 0.05 + 1.0 to 0.0"."""
        noise, rate = self.columns
        return f"{noise} at {rate.replace(':', ' to ')}" if noise else "no noise"


BASELINE = Configuration()


def read_test_noise(noises: Sequence[str], rates: Sequence[Rate]) -> Configuration:
    """Read the noises of a run's tests, whose rate is 1 if none is given."""
    return Configuration.read(noises, [1.0] if len(noises) and not len(rates) else rates)


def parse_rates(noise_rate: Rate) -> tuple[tuple[float, float], ...]:
    """Read rates of a csv file or a table, "0.05 + 1.00 to 0.00", as (start, end) of each noise."""
    rates = [re.split(":| to ", rate) for rate in str(noise_rate).split(" + ")]
    return tuple((float(ends[0]), float(ends[-1])) for ends in rates)  # of one number, twice


def split_noises(text: str) -> list[str]:
    """Split "A(..) + B(..)", as one entry of an option combines noises; each may end in "@rate"."""
    outside_quotes = r"""(?=(?:[^'"]|'[^']*'|"[^"]*")*$)"""
    return re.split(rf"\s*\+\s*(?=[\w.:]+\(){outside_quotes}", text.strip())


def _listed(name: str, values: Any, example: str) -> list[Any]:
    """Return a sequence or an array of one dimension as a list."""
    if isinstance(values, str) or not np.iterable(values):
        raise ValueError(f"{name} must be a list, for example {example}, got {values!r}")
    return list(values)


def _place(wrapper: type[NoiseWrapper]) -> int:
    """Return where make_noisy puts a noise, counted from the environment."""
    if wrapper.kind == "dynamics":
        return 0 if wrapper is RandomDynamics else 1
    if wrapper.kind == "action":
        return 2 if wrapper is RandomActionDelay else 3
    return 4


def make_noisy(
    env: Env, noises: Sequence[str], rates: Sequence[Rate], *, record_statistics: bool = True
) -> Env:
    """Stack noises on an environment, around a record of the true returns.

    Dynamics noise is innermost (:class:`RandomDynamics` first), then action noise
    (:class:`RandomActionDelay` first), then Gymnasium's ``RecordEpisodeStatistics``, then the other
    noises in the order given: ``info["episode"]`` has the return before reward noise.
    ``record_statistics=False`` leaves the record out. All goes inside an outermost
    ``FlattenObservation`` of dictionaries or tuples. ValueError is a bad noise or rate, or a space
    that a noise cannot work on; TypeError not a single environment.
    """
    return Configuration.read(noises, rates).wrap(env, record_statistics=record_statistics)


# ---------------------------------------------------------------------------------- during training


def set_progress(env: Env, fraction: float) -> None:
    """Set the fraction of training done, for rates that change; call it before each ``reset()``.

    Rates change when the next episode begins, never within one. A vector of environments is told
    by its ``call("set_progress", fraction)``.
    """
    progress = _number("fraction", fraction, low=0, high=1)
    for wrapper in noise_wrappers(env).values():
        wrapper._progress = progress


def noise_wrappers(env: Env) -> dict[str, NoiseWrapper]:
    """Return an environment's noise wrappers by class name, innermost first.

    The second of a class is "ClassName_2", and so on. Not a single environment is a TypeError.
    """
    found: dict[str, NoiseWrapper] = {}
    for layer in reversed(_layers(env, NoiseWrapper)):
        name = type(layer).__name__
        before = sum(type(other).__name__ == name for other in found.values())
        found[f"{name}_{before + 1}" if before else name] = layer
    return found


def noise_statistics(env: Env) -> dict[str, float]:
    """Return the rate and the realised rate of an environment's noise wrappers, for a log.

    Where noises are combined, the wrapper's name stands in front.
    """
    statistics, wrappers = {}, noise_wrappers(env)
    for name, wrapper in wrappers.items():
        prefix = f"{name}/" if len(wrappers) > 1 else ""
        statistics[f"{prefix}rate"] = wrapper.noise_rate
        statistics[f"{prefix}applied_fraction"] = wrapper.applied_fraction
    return statistics


# ---------------------------------------------------------- an environment, made ready for networks


class NotFiniteError(FloatingPointError):
    """A value that training cannot continue with: NaN or infinite."""


class SpaceError(ValueError):
    """What an environment has or returns is not what training, or a noise, needs."""


class FiniteNumbers(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Stops at NaN and infinity, and makes what an environment returns what the API asks for.

    NotFiniteError is raised about NaN and infinity, SpaceError about another shape than that of the
    space. Rewards become floats and the two ends bools. Observations, actions and infos are copied,
    because an environment may write into them. The spaces are looked up once: an environment may
    make new ones at every access.
    """

    def __init__(self, env: Env):
        gym.Wrapper.__init__(self, env)
        RecordConstructorArgs.__init__(self)
        self.action_space, self.observation_space = env.action_space, env.observation_space
        entries = _entries(self.observation_space)
        self._boxes = {path: part for path, part in entries if isinstance(part, gym.spaces.Box)}
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment and check the first observation."""
        self._steps = 0
        base, kinds = self.unwrapped, np.random.Generator | None
        if seed is not None and isinstance(getattr(base, "_np_random", 0), kinds):
            base._np_random, _ = np_random(seed)  # some, as Meta-World's, ignore the seed
        observation, info = self.env.reset(seed=seed, options=options)
        return self._checked(observation), dict(info or {})

    def step(self, action: Any) -> Step:
        """Step the environment and check the observation and the reward."""
        self._steps += 1
        observation, reward, terminated, truncated, info = self.env.step(copy.copy(action))
        number = reward if type(reward) is float else float(_number_in(reward))
        if not math.isfinite(number):
            self._blame("returned the reward", reward, action)
        observation, info = self._checked(observation, action), dict(info or {})
        info.pop("episode", None)  # where an environment records itself, ours would be refused
        return observation, number, bool(terminated), bool(truncated), info

    def _checked(self, observation: Any, action: Any = None) -> Any:
        """Return a copy of an observation."""
        parts = {}
        for path, box in self._boxes.items():
            part = np.array(functools.reduce(operator.getitem, path, observation))
            if part.shape != box.shape:
                given = f"an observation of shape {part.shape}"
                raise SpaceError(f"the environment returned {given}, not {box.shape} as its space")
            total = np.add.reduce(part, axis=None, dtype=np.float64)  # quicker than isfinite()
            if not math.isfinite(total) and not np.isfinite(part).all():
                self._blame("returned the observation", part, action)
            parts[path] = part
        return _replaced(observation, parts) if parts else observation

    def _blame(self, what: str, value: Any, action: Any) -> None:
        """Stop at a value that is not finite, or rather at an action that was not, either."""
        if isinstance(action, np.ndarray) and not np.isfinite(action).all():
            what, value = "was given the action", action
        where = f"step {self._steps} of an episode: the environment"
        raise NotFiniteError(f"{where} {what} {np.asarray(value).tolist()!r}")


def make_flat(env: Env, step_limit: int = 10_000) -> Env:
    """Prepare an environment for networks: :class:`FiniteNumbers`, then observations are flattened.

    ``step_limit`` is the time limit of episodes, in steps, if neither the environment nor the user
    sets one; an environment without a spec gets none. :func:`make_noisy` puts noise beneath
    flattening. SpaceError if there are no vectors; then the environment has been closed.
    """
    name = env.spec.id if env.spec else str(env)
    if env.spec and env.spec.max_episode_steps is None:
        env = gym.wrappers.TimeLimit(env, step_limit)
    env = FiniteNumbers(env)
    space = env.observation_space
    is_vector = isinstance(space, gym.spaces.Box) and len(space.shape) == 1
    with contextlib.suppress(NotImplementedError):  # a space of the user's own does not say it
        if space.is_np_flattenable and not is_vector:
            env = gym.wrappers.FlattenObservation(env)
    observations, actions = env.observation_space, env.action_space
    if not _is_box(observations, "fiu"):
        problem = f"needs Box observations of numbers; {name} has {observations}"
    elif not _is_box(actions, "f") or len(actions.shape) != 1:
        problem = f"needs Box actions of floats in one dimension; {name} has {actions}"
    else:
        return env
    env.close()
    raise SpaceError(problem)


def make_environments(
    make_env: Callable[..., Env], args: Mapping[str, Any], test_seed: int
) -> tuple[Env, Env]:
    """Make a run's two environments by a script's ``make_env`` and arguments: training, test.

    What their constructors draw from the global generators depends on the run's seed, or on
    ``test_seed``.

    Raises:
        SpaceError: as :func:`make_flat`; the environment is no gymnasium.Env, does not take one of
            ``env_kwargs``, or keeps statistics to normalize by; or a noise cannot act in it.
    """
    kwargs = parse_env_kwargs(args["env_kwargs"])
    kwargs["max_episode_steps"] = args["max_episode_steps"]
    seed_globals(test_seed)
    try:
        test_env = make_env(args["env_id"], **kwargs)
    except TypeError as error:  # Gymnasium's words for what the user can mend on the command line
        known = ("unexpected keyword argument", "multiple values for", "takes no arguments")
        known += ("must inherit from the gym",)
        if not any(text in str(error) for text in known):
            raise
        raise SpaceError(str(error)) from error
    with contextlib.ExitStack() as stack:  # closes them if anything is raised
        stack.callback(test_env.close)
        normalizers = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)
        if any(layer.update_running_mean for layer in _layers(test_env, normalizers)):
            raise SpaceError(
                "NormalizeObservation and NormalizeReward have other statistics in tests, and none "
                "after a resume: PPO normalizes both itself; for observations of SAC see change 8 "
                "of docs/changing.md"
            )
        seed_globals(args["seed"])
        env = make_env(args["env_id"], **kwargs)
        stack.callback(env.close)
        try:
            noisy_env = make_noisy(env, args["noise"], args["noise_rate"])
            noisy_test_env = make_noisy(test_env, args["test_noise"], args["test_noise_rate"])
        except ValueError as error:
            raise SpaceError(str(error)) from error
        stack.pop_all()
    return noisy_env, noisy_test_env


def is_bounded(space: gym.spaces.Box) -> bool:
    """Return whether all bounds of a Box are finite; the largest float32 stands for infinity."""
    bounds = np.abs(np.concatenate([space.low, space.high], axis=None, dtype=np.float64))
    return bool((bounds < np.finfo(np.float32).max).all())


def into_space(action: Array, space: gym.spaces.Box) -> Array:
    """Return an action in its space's dtype and, to the last bit, within its bounds."""
    # in this order, because the cast may round a bound up
    return action.astype(space.dtype).clip(space.low, space.high)


def outcome(info: Mapping[str, Any]) -> float:
    """Return whether an episode solved its task, by the info of its last step: 1.0, 0.0 or NaN.

    ``is_success`` and ``success`` are the names that Gymnasium-Robotics, Meta-World and
    Stable-Baselines3 use; NaN where the environment says nothing.
    """
    for name in ("is_success", "success"):
        value = np.asarray(info.get(name))  # PyTorch's tensors have a size() of their own
        if value.size == 1 and value.dtype.kind in "biuf" and not np.isnan(value.item()):
            return float(value.item() > 0)
    return math.nan


def success_rate(outcomes: Iterable[float]) -> dict[str, float]:
    """Return the rate of success by its name; nothing if no :func:`outcome` is known."""
    values = np.asarray(list(outcomes))
    return {} if np.isnan(values).all() else {"success_rate": float((values > 0).mean())}


def canonical_env_id(env_id: str) -> str:
    """Return the id of the environment that ``gymnasium.make(env_id)`` makes, with its version.

    "module:Env-v0" imports the module, which registers the environment, and stays "module:Env-v0".
    ValueError if there is no such environment or module; what a module raises passes through.
    """
    module, colon, name = env_id.rpartition(":")
    if colon:
        _import_module(module, f"there is no environment {env_id!r}")
    try:
        namespace, base_name, version = registration.parse_env_id(name)
        if version is None:
            version = registration.find_highest_version(namespace, base_name)
        spec = gym.spec(registration.get_env_id(namespace, base_name, version))
    except gym.error.Error as error:
        raise ValueError(f"there is no environment {env_id!r}: {error}") from error
    return f"{module}{colon}{spec.id}"


def parse_env_kwargs(texts: Sequence[str]) -> dict[str, Any]:
    """Read arguments of an environment, "name:value", as a script's ``--env-kwargs`` has them.

    A value is a literal of Python, or else text. ValueError if a name is none, is given twice or is
    ``max_episode_steps``, an option of the scripts, or if a value is ``false``: no literal.
    """
    found: dict[str, Any] = {}
    for text in _listed("env_kwargs", texts, '["mass:2.0"]'):
        name, colon, value = str(text).partition(":")
        value = value.strip()
        if not colon or not name.isidentifier():
            raise ValueError(f"env_kwargs: {text!r} is not name:value, such as mass:2.0")
        if name in found:
            raise ValueError(f"env_kwargs: {name} is given twice")
        if name == "max_episode_steps":
            raise ValueError("env_kwargs: max_episode_steps is an option: --max-episode-steps")
        if value.capitalize() in ("True", "False", "None") and value != value.capitalize():
            raise ValueError(f"env_kwargs: {text!r}: write True, False or None, or quote a text")
        try:
            found[name] = ast.literal_eval(value)
        except (MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
            found[name] = value
    return found


def _import_module(module: str, problem: str) -> None:
    """Import a module of the user's, from the current folder first.

    ``problem`` is what an error says first, as "there is no environment 'a:b'".
    """
    if not module or module.startswith("."):
        raise ValueError(f"{problem}: {module!r} is not the name of a module")
    folder = os.getcwd()
    sys.path.insert(0, folder)
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:  # that one, or one that it imports
        raise ValueError(f"{problem}: {error}") from error
    finally:
        sys.path.remove(folder)


# ---------------------------------------------------------------------- the state of an environment


class EnvState:
    """What an environment carries from one episode to the next, to resume training.

    These are the random generators that the environment, its wrappers and their spaces have as
    attributes, with the number of children that they spawned; the streams, counters, rates and
    estimates of its noise wrappers; the returns that RecordEpisodeStatistics remembers; the global
    generators of ``random`` and NumPy; and further ``generators``. An environment that carries
    anything else, holds a generator elsewhere, or makes one after its first reset, does not resume
    exactly. Reset it with a seed before.
    """

    def __init__(self, env: Env, *generators: np.random.Generator):
        self.env, self.generators = env, generators
        recorded = env.has_wrapper_attr("return_queue")
        self.returns = env.get_wrapper_attr("return_queue") if recorded else deque()

    def state_dict(self) -> dict[str, Any]:
        """Return the state in Python's own types, to be taken between two episodes."""
        attributes = _generators(self.env)
        return {
            "python": _stream(random),
            "numpy": _stream(np.random),
            "generators": [_stream(generator) for generator in self.generators],
            "attributes": {place: _stream(generator) for place, generator in attributes.items()},
            "noise": [_without_arrays(w.state_dict()) for w in noise_wrappers(self.env).values()],
            "returns": [float(value) for value in self.returns],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`; the next call of the environment must be ``reset()``.

        A state of another number of generators or noise wrappers is a ValueError.
        """
        _set_stream(random, state["python"])
        _set_stream(np.random, state["numpy"])
        for generator, stream in zip(self.generators, state["generators"], strict=True):
            _set_stream(generator, stream)
        for place, generator in _generators(self.env).items():
            if place in state["attributes"]:  # others were made later than at the first reset
                _set_stream(generator, state["attributes"][place])
        wrappers = noise_wrappers(self.env).values()
        for wrapper, part in zip(wrappers, state["noise"], strict=True):
            wrapper.load_state_dict(part)
        self.returns.clear()
        self.returns.extend(state["returns"])


def seed_globals(seed: int) -> None:
    """Seed the generators that all share: Python's, NumPy's and, if it is loaded, PyTorch's."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    if torch := sys.modules.get("torch"):
        torch.manual_seed(seed)


@contextlib.contextmanager
def kept_generators(env: Env | None = None) -> Iterator[None]:
    """Restore after some lines the global generators, and those that ``env`` had before.

    A reset with a seed gives ``env`` new ones, which stay.
    """
    generators: list[Any] = [random, np.random]
    if env is not None:
        generators += _generators(env).values()
    streams = [_stream(generator) for generator in generators]
    torch = sys.modules.get("torch")
    gpus = range(torch.cuda.device_count()) if torch and torch.cuda.is_initialized() else ()
    with torch.random.fork_rng(gpus) if torch else contextlib.nullcontext():
        try:
            yield
        finally:
            for generator, stream in zip(generators, streams, strict=True):
                _set_stream(generator, stream)


def play(
    env: Env, policy: Callable[[NDArray[Any]], Any], episodes: int, seed: int
) -> NDArray[np.float64]:
    """Play test episodes, of which the first begins with ``reset(seed=seed)``, the next with + 1.

    ``env`` records its returns (:func:`make_noisy`); ``policy`` gives the action for an
    observation. If it has a method ``begin_episode()``, that is called after each reset: a policy
    with memory forgets there. Returns an array (episodes, 3): the true return of each, its length,
    and its :func:`outcome`. The global generators are seeded for each episode. They are restored
    afterwards, and so are the generators of ``env`` that ``reset(seed=seed)`` keeps, as those of
    its spaces; those that it makes anew go on from the last test, so do not train in ``env``.
    """
    results = np.zeros((episodes, 3))
    with kept_generators(env):
        for episode in range(episodes):
            seed_globals(seed + episode)
            observation, info = env.reset(seed=seed + episode)
            if hasattr(policy, "begin_episode"):
                policy.begin_episode()
            terminated = truncated = False
            while not (terminated or truncated):
                observation, _, terminated, truncated, info = env.step(policy(observation))
            record = info["episode"]  # the return is a number or an array
            results[episode] = np.asarray(record["r"]).item(), record["l"], outcome(info)
    return results


def _generators(env: Env) -> dict[str, Any]:
    """Return the generators among the attributes of an environment, its wrappers and their spaces.

    They are named by their places, such as "0._np_random". Nothing else is looked into.
    """
    holders: dict[str, Any] = {}
    for i, layer in enumerate(_layers(env)):
        holders[str(i)] = layer
        spaces = {s: getattr(layer, s, None) for s in ("action_space", "observation_space")}
        for name, value in {**spaces, **vars(layer)}.items():
            if issubclass(type(value), gym.Space):
                holders |= _parts_of_space(f"{i}.{name}", value)
    kinds = (np.random.Generator, np.random.RandomState, random.Random)
    found = {}
    for place, holder in holders.items():
        for name, value in vars(holder).items():
            # type(): isinstance() would ask a weak reference, perhaps a dead one, for its class
            if issubclass(type(value), kinds) and not issubclass(type(value), random.SystemRandom):
                found[f"{place}.{name}"] = value
    if type(env.unwrapped).np_random is not gym.Env.np_random:  # as shimmy's, which is dm_control's
        own = env.unwrapped.np_random
        found |= {"np_random": own} if issubclass(type(own), kinds) else {}
    return found


def _parts_of_space(place: str, space: gym.Space[Any]) -> dict[str, gym.Space[Any]]:
    """Return a space and the spaces in it, by their places: each draws from its own generator."""
    getattr(space, "np_random", None)  # which makes the generator if there is none yet
    found = {place: space}
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple | gym.spaces.OneOf):
        for key, part in _items(space.spaces):
            found |= _parts_of_space(f"{place}.{key}", part)
    return found


def _stream(generator: Any) -> Any:
    """Return the state of a generator, or of random or np.random, in Python's own types."""
    if generator is random or isinstance(generator, random.Random):
        return generator.getstate()
    if generator is np.random or isinstance(generator, np.random.RandomState):  # dm_control's
        return _without_arrays(generator.get_state(legacy=False))
    stream = {"state": generator.bit_generator.state}
    if isinstance(seeds := generator.bit_generator.seed_seq, np.random.SeedSequence):
        stream["seeds"] = seeds.state  # with the number of children that were spawned
    return _without_arrays(stream)


def _set_stream(generator: Any, stream: Any) -> None:
    if generator is random or isinstance(generator, random.Random):
        version, words, normal = stream
        generator.setstate((version, tuple(words), normal))
    elif generator is np.random or isinstance(generator, np.random.RandomState):
        generator.set_state(stream)
    else:
        generator.bit_generator.state = stream["state"]
        if "seeds" in stream:  # in place, because whoever spawns may hold it, too
            generator.bit_generator.seed_seq.__init__(**stream["seeds"])


# ------------------------------------------------------------- a run's identity: name and arguments


def run_name(args: Mapping[str, Any]) -> str:
    """Return the name of the folder of a run with these arguments of a script, as in config.json.

    It is the same for all spellings of one configuration. What tells the runs of a sweep apart
    comes first: TensorBoard's list shows 31 characters. The arguments of the environment, as
    :func:`parse_env_kwargs` reads them, follow its name, and the noise of its tests stands last.
    What is too long for a file system is cut and ends in a hash.

    >>> args = {"env_id": "Hopper-v5", "seed": 1, "exp_name": "sac"}
    >>> run_name(args | {"noise": ["RandomUniformScaleReward(.5, 1.5)"], "noise_rate": [0.05]})
    'p0.05_s1_UniformScaleReward_0.5_1.5__Hopper-v5__sac'
    """
    slug = Configuration.read(args["noise"], args["noise_rate"]).slug or "baseline"
    rate, _, noise = slug.partition("_")
    first = f"{rate}_s{args['seed']}_{noise}" if noise else f"{rate}_s{args['seed']}"
    end = f"__{safe_name(args['env_id'])}"
    for argument, value in sorted(parse_env_kwargs(args.get("env_kwargs", ())).items()):
        written, plain = str(value), safe_name(str(value))
        end += f"_{argument}={plain if plain == written else _hashed(written)}"
    end += f"__{safe_name(args['exp_name'])}"
    if test := read_test_noise(args.get("test_noise", ()), args.get("test_noise_rate", ())).slug:
        end += f"__tests_{test}"
    if len(first + end) > 240:  # a file's name has at most 255 bytes
        first = f"{first[:100]}_{_hashed(first, 16)}"
    if len(first + end) > 240:
        room = 240 - len(first) - len("_") - 16
        end = f"{end[:room]}_{_hashed(end, 16)}"
    return first + end


def _hashed(text: str, length: int = 8) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def _words(noise: str) -> str:
    """Return a noise as a part of a file's name."""
    plain = noise.replace("=(", "=").replace("', '", "-").replace("'", "")  # keys=a-b
    words = safe_name("_".join(re.findall(r"[^(), ]+", plain)))
    name, _, arguments = noise.partition("(")
    if ":" in name and re.search(r"""[(\[{'"]""", arguments):  # own, and not of numbers only
        words += f"_{_hashed(noise)}"
    return words


def safe_name(text: str) -> str:
    """Replace what a folder's name cannot hold: "/" by one dash, anything else by two."""
    return re.sub(r"[^A-Za-z0-9._=+-]", lambda match: "-" if match[0] == "/" else "--", text)


# The scripts' arguments that change nothing about what a run learns. A run may be resumed with
# others, and a finished one counts as done whatever it had.
MAY_DIFFER_IN_A_RUN = {"runs_dir", "overwrite", "torch_threads", "compile"}
MAY_DIFFER_IN_A_RUN |= {"checkpoint_frequency", "keep_policies"}


def different_arguments(
    config: Config, other: Config, may_differ: Collection[str] = MAY_DIFFER_IN_A_RUN
) -> dict[str, tuple[Any, Any]]:
    """Return the arguments in which two runs differ: {name: (value of config, value of other)}.

    Both are contents of a config.json, with "args", and with "defaults" since version 0.4. Values
    are compared as JSON, so a tuple equals its list. An argument that one of them lacks, because
    the script has it since then, had the default that the other one names.
    """
    ours = as_json({**other.get("defaults", other["args"]), **config["args"]})
    theirs = as_json({**config.get("defaults", config["args"]), **other["args"]})
    differing = {}
    for name in dict.fromkeys([*config["args"], *other["args"]]):
        values = ours.get(name), theirs.get(name)
        if name == "env_kwargs":  # their order does not matter
            values = sorted(values[0] or []), sorted(values[1] or [])
        if name not in may_differ and json.dumps(values[0]) != json.dumps(values[1]):
            differing[name] = values
    return differing


def release(config: Mapping[str, Any]) -> str:
    """Return the release that made a run, "0.4", by its config.json: their numbers differ."""
    version = config.get("versions", {}).get("noisy_wrappers", "0.3")
    return ".".join(str(version).split(".")[:2])


def as_json(value: Any) -> Any:
    """Return a value as JSON has it: a tuple is a list, a path its text."""
    return json.loads(json.dumps(value, default=str))


# Arguments of the scripts that are at least 0, at least 1, or fractions.
_NOT_NEGATIVE = {"seed", "eval_frequency", "learning_starts", "learning_rate", "policy_lr", "q_lr"}
_NOT_NEGATIVE |= {"exploration_noise", "policy_noise", "noise_clip", "clip_coef", "max_grad_norm"}
_COUNTS = {"total_timesteps", "max_episode_steps", "checkpoint_frequency", "eval_episodes"}
_COUNTS |= {"torch_threads", "buffer_size", "batch_size", "policy_frequency"}
_COUNTS |= {"target_network_frequency", "num_steps", "num_minibatches", "update_epochs"}
_FRACTIONS = {"gamma", "gae_lambda", "tau"}


def _check_numbers(args: Mapping[str, Any]) -> None:
    """Raise ValueError if one of these arguments of a script is out of its range, or NaN.

    A researcher's script may give an option another type, such as a schedule as text.
    """
    known = _NOT_NEGATIVE | _COUNTS | _FRACTIONS
    for name, value in args.items():
        if name not in known or not isinstance(value, int | float):
            continue
        low = 1 if name in _COUNTS else 0
        high = 1 if name in _FRACTIONS else math.inf
        if not low <= value <= high:
            wanted = f"at most {high}" if value > high else f"at least {low}"
            raise ValueError(f"--{name.replace('_', '-')} must be {wanted}, not {value}")


def canonical_arguments(args: Mapping[str, Any]) -> dict[str, Any]:
    """Check a script's arguments, {name: value}; return those that have one way to be written.

    They are ``env_id``, with its version, ``env_kwargs``, sorted, and the noises and rates of
    training and of tests; the rate of tests is 1 if none is given. The module of "module:Env-v0" is
    imported.

    Raises:
        ValueError: a number out of its range, a bad ``exp_name``, noise, rate or argument of the
            environment, or an environment that does not exist.
    """
    _check_numbers(args)
    if args["exp_name"] in ("", ".", ".."):
        raise ValueError(f"--exp-name must be a name, not {args['exp_name']!r}")
    parse_env_kwargs(args["env_kwargs"])
    noises, rates = Configuration.read(args["noise"], args["noise_rate"]).texts
    tests = read_test_noise(args["test_noise"], args["test_noise_rate"]).for_tests()
    canonical = {"env_id": canonical_env_id(args["env_id"]), "noise": noises, "noise_rate": rates}
    canonical["env_kwargs"] = sorted(args["env_kwargs"])
    return canonical | {"test_noise": tests.texts[0], "test_noise_rate": tests.texts[1]}


def describe_run(script: str, args: Config, defaults: Config, env: Env) -> dict[str, Any]:
    """Return the content of a config.json: what a script runs, in which spaces, by which code.

    ``script`` is the path of its file, NAME_continuous_noisy.py for an algorithm NAME; ``args`` and
    ``defaults`` are its arguments and their defaults.
    """
    path = Path(script)
    describe = 'git describe --always --dirty --abbrev=40 --exclude="*"'
    git = subprocess.run(describe, shell=True, cwd=path.parent, capture_output=True, text=True)
    versions = {"noisy_wrappers": __version__, "python": sys.version.split()[0]}
    package = type(env.unwrapped).__module__.partition(".")[0]
    for name in ("numpy", "gymnasium", "mujoco", package):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "algorithm": path.stem.removesuffix("_continuous_noisy").upper(),
        "script": path.name,
        "script_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "args": as_json(args),
        "defaults": as_json(defaults),
        "observation_space": _describe_space(env.observation_space),
        "observation_keys": _describe_keys(env),
        "action_space": _describe_space(env.action_space),
        "git_commit": git.stdout.strip() or None,
        "versions": versions,
    }


def resumed_run(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the config.json of a run that is resumed, where ``new`` would begin it.

    It is the old one; of versions and scripts that have changed it has both, "2.12.0, 2.13.0".

    Raises:
        ValueError: it is a run of another algorithm, of another release, or with other arguments.
    """
    differing = different_arguments(old, new)
    if old["algorithm"] != new["algorithm"]:
        problem = f"a run of {old['algorithm']}, not of {new['algorithm']}"
    elif release(old) != release(new):
        problem = f"a run of version {release(old)}, whose numbers differ: finish it with that one"
    elif differing:
        texts = [f"{name} {value}, not {other}" for name, (value, other) in differing.items()]
        problem = f"a run with {'; '.join(texts)}"
    else:
        names = ("script_sha256", "matmul_precision", "git_commit")
        resumed = {**old, **{name: _both(old.get(name), new.get(name)) for name in names}}
        old_versions = old.get("versions", {})
        versions = {name: _both(old_versions.get(name), v) for name, v in new["versions"].items()}
        return {**resumed, "versions": {**old_versions, **versions}}
    advice = "choose another --exp-name or --runs-dir; --overwrite deletes that run"
    raise ValueError(f"it holds {problem}: {advice}")


def _both(old: Any, new: Any) -> Any:
    """Return both of two texts, "2.12.0, 2.13.0", or the old one if it has the new one already."""
    used = str(old).split(", ")
    return old if str(new) in used else ", ".join([*used, str(new)])


def _describe_space(space: gym.spaces.Box) -> dict[str, Any]:
    """Return a Box for JSON: bounds that are all equal are one, and infinite ones are text."""
    bounds: dict[str, Any] = {}
    for name, bound in (("low", space.low), ("high", space.high)):
        numbers = [number if math.isfinite(number) else str(number) for number in bound.tolist()]
        bounds[name] = numbers[0] if len(set(numbers)) == 1 else numbers
    return {"shape": list(space.shape), **bounds, "dtype": str(space.dtype)}


def _describe_keys(env: Env) -> list[list[Any]]:
    """Return the [name, size] of each entry of a flattened dictionary; nothing for a vector."""
    return [
        [".".join(map(str, path)), gym.spaces.flatdim(part)]
        for layer in _layers(env, FiniteNumbers)  # which has the observations of before
        for path, part in _entries(layer.observation_space)
        if path
    ]


class Spaces:
    """The spaces that a run's config.json tells of; KeyError for a run of version 0.3."""

    def __init__(self, config: Mapping[str, Any]):
        self.observation_space = self._read(config["observation_space"])
        self.action_space = self._read(config["action_space"])

    @staticmethod
    def _read(saved: Mapping[str, Any]) -> gym.spaces.Box:
        shape, dtype = tuple(saved["shape"]), np.dtype(saved["dtype"])
        exact = float if dtype.kind == "f" else dtype  # the largest integers are no doubles
        low, high = np.array(saved["low"], exact), np.array(saved["high"], exact)
        low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
        return gym.spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype.type)


# ---------------------------------------------------------------- helpers: spaces and observations


def _layers(env: Env, kind: Any = gym.Env) -> list[Any]:
    """Return an environment's wrappers and itself, or those of a kind, outermost first."""
    if not isinstance(env, gym.Env):
        raise TypeError(f"needs a single gymnasium.Env, not a {type(env).__name__}")
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    return [layer for layer in layers if isinstance(layer, kind)]


def _records_episodes(env: Env) -> bool:
    """Tell whether a wrapper records episodes; what is inside of FiniteNumbers, it drops."""
    for layer in _layers(env):
        if isinstance(layer, FiniteNumbers):
            return False
        if hasattr(layer, "return_queue") or hasattr(layer, "get_episode_rewards"):
            return True  # RecordEpisodeStatistics, or Stable-Baselines3's Monitor
    return False


def _entries(space: gym.Space[Any], path: EntryPath = ()) -> Iterator[tuple[EntryPath, Any]]:
    """Yield the entries of nested Dict and Tuple spaces, in the order in which they are flattened.

    Each is (the keys that lead to it, its space); a space of another kind is one entry.
    """
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        for key, part in _items(space):
            yield from _entries(part, (*path, key))
    else:
        yield path, space


def _items(nested: Any) -> Iterable[tuple[Any, Any]]:
    """Return what a mapping or a sequence holds, as (key or index, value)."""
    return nested.items() if isinstance(nested, Mapping) else enumerate(nested)


def _replaced(nested: Any, entries: dict[EntryPath, Any]) -> Any:
    """Return a nested observation, or its space, with other entries in containers of its own."""
    if () in entries:
        return entries[()]
    parts = dict(_items(nested))
    for key in {path[0] for path in entries}:
        inner = {path[1:]: entry for path, entry in entries.items() if path[0] == key}
        parts[key] = _replaced(parts[key], inner)
    if isinstance(nested, gym.spaces.Dict):
        return gym.spaces.Dict(list(parts.items()))
    if isinstance(nested, gym.spaces.Tuple):
        return gym.spaces.Tuple(list(parts.values()))
    return parts if isinstance(nested, Mapping) else tuple(parts.values())


def _is_box(space: gym.Space[Any], kinds: str) -> bool:
    """Return whether a space is a Box of floats ("f"), or of floats and integers ("fiu")."""
    return isinstance(space, gym.spaces.Box) and space.dtype.kind in kinds


def _cast(values: Array, dtype: np.dtype[Any]) -> Array:
    """Cast float64 values; to an integer dtype they are rounded and clipped to its range."""
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        # The largest 64-bit integers are no doubles: float(2**63 - 1) would overflow the cast.
        largest = info.max if info.bits < 64 else np.nextafter(float(info.max), 0.0)
        values = np.clip(np.rint(values), info.min, largest)
    return np.asarray(values, dtype)


def _number_in(reward: Any) -> Any:
    """Return a reward as a number; it may be an array of one element, of NumPy, PyTorch or JAX."""
    is_array = hasattr(reward, "shape") and not isinstance(reward, np.generic)
    return reward.item() if is_array else reward


# ----------------------------------------------------------------------------- helpers: parameters


class _ProbeEnv(gym.Env[Any, Any]):
    """Stands for an environment that is not known yet, while a wrapper's arguments are read."""

    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (1,))


def _parameters(wrapper: type[NoiseWrapper]) -> list[inspect.Parameter]:
    """Return a wrapper's own parameters, those after self, env and noise_rate."""
    parameters = inspect.signature(wrapper.__init__).parameters.values()
    return [p for p in parameters if p.kind is not p.VAR_KEYWORD][3:]


def _number(name: str, value: float, low: float = -math.inf, high: float = math.inf) -> float:
    number = _without_arrays(value)
    is_real = isinstance(number, int | float) and not isinstance(number, bool)
    if not (is_real and abs(number) <= sys.float_info.max and low <= number <= high):
        raise ValueError(f"{name} must be a finite number in [{low}, {high}], got {value!r}")
    return float(number) + 0.0  # -0.0 becomes 0.0


def _interval(low: float, high: float, least: float = -math.inf) -> tuple[float, float]:
    low, high = _number("low", low, least), _number("high", high, least)
    if low > high:
        raise ValueError(f"low must not exceed high, got low={low}, high={high}")
    return low, high


def _whole_interval(low: int | None, high: int | None, least: int) -> tuple[int, int]:
    """Check two numbers of steps; the second is the first by default."""
    low, high = _interval(low, low if high is None else high, least)
    if low % 1 or high % 1:
        raise ValueError(f"low and high must be whole numbers, got low={low}, high={high}")
    return int(low), int(high)


def _scale_or_scales(value: Any) -> Scale:
    """Check one standard deviation for all dimensions, or a tuple (in JSON a list) of them."""
    scales = _without_arrays(value)
    if not isinstance(scales, tuple | list):
        return _number("scale", scales, low=0)
    return tuple(_number("every scale", number, low=0) for number in scales)


def _flag(name: str, value: bool) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return value


def _keys(keys: Any) -> Keys:
    """Return names or indices of observations; their order does not matter."""
    if keys is None:
        return None
    return (keys,) if isinstance(keys, str | int) else tuple(sorted(set(keys)))


def _fields(fields: Any) -> tuple[str, ...]:
    """Check names of arrays of MuJoCo's model."""
    found = (fields,) if isinstance(fields, str) else tuple(dict.fromkeys(fields))
    if not found or not set(found) <= set(_FIELDS):
        raise ValueError(f"fields must be some of {', '.join(_FIELDS)}, got {fields!r}")
    if {"body_mass", "body_inertia"} <= set(found):
        raise ValueError("fields: body_mass takes body_inertia along, so name body_mass alone")
    return found


def _schedule(noise_rate: Rate) -> tuple[float, float]:
    """Return the rates at the beginning and at the end of training."""
    start, colon, end = str(noise_rate).partition(":")
    try:
        start, end = float(start), float(end if colon else start)
        return _number("noise_rate", start, 0, 1), _number("noise_rate", end, 0, 1)
    except ValueError:
        wanted = 'a noise_rate must be a number in [0, 1], or "start:end", as "1.0:0.0"'
        raise ValueError(f"{wanted}, got {noise_rate!r}") from None


def _as_written(schedule: tuple[float, float]) -> Rate:
    """Return a schedule as it is written: one number, or "start:end" where they differ."""
    start, end = schedule
    return start if start == end else f"{start}:{end}"


def _without_arrays(value: Any) -> Any:
    """Turn an array, also in nested dicts, into lists or a number of Python's own types."""
    if isinstance(value, dict):
        return {name: _without_arrays(part) for name, part in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
