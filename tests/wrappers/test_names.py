"""Names of runs and of environments."""

import re

import pytest
from cases import NOISES, A, B, C, named

from noisy_wrappers import canonical_env_id, parse_env_kwargs


def test_run_names():
    assert named() == named([A], [0]) == "baseline_s1__E__x"
    name = named(env_id="ALE/Pong-v5", exp_name="my exp", seed=2)
    assert name == "baseline_s2__ALE-Pong-v5__my--exp"
    assert named(env_id="module:Env-v0") != named(env_id="module/Env-v0")
    noises = [A, C, "RandomMixupObservation(0, recursive=True)"]
    assert named(noises, ["1:0", 0.5, 1], seed=3) == (
        "p0.5+1.0to0.0+1.0_s3_EarlyTermination_9+NormalNoisyReward_1.0"
        "+MixupObservation_0.0_recursive=True__E__x"
    )


def test_other_configurations_have_other_names():
    keys = [f"RandomDropoutObservation(0.5, keys={keys})" for keys in ("('a', 'b')", "'a'", "0")]
    relative = "RandomNormalNoisyReward(0.3, relative=True)"
    scales = [f"RandomNormalNoisyObservation({scale})" for scale in ("(0.1, 0.2)", "(0.1, 0.3)")]
    noises = [*NOISES, *keys, relative, *scales]
    rates = [1.0, 0.5, "1:0.5", "0.5:1"]
    names = {named([noise], [rate]) for noise in noises for rate in rates}
    names |= {named(pair, [0.5]) for pair in ([A, B], [B, A], [A, A])}
    assert len(names) == len(noises) * len(rates) + 3
    assert all(re.fullmatch(r"[A-Za-z0-9._=+-]+", name) for name in names)


def test_long_run_names_fit_into_a_file_system():
    def name(last, exp_name="sac"):
        scale = tuple(i / 1000 for i in range(1, 60)) + (last,)
        return named([f"RandomNormalNoisyObservation({scale})"], [1], exp_name=exp_name)

    assert name(0.5) == name(0.50) != name(0.6)
    assert name(0.5).startswith("p1.0_s1_NormalNoisyObservation_0.001_0.002_")
    assert name(0.5).endswith("__E__sac")
    long = {name(0.5), name(0.5, "x" * 200), name(0.6, "x" * 200), name(0.5, "x" * 201)}
    assert len(long) == 4 and max(map(len, long)) <= 240


def test_the_environments_arguments_and_the_tests_are_part_of_the_name():
    heavy = {"test_noise": ["RandomDynamics(1.30, high=1.3)"], "test_noise_rate": ["1:1"]}
    plain = named([A], [0.5])
    assert plain == named([A], [0.5], env_kwargs=(), test_noise=[])
    kwargs = ["reward_type:dense", "mass:2.00"]
    name = named([A], [0.5], env_kwargs=kwargs, **heavy)
    first, _, exp_name = plain.rpartition("__")
    tests = "tests_p1.0_Dynamics_1.3_1.3"
    assert name == f"{first}_mass=2.0_reward_type=dense__{exp_name}__{tests}"
    values = ["2", "2.0", "two", "(2, 3)", "a b", "a/b", "None"]
    names = {named(env_kwargs=[f"a:{value}"]) for value in values}
    assert len(names) == len(values) and not any(re.search(r"[/ ]", name) for name in names)


def test_env_kwargs():
    texts = ["mass:2.0", "reward_type: dense", "n:-3", "range:(0, 1)", "at:10:30", "on:'false'"]
    values = {"mass": 2.0, "reward_type": "dense", "n": -3, "range": (0, 1), "at": "10:30"}
    values["on"] = "false"
    assert parse_env_kwargs(texts) == values
    assert parse_env_kwargs(["x:__import__('os')"]) == {"x": "__import__('os')"}
    of_scripts = ["max_episode_steps:5"]
    for bad in (["mass"], ["a-b:1"], ["a:1", "a:2"], "mass:2", ["a:false"], of_scripts):
        with pytest.raises(ValueError, match="^env_kwargs"):
            parse_env_kwargs(bad)


def test_unknown_environments():
    module = "No module named 'no_such_module'"
    reasons = {"Hoper-v5": "Did you mean: `Hopper`", "no_such_module:Env-v0": module}
    reasons |= dict.fromkeys(("./toy_envs:Nothing-v0", ":Pendulum-v1"), "is not the name of a mod")
    for env_id, reason in (reasons | {"": "Malformed", "toy_envs:Nothing-v0": "Nothing"}).items():
        with pytest.raises(ValueError) as error:
            canonical_env_id(env_id)
        message = str(error.value)
        assert repr(env_id) in message and reason in message and "\n" not in message
