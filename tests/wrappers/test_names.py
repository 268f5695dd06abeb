"""Names of runs and of environments."""

import re
import sys

import pytest
from cases import A, B, C, hypothesis_settings
from hypothesis import given, settings
from hypothesis import strategies as st

from noisy_wrappers import (
    WRAPPERS,
    Configuration,
    canonical_env_id,
    parse_env_kwargs,
    run_name,
)
from sweep.grid import NOISES as NOISES_OF_THE_PAPER


def test_run_names():
    assert run_name("Hopper-v5", "sac", [], [], 1) == "baseline_s1__Hopper-v5__sac"
    assert run_name("Hopper-v5", "sac", [A], [0], 1) == "baseline_s1__Hopper-v5__sac"
    assert run_name("ALE/Pong-v5", "my exp", [], [], 2) == "baseline_s2__ALE-Pong-v5__my--exp"
    assert run_name("module:Env-v0", "x", [], [], 2) != run_name("module/Env-v0", "x", [], [], 2)
    noises = ["RandomMixupObservation(0, recursive=True)", "RandomUniformNoisyReward(-.5, 1)", C]
    assert run_name("E", "x", noises, [1, 0.05, 0.2], 3) == (
        "p0.2+1.0+0.05_s3_EarlyTermination_9+MixupObservation_0.0_recursive=True"
        "+UniformNoisyReward_-0.5_1.0__E__x"
    )

    name = run_name("E", "x", [A, C, B], ["1:0", 0.5, "0:.25"], 3)
    assert name == (
        "p0.5+1.0to0.0+0.0to0.25_s3_EarlyTermination_9+NormalNoisyReward_1.0"
        "+DropoutObservation_0.5__E__x"
    )


@pytest.mark.parametrize("noise", NOISES_OF_THE_PAPER)
def test_31_characters_of_a_name_tell_rate_seed_and_kind(noise):
    """TensorBoard's list shows no more. Kinds are told apart even where a name is cut."""
    kinds = {noise.partition("(")[0].removeprefix("Random") for noise in NOISES_OF_THE_PAPER}
    shown = run_name("HalfCheetah-v5", "ppo_continuous_noisy", [noise], [0.01], 10)[:31]
    rate, shown_seed, text = shown.split("_", 2)
    assert (rate, shown_seed) == ("p0.01", "s10")
    [kind] = [kind for kind in kinds if text.startswith(kind) or kind.startswith(text)]
    assert noise.startswith(f"Random{kind}(")


def test_long_run_names_fit_into_a_file_system():
    def name(last, exp_name="sac"):
        scale = tuple(i / 1000 for i in range(1, 60)) + (last,)
        return run_name("Humanoid-v5", exp_name, [f"RandomNormalNoisyObservation({scale})"], [1], 3)

    assert name(0.5) == name(0.50) != name(0.6)
    assert name(0.5).startswith("p1.0_s3_NormalNoisyObservation_0.001_0.002_")
    assert name(0.5).endswith("__Humanoid-v5__sac")
    assert re.fullmatch(r"[A-Za-z0-9._=+-]+", name(0.5))
    long = {name(0.5), name(0.5, "x" * 200), name(0.6, "x" * 200), name(0.5, "x" * 201)}
    assert len(long) == 4 and max(map(len, long)) <= 240


HEAVY = {"test_noise": ["RandomDynamics(1.3, 1.3)"], "test_noise_rate": [1.0]}


def test_the_environments_arguments_and_the_tests_are_part_of_the_name():
    plain = run_name("E", "x", [A], [0.5], 1)
    assert plain == run_name("E", "x", [A], [0.5], 1, env_kwargs=(), test_noise=[])
    name = run_name("E", "x", [A], [0.5], 1, env_kwargs=["reward_type:dense", "mass:2.0"], **HEAVY)
    first, _, exp_name = plain.rpartition("__")
    tests = "tests_p1.0_Dynamics_1.3_1.3"
    assert name == f"{first}_mass=2.0_reward_type=dense__{exp_name}__{tests}"
    spelled = {"test_noise": ["RandomDynamics(1.30, high=1.3)"], "test_noise_rate": ["1:1"]}
    kwargs = ["mass:2.00", "reward_type:dense"]
    assert run_name("E", "x", [A], [0.5], 1, env_kwargs=kwargs, **spelled) == name
    values = ["2", "'2'", "2.0", "two", "(2, 3)", "[2, 3]", "a b", "a/b", "None", "'None'", "x:2"]
    names = {run_name("E", "x", [], [], 1, env_kwargs=[f"a:{value}"]) for value in values}
    assert len(names) == len(values)
    assert all(re.fullmatch(r"[A-Za-z0-9._=+-]+", name) for name in names)


def test_env_kwargs():
    texts = ["mass:2.0", "reward_type:dense", "n:-3", "on:True", "range:(0, 1)", "at:10:30", "no:"]
    assert parse_env_kwargs(texts) == {
        "mass": 2.0,
        "reward_type": "dense",
        "n": -3,
        "on": True,
        "range": (0, 1),
        "at": "10:30",
        "no": "",
    }
    assert parse_env_kwargs(["x:__import__('os')"]) == {"x": "__import__('os')"}
    for bad in (["mass"], ["2x:1"], ["a-b:1"], [":1"], ["a:1", "a:2"], "mass:2", [3]):
        with pytest.raises(ValueError, match="^env_kwargs"):
            parse_env_kwargs(bad)


@st.composite
def configurations(draw):
    """Noises and rates from few values, so that equal ones come up."""
    few = st.sampled_from([0.0, -0.0, 0.05, 0.5, 1.0, 1e-7, 12.0, 1e16])
    noises = []
    for _ in range(draw(st.integers(0, 2))):
        name = draw(st.sampled_from(list(WRAPPERS)))
        if name == "RandomEarlyTermination":
            steps = sorted(draw(st.lists(st.sampled_from([1, 2, 12]), min_size=1, max_size=2)))
            arguments = [str(k) for k in steps] if draw(st.booleans()) else ["each_step=True"]
            arguments += draw(st.sampled_from([[], ["truncate=True"], ["truncate=False"]]))
        elif "Delay" in name:
            arguments = [str(draw(st.integers(0, 12)))]
        elif "Uniform" in name or name == "RandomDynamics":
            arguments = [str(x) for x in sorted(draw(st.tuples(few, few)))]
        else:
            most = 1 if "Mixup" in name or "Dropout" in name else 1e16
            arguments = [str(min(draw(few), most))]
            if name == "RandomNormalNoisyObservation" and draw(st.booleans()):
                arguments = [str(tuple(draw(st.lists(few, min_size=2, max_size=3))))]
            if "Normal" in name and draw(st.booleans()):
                arguments.append(f"loc={draw(few)}")
        if ("Noisy" in name or "Bias" in name) and draw(st.booleans()):
            arguments.append(f"relative={draw(st.booleans())}")
        if "Observation" in name and draw(st.booleans()):
            keys = ["a", "b", "a-b", "a b", "a/b", "a', 'b", "ab", "0"]
            keys = draw(st.lists(st.sampled_from(keys), min_size=1, max_size=2))
            arguments.append(f"keys={tuple(keys)}" if draw(st.booleans()) else "keys=0")
        noises.append(f"{name}({', '.join(arguments)})")
    rates = [draw(st.sampled_from([0.0, 0.05, 0.5, 1.0, "0:0", "1:0", "0:.5"])) for _ in noises]
    return noises, rates


@pytest.mark.slow
@settings(hypothesis_settings, max_examples=400)
@given(configurations(), configurations())
def test_names_are_equal_exactly_if_the_configurations_are(one, two):
    names = [run_name("Hopper-v5", "sac", *configuration, 1) for configuration in (one, two)]
    assert (names[0] == names[1]) == (Configuration.read(*one) == Configuration.read(*two))
    assert all(re.fullmatch(r"[A-Za-z0-9._=+-]+", name) for name in names)
    assert run_name("Hopper-v5", "sac", *Configuration.read(*one).texts, 1) == names[0]


def test_canonical_env_id():
    toy = "toy_envs:Tiny-v0"
    for env_id, canonical in [
        ("Hopper", "Hopper-v5"),
        ("Hopper-v4", "Hopper-v4"),
        ("phys2d/CartPole", "phys2d/CartPole-v1"),
        (toy, toy),
        ("toy_envs:Tiny", toy),
    ]:
        assert canonical_env_id(env_id) == canonical
        assert canonical_env_id(canonical) == canonical


@pytest.mark.parametrize(
    ("env_id", "reason"),
    [
        ("Hoper-v5", "Did you mean: `Hopper`"),
        ("Hopper-v77", "v77"),
        ("", "Malformed"),
        ("no_such_module:Env-v0", "No module named 'no_such_module'"),
        ("toy_envs:Nothing-v0", "Nothing"),
    ],
)
def test_unknown_environments(env_id, reason):
    with pytest.raises(ValueError) as error:
        canonical_env_id(env_id)
    message = str(error.value)
    assert repr(env_id) in message and reason in message and "\n" not in message


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("{}[1]", KeyError),
        ("import no_such_module", ModuleNotFoundError),
    ],
)
def test_what_a_module_raises_passes_through(source, error, tmp_path, monkeypatch):
    (tmp_path / "buggy_module.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    path = sys.path[:]
    with pytest.raises(error):
        canonical_env_id("buggy_module:Env-v0")
    assert sys.path == path
