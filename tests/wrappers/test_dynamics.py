"""Random masses and frictions of a MuJoCo model."""

import json

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cases import MODEL, Cart, GenericEnv, build, constant_env, layers, rollout, same, streams

import ppo_continuous_noisy as ppo
from noisy_wrappers import RandomDynamics, RandomNormalNoisyReward, SpaceError, make_noisy

FIELDS = ("body_mass", "geom_friction", "dof_damping", "dof_armature", "jnt_stiffness")
FIELDS += ("actuator_gear", "actuator_gainprm")
ENVS = ["HalfCheetah-v5", "Hopper-v5", "Humanoid-v5", "Pusher-v5", "Walker2d-v5", "Cart-v0"]


def values(model):
    """All arrays of a model, and its statistics."""
    found = {}
    for owner in (model, model.stat):
        for name in dir(owner):
            value = None if name.startswith("_") else getattr(owner, name)
            if isinstance(value, np.ndarray | float):
                found[name] = np.array(value)
    return found


def changed(before, model):
    after = values(model)
    assert before.keys() == after.keys()
    return {name for name in after if after[name].tobytes() != before[name].tobytes()}


def model_of(env_id):
    env = gym.make(env_id)
    usable = tuple(field for field in FIELDS if getattr(env.unwrapped.model, field).any())
    return env, env.unwrapped.model, usable


@pytest.mark.parametrize("env_id", ENVS)
def test_an_episode_that_is_not_chosen_is_the_bare_environment(env_id):
    """Bit for bit, after 100 chosen episodes: nothing piles up, nothing is left."""
    env, model, fields = model_of(env_id)
    action = np.full(env.action_space.shape, 0.3, np.float32)
    bare = rollout(env, seed=5, steps=20, action=action)
    nominal = values(model)
    noisy = RandomDynamics(env, 1.0, 0.5, 1.5, fields=fields)
    for episode in range(100):
        noisy.reset(seed=episode)
        noisy.step(action)
        assert {*fields, "body_inertia", "body_subtreemass"} <= changed(nominal, model)
    assert not same(rollout(noisy, seed=5, steps=20, action=action), bare)
    noisy.noise_rate = 0.0
    assert same(rollout(noisy, seed=5, steps=20, action=action), bare)
    assert changed(nominal, model) == set()


def test_factors_golden():
    env, model, _ = model_of("Cart-v0")
    nominal = values(model)
    noisy = RandomDynamics(env, 0.5, 0.5, 1.5, fields=("body_mass", "geom_friction"))
    gate, noise = streams(RandomDynamics, seed=3)
    chosen = 0
    for episode in range(40):
        _, info = noisy.reset(seed=3 if episode == 0 else None)
        mass, friction = noise.uniform(0.5, 1.5, 4), noise.uniform(0.5, 1.5, 3)
        if gate.random() >= 0.5:
            assert info == {} and changed(nominal, model) == set()
            assert noisy.step(np.zeros(2))[4] == {}
            continue
        chosen += 1
        np.testing.assert_array_equal(model.body_mass, nominal["body_mass"] * mass)
        inertia = nominal["body_inertia"] * mass[:, None]
        np.testing.assert_array_equal(model.body_inertia, inertia)
        np.testing.assert_array_equal(
            model.geom_friction, nominal["geom_friction"] * friction[:, None]
        )
        assert info["noise"] == ("RandomDynamics",) == noisy.step(np.zeros(2))[4]["noise"]
        assert info["dynamics"].keys() == {"body_mass", "geom_friction"}
        np.testing.assert_array_equal(info["dynamics"]["body_mass"], mass)
    assert (noisy.times_applied, noisy.opportunities) == (chosen, 40)


def test_factors_are_uniform_and_independent():
    noisy = RandomDynamics(Cart(), 1.0, 0.5, 1.5)
    drawn = []
    for episode in range(3000):
        factors = noisy.reset(seed=0 if episode == 0 else None)[1]["dynamics"]
        drawn.append(np.concatenate([factors["body_mass"], factors["geom_friction"]]))
    drawn = np.array(drawn)
    np.testing.assert_allclose(drawn.mean(axis=0), 1, atol=0.02)
    np.testing.assert_allclose(drawn.var(axis=0), 1 / 12, rtol=0.06)
    np.testing.assert_allclose(np.corrcoef(drawn.T), np.eye(7), atol=0.08)


@pytest.mark.parametrize("factor", [0.5, 1.3])
def test_derived_constants_are_those_of_a_model_with_the_changed_mass(factor):
    spec = mujoco.MjSpec.from_string(MODEL)
    for geom in spec.geoms:
        geom.density = 1000 * factor
    wanted = values(spec.compile())
    env = Cart()
    RandomDynamics(env, 1.0, factor, factor, fields=("body_mass",)).reset(seed=0)
    got = values(env.model)
    # A damping ratio becomes a damping when a model is compiled, and is one from then on.
    for name in wanted.keys() - {"actuator_biasprm"}:
        np.testing.assert_allclose(got[name], wanted[name], rtol=1e-9, atol=1e-12, err_msg=name)
    derived = "body_subtreemass body_invweight0 dof_invweight0 dof_M0 actuator_acc0 meaninertia "
    derived += "tendon_invweight0 meanmass cam_poscom0 light_poscom0"
    nominal = values(Cart().model)
    if factor != 1:
        same_com = {"cam_poscom0", "light_poscom0"}  # if all masses change alike
        different = {name for name in wanted if (wanted[name] != nominal[name]).any()}
        assert {*derived.split()} - same_com <= different


class Rebuilt(Cart):
    """An environment that makes its model anew at every reset."""

    def reset(self, **kwargs):
        Cart.__init__(self)
        return super().reset(**kwargs)


def test_a_model_that_is_built_in_reset():
    env = Rebuilt()
    noisy = RandomDynamics(env, 1.0, 1.3, 1.3)
    mass = env.model.body_mass.copy()
    for _ in range(3):
        noisy.reset(seed=0)
        np.testing.assert_array_equal(env.model.body_mass, 1.3 * mass)
    noisy.noise_rate = 0
    noisy.reset()
    np.testing.assert_array_equal(env.model.body_mass, mass)


class Choosing(Cart):
    """An environment with two models, or several of different size, one for each episode."""

    def __init__(self, *worlds):
        super().__init__()
        worlds = worlds or (MODEL, MODEL.replace('size="0.05"', 'size="0.06"'))
        self.models = [mujoco.MjModel.from_xml_string(text) for text in worlds]
        self.episode = -1
        self.choose()

    def choose(self):
        self.episode += 1
        self.model = self.models[self.episode % len(self.models)]
        self.data = mujoco.MjData(self.model)

    def reset(self, **kwargs):
        self.choose()
        return super().reset(**kwargs)


def test_models_that_reset_chooses_from():
    env = Choosing()
    masses = [model.body_mass.copy() for model in env.models]
    noisy = RandomDynamics(env, 1.0, 1.3, 1.3)
    for episode in range(5):
        noisy.reset(seed=0)
        chosen = (episode + 1) % 2
        np.testing.assert_array_equal(env.models[chosen].body_mass, 1.3 * masses[chosen])
        np.testing.assert_array_equal(env.models[1 - chosen].body_mass, masses[1 - chosen])


def test_a_model_of_another_size_has_factors_of_its_own():
    ball = '<body name="second" pos="1 1 2"><geom size="0.1"/></body></worldbody>'
    env = Choosing(MODEL, MODEL.replace("</worldbody>", ball))
    noisy = RandomDynamics(env, 1.0, 0.5, 1.5)
    bodies = [len(noisy.reset(seed=1)[1]["dynamics"]["body_mass"]) for _ in range(4)]
    assert bodies == [len(env.models[i].body_mass) for i in (1, 0, 1, 0)] and len({*bodies}) == 2


def test_an_environment_may_be_wrapped_again():
    env = Cart()
    nominal = values(env.model)
    for factor in (0.5, 1.0, 2.0):
        RandomDynamics(env, 1.0, factor, factor).reset(seed=0)
        np.testing.assert_array_equal(env.model.body_mass, factor * nominal["body_mass"])
    RandomDynamics(env, 0.0, 0.5, 1.5)
    assert changed(nominal, env.model) == set()


class Heavier(Cart):
    """An environment that sets the mass of its cart at every reset."""

    def reset(self, **kwargs):
        self.episode = getattr(self, "episode", 0) + 1
        self.model.body_mass[1] = self.episode
        return super().reset(**kwargs)


def test_contact_pairs_have_a_friction_of_their_own():
    pair = '<contact><pair geom1="a" geom2="b"/></contact></mujoco>'
    text = MODEL.replace('<geom type="box"', '<geom name="a" type="box"')
    text = text.replace('<geom type="capsule"', '<geom name="b" type="capsule"')
    env = Choosing(text.replace("</mujoco>", pair))
    friction = env.model.pair_friction.copy()
    RandomDynamics(env, 1.0, 0.5, 0.5, fields=("pair_friction",)).reset(seed=0)
    np.testing.assert_array_equal(env.model.pair_friction, 0.5 * friction)


@pytest.mark.parametrize("rate", [1.0, 0.01])
def test_fields_that_reset_sets_itself_are_refused(rate):
    """At the first reset, whether the episode is chosen or not."""
    noisy = RandomDynamics(Heavier(), rate, 1.5, 1.5)
    with pytest.raises(SpaceError, match="fields: this environment's reset.. sets body_mass itse"):
        noisy.reset(seed=0)
    friction = RandomDynamics(Heavier(), 1.0, 1.5, 1.5, fields=("geom_friction",))
    assert friction.reset(seed=0)[1]["noise"] == ("RandomDynamics",)


def test_what_the_user_changes_between_episodes_stays():
    env = Cart()
    noisy = RandomDynamics(env, 0.0, 1.3, 1.3)
    noisy.reset(seed=0)
    env.model.body_mass[1] = 7
    noisy.reset()
    assert env.model.body_mass[1] == 7
    noisy.noise_rate = 1.0
    noisy.reset()
    assert env.model.body_mass[1] == 1.3 * 7


def test_dm_control_keeps_its_model_in_its_physics():
    class Pointer:
        def __init__(self, ptr):
            self.ptr = ptr

    cart = Cart()
    env = GenericEnv()
    del env.model
    env._env = type("Environment", (), {})()
    env._env.physics = type("Physics", (), {})()
    env._env.physics.model = Pointer(cart.model)
    RandomDynamics(env, 1.0, 0.5, 0.5).reset(seed=0)
    assert cart.model.body_mass[1] == 0.5 * Cart().model.body_mass[1]


def test_environments_that_it_cannot_change():
    for env in (gym.make("CartPole-v1"), RandomNormalNoisyReward(gym.make("Pendulum-v1"), 1, 1)):
        with pytest.raises(ValueError, match="needs an environment with a MuJoCo model"):
            RandomDynamics(env, 0.1, 0.5, 1.5)
    for field in ("tendon_damping", "jnt_stiffness"):  # there is no tendon; all are 0
        with pytest.raises(ValueError, match=f"has no {field}, or zeros only"):
            RandomDynamics(gym.make("Hopper-v5"), 0.1, 0.5, 1.5, fields=(field,))
    for field in ("geom_size", "geom_quat", "body_pos", "jnt_axis"):
        with pytest.raises(ValueError, match=f"'{field}' cannot be scaled"):
            RandomDynamics(Cart(), 0.1, 0.5, 1.5, fields=(field,))
    with pytest.raises(ValueError, match="body_mass takes body_inertia along"):
        RandomDynamics(Cart(), 0.1, 0.5, 1.5, fields=("body_inertia", "body_mass"))
    once = RandomNormalNoisyReward(RandomDynamics(Cart(), 0.1, 0.5, 1.5), 0.1, 1)
    with pytest.raises(ValueError, match="name all fields in one"):
        RandomDynamics(once, 0.1, 0.5, 1.5)


def test_it_is_the_innermost():
    noises = ["RandomNormalNoisyAction(1)", "RandomActionDelay(2)", "RandomEarlyTermination(9)"]
    noises += ["RandomNormalNoisyReward(1)", "RandomDynamics(0.5, 1.5)"]
    env = make_noisy(Cart(), noises, [0.5])
    assert layers(env) == [
        "RandomDynamics",
        "RandomEarlyTermination",
        "RandomActionDelay",
        "RandomNormalNoisyAction",
        "RecordEpisodeStatistics",
        "RandomNormalNoisyReward",
    ]


@pytest.mark.parametrize("vector", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
def test_vectors_of_environments(vector):
    envs = vector([lambda: RandomDynamics(Cart(), 1.0, 0.5, 1.5)] * 2)
    try:
        factors = envs.reset(seed=0)[1]["dynamics"]["body_mass"]
    finally:
        envs.close()
    assert factors.shape == (2, 4) and (factors[0] != factors[1]).any()


@pytest.mark.slow
def test_a_policy_is_trained_and_tested_under_changed_mass(tmp_path):
    """It says what a policy returns that met changed masses in training, and one that did not."""
    common = {"env_id": "InvertedPendulum-v5", "compile": False, "runs_dir": str(tmp_path)}
    noise = {"noise": ("RandomDynamics(0.5, 1.5)",), "noise_rate": (1.0,)}
    for more in ({}, noise):
        ppo.train(ppo.Args(**common, **more, total_timesteps=4_096, eval_frequency=0))
    [folder] = tmp_path.glob("p1.0_s1_Dynamics_0.5_1.5__*")
    assert json.loads((folder / "result.json").read_text())["noise_applied_fraction"] == {
        "RandomDynamics": 1.0
    }
    returns = {}
    for run in tmp_path.iterdir():
        for mass in (1.0, 3.0):
            env = ppo.make_env("InvertedPendulum-v5")
            env = RandomDynamics(env, 1.0, mass, mass, fields=("body_mass",))
            policy, total = ppo.load_policy(run, env), 0.0
            for episode in range(2):
                observation, done = env.reset(seed=episode)[0], False
                while not done:
                    observation, reward, terminated, truncated, _ = env.step(policy(observation))
                    total, done = total + reward, terminated or truncated
            returns[run.name, mass] = total / 2
    assert len(returns) == 4 and all(5 < value <= 1000 for value in returns.values())
    assert len({value for value in returns.values()}) > 1


def test_the_environments_own_info_is_kept():
    info = {"key": 1}
    env = GenericEnv(reset=lambda env: (env.draw(), info))
    got = build("RandomDynamics(0.5, 1.5)", env, 1.0).reset(seed=0)[1]
    assert got.keys() == {"key", "noise", "dynamics"} and info == {"key": 1}
    assert constant_env().reset()[1] == {}
