"""Nine Gymnasium wrappers that perturb observations, rewards and episode ends at random.

They implement section 3 of Khraishi and Okhrati, "Simple Noisy Environment Augmentation for
Reinforcement Learning". Every wrapper is ``Wrapper(env, noise_rate, <the paper's parameters>)``:
with probability p = ``noise_rate`` a step (or an episode) is perturbed, otherwise the data of the
environment pass through untouched. Wrappers combine by nesting, or with :func:`make_noisy`.

On a perturbed step ``info["noise"]`` is the tuple of the names of the wrappers that acted,
innermost first; on other steps the key is absent.

Randomness. A wrapper owns two generators, made at ``reset(seed=seed)`` by
``np.random.SeedSequence([seed, zlib.crc32(class_name.encode()), position]).spawn(2)``, in which
``position`` is the number of noise wrappers inside this one. The first, the gate, gives one
uniform per opportunity whatever the rate, so under one seed a higher rate perturbs the same steps
and more; the second gives the noise. ``reset()`` goes on with both streams; a wrapper never seeded
draws its seed from the operating system. The environment's own generator is never touched, so
initial states are the same with and without noise.
"""

import ast
import contextlib
import inspect
import math
import numbers
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs


class NoiseWrapper(gym.Wrapper, RecordConstructorArgs):
    """Base of the noise wrappers: the rate, the random streams and the counters.

    Attributes:
        noise_rate: p in [0, 1]; may be assigned at any time. 0 is the bare environment bit for
            bit, 1 perturbs every time.
        opportunities: how often the noise might have acted (episodes for early termination).
        times_applied: how often it did.
    """

    def __init__(self, env: gym.Env, noise_rate: float, **parameters: Any):
        """Raise ValueError unless noise_rate is in [0, 1]; parameters become attributes."""
        gym.Wrapper.__init__(self, env)
        self.noise_rate = noise_rate
        RecordConstructorArgs.__init__(self, noise_rate=self.noise_rate, **parameters)
        self.__dict__.update(parameters)
        self.opportunities = 0
        self.times_applied = 0
        self._position = sum(1 for _ in _noise_layers(env))
        self._seed(None)

    @property
    def noise_rate(self) -> float:
        """The probability p of perturbing a step (or an episode)."""
        return self._noise_rate

    @noise_rate.setter
    def noise_rate(self, value: float) -> None:
        self._noise_rate = _number("noise_rate", value, low=0, high=1)

    @property
    def applied_fraction(self) -> float:
        """The realised rate, times_applied / opportunities; nan before the first opportunity."""
        return self.times_applied / self.opportunities if self.opportunities else math.nan

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset the environment; a seed also reseeds the noise."""
        result = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._seed(seed)
        return result

    def state_dict(self) -> dict[str, Any]:
        """Return the random streams and the counters, to be taken between two episodes."""
        return {
            "gate": self._gate.bit_generator.state,
            "noise": self._noise.bit_generator.state,
            "opportunities": self.opportunities,
            "times_applied": self.times_applied,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`; the next call must be ``reset()``."""
        self._gate.bit_generator.state = state["gate"]
        self._noise.bit_generator.state = state["noise"]
        self.opportunities = state["opportunities"]
        self.times_applied = state["times_applied"]

    def _seed(self, seed: int | None) -> None:
        name = zlib.crc32(type(self).__name__.encode())
        entropy = None if seed is None else [seed, name, self._position]
        streams = np.random.SeedSequence(entropy).spawn(2)
        self._gate, self._noise = map(np.random.default_rng, streams)

    def _acts(self) -> bool:
        acts = self._gate.random() < self._noise_rate
        self.opportunities += 1
        self.times_applied += acts
        return acts

    def _mark(self, info: dict) -> dict:
        """Record that the noise acted, in a new dict: the environment may reuse its own."""
        others = info.get("noise")  # of noise wrappers below, or something of the environment's
        others = others if isinstance(others, tuple) else ()
        return {**info, "noise": (*others, type(self).__name__)}


class ObservationNoise(NoiseWrapper):
    """Base of the observation wrappers: subclasses define ``_perturb`` on float64 arrays.

    The observation has its space's dtype and shape; integers are computed in float64, rounded and
    clipped to their dtype. The space is widened to what noise can reach. The observation of
    ``reset()`` is perturbed like any other.
    """

    def __init__(self, env: gym.Env, noise_rate: float, **parameters: Any):
        """Raise ValueError unless the observation space is a Box of floats or integers."""
        super().__init__(env, noise_rate, **parameters)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box) or space.dtype.kind not in "fiu":
            raise ValueError(
                f"{type(self).__name__} needs a Box observation space of floats or integers, got "
                f"{type(space).__name__}: apply gymnasium.wrappers.FlattenObservation first"
            )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset the environment and perturb the first observation with probability p."""
        return self._observe(*super().reset(seed=seed, options=options))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        """Step the environment and perturb the observation with probability p."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        observation, info = self._observe(observation, info)
        return observation, reward, terminated, truncated, info

    def _observe(self, observation: np.ndarray, info: dict) -> tuple[np.ndarray, dict]:
        if self._acts():
            noisy = self._perturb(np.asarray(observation, np.float64))
            return _cast(noisy, self.observation_space.dtype), self._mark(info)
        return observation, info

    def _widen(self, reach: Callable[[np.ndarray], Sequence]) -> None:
        """Extend the observation space to what ``reach`` says noise makes of its two bounds."""
        space = self.env.observation_space
        with np.errstate(over="ignore", invalid="ignore"):
            bounds = space.low.astype(np.float64), space.high.astype(np.float64)
            ends = [np.broadcast_to(end, space.shape) for bound in bounds for end in reach(bound)]
            ends = np.nan_to_num(ends, nan=0.0, posinf=np.inf, neginf=-np.inf)  # 0 * inf is 0 here
            low = np.minimum(space.low, _cast(ends.min(axis=0), space.dtype))
            high = np.maximum(space.high, _cast(ends.max(axis=0), space.dtype))
        self.observation_space = gym.spaces.Box(
            np.asarray(low), np.asarray(high), dtype=space.dtype
        )


class RandomNormalNoisyObservation(ObservationNoise):
    """Adds Gaussian noise to the observation: o + e with e ~ N(loc, scale^2 I) (section 3.1).

    ``scale`` is the paper's sigma, in units of the observation, the same in every dimension;
    e = ``noise.normal(loc, scale, o.shape)``. noisyenv 0.1.1 takes loc before scale.

    >>> env = RandomNormalNoisyObservation(gym.make("CartPole-v1"), 1.0, 0.1)
    >>> observation, info = env.reset(seed=0)
    >>> observation
    array([ 0.00053917,  0.05760334,  0.07080678, -0.0334335 ], dtype=float32)
    >>> info
    {'noise': ('RandomNormalNoisyObservation',)}
    """

    def __init__(self, env: gym.Env, noise_rate: float, scale: float, *, loc: float = 0.0):
        """Raise ValueError unless scale >= 0 and both are finite."""
        parameters = {"scale": _number("scale", scale, low=0), "loc": _number("loc", loc)}
        super().__init__(env, noise_rate, **parameters)
        self._widen(lambda bound: (-np.inf, np.inf))

    def _perturb(self, observation: np.ndarray) -> np.ndarray:
        return observation + self._noise.normal(self.loc, self.scale, observation.shape)


class RandomUniformNoisyObservation(ObservationNoise):
    """Adds uniform noise to the observation: o + e with each e_i ~ U(low, high) (section 3.1).

    ``low`` and ``high`` are the paper's alpha and beta, in units of the observation;
    e = ``noise.uniform(low, high, o.shape)``.

    >>> env = RandomUniformNoisyObservation(gym.make("CartPole-v1"), 1.0, -0.1, 0.1)
    >>> env.reset(seed=0)[0]
    array([ 0.01826801, -0.01052575, -0.1353507 , -0.00589376], dtype=float32)
    """

    def __init__(self, env: gym.Env, noise_rate: float, low: float, high: float):
        """Raise ValueError unless low <= high and both are finite."""
        super().__init__(env, noise_rate, **_interval(low, high))
        self._widen(lambda bound: (bound + self.low, bound + self.high))

    def _perturb(self, observation: np.ndarray) -> np.ndarray:
        return observation + self._noise.uniform(self.low, self.high, observation.shape)


class RandomUniformScaleObservation(ObservationNoise):
    """Scales the observation: o * e with e ~ U(low, high) (section 3.1).

    e is one factor for the whole observation, ``noise.uniform(low, high)``, or with
    ``per_dimension`` one for each element, ``noise.uniform(low, high, o.shape)``. ``low`` and
    ``high`` are the paper's alpha and beta, without unit.

    >>> env = RandomUniformScaleObservation(gym.make("CartPole-v1"), 1.0, 0.5, 1.5)
    >>> env.reset(seed=0)[0]
    array([ 0.01069597, -0.01797841, -0.03584748, -0.03775657], dtype=float32)
    """

    def __init__(
        self,
        env: gym.Env,
        noise_rate: float,
        low: float,
        high: float,
        *,
        per_dimension: bool = False,
    ):
        """Raise ValueError unless low <= high, both are finite and per_dimension is a bool."""
        parameters = {"per_dimension": _flag("per_dimension", per_dimension)}
        super().__init__(env, noise_rate, **_interval(low, high), **parameters)
        self._widen(lambda bound: (bound * self.low, bound * self.high))

    def _perturb(self, observation: np.ndarray) -> np.ndarray:
        size = observation.shape if self.per_dimension else None
        return observation * self._noise.uniform(self.low, self.high, size)


class RandomMixupObservation(ObservationNoise):
    """Blends in the last observation: factor * o_t + (1 - factor) * o_(t-1) (section 3.1).

    ``factor`` is the paper's lambda. o_(t-1) is what this wrapper received at the last step, noise
    of inner wrappers included and its own excluded; ``recursive=True`` blends with what it
    returned instead. The first observation of an episode has no predecessor: it passes untouched
    and is no opportunity. No noise is drawn besides the gate's.

    noisyenv 0.1.1 remembers what it returned, as ``recursive=True`` does, so with p = 1 and
    factor = 0 the agent sees one observation for ever; and it blends the first observation of an
    episode with the last one of the episode before.

    >>> env = RandomMixupObservation(gym.make("CartPole-v1"), 1.0, 0.0)
    >>> env.reset(seed=0)[0]
    array([ 0.01369617, -0.02302133, -0.04590265, -0.04834723], dtype=float32)
    >>> env.step(0)[0]
    array([ 0.01369617, -0.02302133, -0.04590265, -0.04834723], dtype=float32)
    """

    def __init__(self, env: gym.Env, noise_rate: float, factor: float, *, recursive: bool = False):
        """Raise ValueError unless factor is in [0, 1] and recursive is a bool."""
        factor = _number("factor", factor, low=0, high=1)
        super().__init__(env, noise_rate, factor=factor, recursive=_flag("recursive", recursive))
        self._previous: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset the environment and forget the last episode."""
        self._previous = None
        return super().reset(seed=seed, options=options)

    def _observe(self, observation: np.ndarray, info: dict) -> tuple[np.ndarray, dict]:
        received = observation
        if self._previous is not None:
            observation, info = super()._observe(observation, info)
        # A copy: the environment may write its next observation into the same array.
        self._previous = np.array(observation if self.recursive else received, np.float64)
        return observation, info

    def _perturb(self, observation: np.ndarray) -> np.ndarray:
        mixture = self.factor * observation + (1 - self.factor) * self._previous
        low, high = np.minimum(observation, self._previous), np.maximum(observation, self._previous)
        return np.clip(mixture, low, high)  # rounding must not leave the observation space


class RandomDropoutObservation(ObservationNoise):
    """Sets elements of the observation to 0: r * o with r_i ~ Bernoulli(keep_prob) (section 3.1).

    ``keep_prob`` is the paper's eta, the probability that an element is *kept*;
    r = ``noise.random(o.shape) < keep_prob``. noisyenv 0.1.1 takes the probability of *dropping*,
    1 - keep_prob, and writes into the environment's array.

    >>> env = RandomDropoutObservation(gym.make("CartPole-v1"), 1.0, 0.5)
    >>> env.reset(seed=0)[0]
    array([0.01369617, 0.        , 0.        , 0.        ], dtype=float32)
    """

    def __init__(self, env: gym.Env, noise_rate: float, keep_prob: float):
        """Raise ValueError unless keep_prob is in [0, 1]."""
        super().__init__(env, noise_rate, keep_prob=_number("keep_prob", keep_prob, low=0, high=1))
        self._widen(lambda bound: (0.0,))

    def _perturb(self, observation: np.ndarray) -> np.ndarray:
        return np.where(self._noise.random(observation.shape) < self.keep_prob, observation, 0.0)


class RewardNoise(NoiseWrapper):
    """Base of the reward wrappers: subclasses define ``_perturb`` on the reward, a float."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        """Step the environment and perturb the reward with probability p."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._acts():
            reward, info = self._perturb(reward), self._mark(info)
        return observation, reward, terminated, truncated, info


class RandomNormalNoisyReward(RewardNoise):
    """Adds Gaussian noise to the reward: r + e with e ~ N(loc, scale^2) (section 3.2).

    ``scale`` is the paper's sigma, in units of the reward; e = ``noise.normal(loc, scale)``.
    noisyenv 0.1.1 takes loc before scale.

    >>> env = RandomNormalNoisyReward(gym.make("CartPole-v1"), 1.0, 0.1)
    >>> _ = env.reset(seed=0)
    >>> env.step(0)[1]
    1.1210431182607201
    """

    def __init__(self, env: gym.Env, noise_rate: float, scale: float, *, loc: float = 0.0):
        """Raise ValueError unless scale >= 0 and both are finite."""
        parameters = {"scale": _number("scale", scale, low=0), "loc": _number("loc", loc)}
        super().__init__(env, noise_rate, **parameters)

    def _perturb(self, reward: float) -> float:
        return reward + self._noise.normal(self.loc, self.scale)


class RandomUniformNoisyReward(RewardNoise):
    """Adds uniform noise to the reward: r + e with e ~ U(low, high) (section 3.2).

    ``low`` and ``high`` are the paper's alpha and beta, in units of the reward;
    e = ``noise.uniform(low, high)``.

    >>> env = RandomUniformNoisyReward(gym.make("CartPole-v1"), 1.0, -0.1, 0.1)
    >>> _ = env.reset(seed=0)
    >>> env.step(0)[1]
    0.9380732431402061
    """

    def __init__(self, env: gym.Env, noise_rate: float, low: float, high: float):
        """Raise ValueError unless low <= high and both are finite."""
        super().__init__(env, noise_rate, **_interval(low, high))

    def _perturb(self, reward: float) -> float:
        return reward + self._noise.uniform(self.low, self.high)


class RandomUniformScaleReward(RewardNoise):
    """Scales the reward: r * e with e ~ U(low, high) (section 3.2).

    ``low`` and ``high`` are the paper's alpha and beta, without unit;
    e = ``noise.uniform(low, high)``.

    >>> env = RandomUniformScaleReward(gym.make("CartPole-v1"), 1.0, 0.5, 1.5)
    >>> _ = env.reset(seed=0)
    >>> env.step(0)[1]
    0.778865122592071
    """

    def __init__(self, env: gym.Env, noise_rate: float, low: float, high: float):
        """Raise ValueError unless low <= high and both are finite."""
        super().__init__(env, noise_rate, **_interval(low, high))

    def _perturb(self, reward: float) -> float:
        return reward * self._noise.uniform(self.low, self.high)


class RandomEarlyTermination(NoiseWrapper):
    """Ends an episode early, at a step drawn from the integers low, ..., high (section 3.3).

    At ``reset()`` the episode is chosen with probability p, and its last step is drawn,
    k = ``noise.integers(low, high, endpoint=True)``; it is drawn for the others too, so that a
    higher rate leaves the chosen episodes as they are. A chosen episode that is still going at
    its k-th step ends there: ``terminated`` is set, or ``truncated`` if ``truncate=True``, and
    ``info["noise"]`` says who did it. ``high`` is ``low`` by default. ``each_step=True``, without
    low and high, is the paper's alternative: every step ends the episode with probability p.

    ``times_applied`` counts the chosen episodes, also those that end before their k-th step; with
    ``each_step`` the steps it ended. noisyenv 0.1.1 does not have this wrapper.

    >>> env = RandomEarlyTermination(gym.make("CartPole-v1"), 1.0, 2)
    >>> _ = env.reset(seed=0)
    >>> [env.step(0)[2:] for _ in range(2)]
    [(False, False, {}), (True, False, {'noise': ('RandomEarlyTermination',)})]
    """

    def __init__(
        self,
        env: gym.Env,
        noise_rate: float,
        low: int | None = None,
        high: int | None = None,
        *,
        each_step: bool = False,
        truncate: bool = False,
    ):
        """Raise ValueError unless 1 <= low <= high are integers, or absent with each_step."""
        if not _flag("each_step", each_step):
            low = _step_number("low", low)
            high = low if high is None else _step_number("high", high)
            if low > high:
                raise ValueError(f"low must not exceed high, got low={low}, high={high}")
        elif low is not None or high is not None:
            raise ValueError(f"each_step=True excludes low and high, got low={low}, high={high}")
        parameters = {"each_step": each_step, "truncate": _flag("truncate", truncate)}
        # (50, 50) is recorded as (50), so that both spellings are one configuration.
        super().__init__(env, noise_rate, low=low, high=None if high == low else high, **parameters)
        self.high = high
        self._steps = 0
        self._last_step: int | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset the environment and decide when the episode ends."""
        result = super().reset(seed=seed, options=options)
        self._steps = 0
        if not self.each_step:
            last_step = self._noise.integers(self.low, self.high, endpoint=True)
            self._last_step = last_step if self._acts() else None
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        """Step the environment and end the episode if its time has come."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._steps += 1
        if self._acts() if self.each_step else self._steps == self._last_step:
            info = self._mark(info)
            if self.truncate:
                truncated = True
            else:
                terminated = True
        return observation, reward, terminated, truncated, info


WRAPPERS: dict[str, type[NoiseWrapper]] = {
    wrapper.__name__: wrapper
    for wrapper in (
        RandomNormalNoisyObservation,
        RandomUniformNoisyObservation,
        RandomUniformScaleObservation,
        RandomMixupObservation,
        RandomDropoutObservation,
        RandomNormalNoisyReward,
        RandomUniformNoisyReward,
        RandomUniformScaleReward,
        RandomEarlyTermination,
    )
}


@dataclass(frozen=True)
class Noise:
    """A wrapper and its parameters, without environment and rate.

    Equal configurations are equal objects; ``str()`` is the paper's notation.
    """

    wrapper: type[NoiseWrapper]
    args: tuple[float, ...] = ()
    kwargs: tuple[tuple[str, float], ...] = ()

    def __call__(self, env: gym.Env, noise_rate: float) -> NoiseWrapper:
        """Wrap an environment."""
        return self.wrapper(env, noise_rate, *self.args, **dict(self.kwargs))

    def __str__(self) -> str:
        """Return the canonical notation, e.g. "RandomMixupObservation(0.0, recursive=True)"."""
        arguments = [repr(value) for value in self.args]
        arguments += [f"{name}={value!r}" for name, value in self.kwargs]
        return f"{self.wrapper.__name__}({', '.join(arguments)})"


def parse_noise(text: str) -> Noise:
    """Read the paper's notation, e.g. "RandomUniformScaleReward(0.5, 1.5)".

    Literals only, nothing is evaluated. The wrapper's constructor checks the arguments.

    >>> str(parse_noise("RandomUniformScaleReward(.50, high=1.5)"))
    'RandomUniformScaleReward(0.5, 1.5)'

    Raises:
        ValueError: unknown name or bad arguments; the message lists the wrappers.
    """
    try:
        call = ast.parse(text.strip(), mode="eval").body
        name = call.func.id
        args = [ast.literal_eval(arg) for arg in call.args]
        kwargs = {keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords}
    except (AttributeError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
        raise _bad_noise(text, "expected Name(number, ..., keyword=value)") from None
    if name not in WRAPPERS:
        raise _bad_noise(text, "unknown name")
    if len(kwargs) < len(call.keywords):
        raise _bad_noise(text, "a keyword is repeated")
    wrapper = WRAPPERS[name]
    try:
        recorded = wrapper(_ProbeEnv(), 1.0, *args, **kwargs)._saved_kwargs
    except (TypeError, ValueError) as error:
        raise _bad_noise(text, str(error)) from None
    used = [p for p in _parameters(wrapper) if recorded[p.name] != p.default]
    return Noise(
        wrapper,
        tuple(recorded[p.name] for p in used if p.kind is not p.KEYWORD_ONLY),
        tuple((p.name, recorded[p.name]) for p in used if p.kind is p.KEYWORD_ONLY),
    )


def _bad_noise(text: str, reason: str) -> ValueError:
    """Return a one-line error that lists the wrappers with their signatures."""
    signatures = []
    for wrapper in WRAPPERS.values():
        plain = [p.replace(annotation=p.empty) for p in _parameters(wrapper)]
        signatures.append(f"{wrapper.__name__}{inspect.Signature(plain)}")
    return ValueError(f"bad noise {text!r}: {reason}; valid are {', '.join(signatures)}")


def _pair(noises: Sequence[str], rates: Sequence[float]) -> list[tuple[Noise, float]]:
    """Parse noises with their rates: without those of rate 0, dynamics noise first."""
    if len(rates) != len(noises) and not (len(rates) == 1 and noises):
        raise ValueError(
            f"give one noise rate for all noises or one for each, got {len(noises)} noises and "
            f"{len(rates)} noise rates"
        )
    rates = [_number("noise_rate", rate, low=0, high=1) for rate in rates]
    rates = rates * len(noises) if len(rates) == 1 else rates
    pairs = [(parse_noise(noise), rate) for noise, rate in zip(noises, rates, strict=True)]
    pairs = [(noise, rate) for noise, rate in pairs if rate > 0]
    return sorted(pairs, key=lambda pair: pair[0].wrapper is not RandomEarlyTermination)


def canonical_noises(
    noises: Sequence[str], rates: Sequence[float]
) -> tuple[list[str], list[float]]:
    """Return noises in canonical notation and one rate for each.

    Noises of rate 0 are dropped (they are the baseline) and early termination comes first, where
    :func:`make_noisy` applies it. One rate serves all noises.

    >>> canonical_noises(["RandomNormalNoisyReward(1)", "RandomEarlyTermination(50, 50)"], [0.1])
    (['RandomEarlyTermination(50)', 'RandomNormalNoisyReward(1.0)'], [0.1, 0.1])

    Raises:
        ValueError: a bad noise, a rate outside [0, 1], or numbers of rates and noises that differ.
    """
    pairs = _pair(noises, rates)
    return [str(noise) for noise, _ in pairs], [rate for _, rate in pairs]


def make_noisy(env: gym.Env, noises: Sequence[str], rates: Sequence[float]) -> gym.Env:
    """Stack noises on an environment, around a record of the true returns.

    Early termination is innermost, then ``gymnasium.wrappers.RecordEpisodeStatistics``, then the
    other noises in the order given, so ``info["episode"]`` has the return before reward noise.

    >>> make_noisy(gym.make("CartPole-v1").unwrapped, ["RandomNormalNoisyReward(1)"], [0.1])
    <RandomNormalNoisyReward<RecordEpisodeStatistics<CartPoleEnv<CartPole-v1>>>>

    Raises:
        ValueError: as :func:`canonical_noises`, an observation space that is not a Box, or an
            environment that has a RecordEpisodeStatistics already.
    """
    if env.has_wrapper_attr("return_queue"):
        raise ValueError("make_noisy adds RecordEpisodeStatistics itself: take it off this env")
    pairs = _pair(noises, rates)
    dynamics = [pair for pair in pairs if pair[0].wrapper is RandomEarlyTermination]
    for noise, rate in dynamics:
        env = noise(env, rate)
    env = gym.wrappers.RecordEpisodeStatistics(env)
    for noise, rate in pairs[len(dynamics) :]:
        env = noise(env, rate)
    return env


def noise_wrappers(env: gym.Env) -> dict[str, NoiseWrapper]:
    """Return an environment's noise wrappers by class name, innermost first.

    The second of a class is "ClassName_2", and so on.
    """
    found: dict[str, NoiseWrapper] = {}
    for layer in reversed(list(_noise_layers(env))):
        name = type(layer).__name__
        before = sum(type(other) is type(layer) for other in found.values())
        found[f"{name}_{before + 1}" if before else name] = layer
    return found


def run_name(
    env_id: str, exp_name: str, noises: Sequence[str], rates: Sequence[float], seed: int
) -> str:
    """Return the name of a run's folder, the same for all spellings of one configuration.

    >>> run_name("Hopper-v5", "sac", ["RandomUniformScaleReward(.5, 1.5)"], [0.05], seed=1)
    'Hopper-v5__sac__RandomUniformScaleReward_0.5_1.5_p0.05__1'
    >>> run_name("ALE/Pong-v5", "ppo", [], [], seed=1)
    'ALE-Pong-v5__ppo__baseline__1'
    """
    words = [
        [*re.split(r"[(), ]+", str(noise))[:-1], f"p{rate}"] for noise, rate in _pair(noises, rates)
    ]
    slug = "+".join("_".join(word) for word in words) or "baseline"
    return f"{_safe(env_id)}__{_safe(exp_name)}__{slug}__{seed}"


def _safe(text: str) -> str:
    """Replace what a folder's name cannot hold: "/" by one dash, anything else by two."""
    return re.sub(r"[^A-Za-z0-9._=+-]", lambda match: "-" if match[0] == "/" else "--", text)


def _noise_layers(env: gym.Env) -> Iterator[NoiseWrapper]:
    """Yield an environment's noise wrappers, outermost first."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, NoiseWrapper):
            yield env
        env = env.env


class _ProbeEnv(gym.Env):
    """Just enough of an environment to construct a wrapper on."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))


def _parameters(wrapper: type[NoiseWrapper]) -> list[inspect.Parameter]:
    """Return a wrapper's own parameters, those after self, env and noise_rate."""
    return list(inspect.signature(wrapper.__init__).parameters.values())[3:]


def _cast(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Cast float64 values; to an integer dtype they are rounded and clipped to its range."""
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        # The largest 64-bit integers are no doubles: float(2**63 - 1) would overflow the cast.
        largest = info.max if info.bits < 64 else np.nextafter(float(info.max), 0.0)
        values = np.clip(np.rint(values), info.min, largest)
    return np.asarray(values, dtype)


def _number(name: str, value: float, low: float = -math.inf, high: float = math.inf) -> float:
    number = math.nan
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # an integer beyond the range of floats
            number = float(value)
    if not (math.isfinite(number) and low <= number <= high):
        raise ValueError(f"{name} must be a finite number in [{low}, {high}], got {value!r}")
    return number + 0.0  # -0.0 becomes 0.0


def _interval(low: float, high: float) -> dict[str, float]:
    low, high = _number("low", low), _number("high", high)
    if low > high:
        raise ValueError(f"low must not exceed high, got low={low}, high={high}")
    return {"low": low, "high": high}


def _step_number(name: str, value: int) -> int:
    integer = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not (integer and 1 <= value < 2**63):  # Generator.integers draws 64-bit integers
        raise ValueError(f"{name} must be an integer in [1, 2**63), got {value!r}")
    return int(value)


def _flag(name: str, value: bool) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return value
