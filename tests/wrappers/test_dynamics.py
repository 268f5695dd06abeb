"""Random masses and frictions of a MuJoCo model."""

import itertools
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cases import MODEL, Cart, GenericEnv, streams

from noisy_wrappers import (
    RandomDynamics,
    RandomNormalNoisyReward,
    SpaceError,
    make_noisy,
    noise_wrappers,
)


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


def test_factors_golden():
    """Of two wrappers: equal ones draw different noise, because positions are part of the seed."""
    joints = "RandomDynamics(0.5, 2.0, fields=('dof_damping', 'dof_armature'))"
    env = make_noisy(Cart(), ["RandomDynamics(0.8, 1.2)", joints], [0.6])
    model, nominal = env.unwrapped.model, values(env.unwrapped.model)
    gates = [streams(RandomDynamics, 4, position) for position in (0, 1)]
    seen = []
    for episode in range(40):
        info = env.reset(seed=4 if episode == 0 else None)[1]
        mass, friction = gates[0][1].uniform(0.8, 1.2, 4), gates[0][1].uniform(0.8, 1.2)
        damping, armature = gates[1][1].uniform(0.5, 2, (2, 8))
        first, second = (gate.random() < 0.6 for gate, _ in gates)
        seen.append((first, second))
        factors = {"body_mass": mass, "geom_friction": friction} if first else {}
        factors |= {"dof_damping": damping, "dof_armature": armature} if second else {}
        for name in ("body_mass", "geom_friction", "dof_damping", "dof_armature"):
            expected = nominal[name] * factors.get(name, 1)
            np.testing.assert_array_equal(getattr(model, name), expected)
        inertia = nominal["body_inertia"].T * factors.get("body_mass", 1)
        np.testing.assert_array_equal(model.body_inertia.T, inertia)
        if not factors:
            assert info == {} and changed(nominal, model) == set()
            continue
        np.testing.assert_equal(info["dynamics"].get("body_mass", mass), mass)
        assert info["dynamics"].keys() == factors.keys()
        told = ("RandomDynamics",) * (first + second)
        assert info["noise"] == told == env.step(np.zeros(2))[4]["noise"]
    assert len({*seen}) == 4
    counted = [wrapper.times_applied for wrapper in noise_wrappers(env).values()]
    assert counted == np.sum(seen, axis=0).tolist()


def test_derived_constants_are_those_of_a_model_with_the_changed_mass():
    env = Cart()
    info = RandomDynamics(env, 1.0, 0.5, 1.5, fields=("body_mass",)).reset(seed=0)[1]
    spec = mujoco.MjSpec.from_string(MODEL)
    for geom in spec.geoms:
        body = env.model.body(geom.parent.name).id
        geom.density = 1000 * info["dynamics"]["body_mass"][body]
    wanted, nominal, got = values(spec.compile()), values(Cart().model), values(env.model)
    # A damping ratio becomes a damping when a model is compiled, and is one from then on.
    for name in wanted.keys() - {"actuator_biasprm"}:
        np.testing.assert_allclose(got[name], wanted[name], rtol=1e-9, atol=1e-12, err_msg=name)
    derived = "body_subtreemass body_invweight0 dof_invweight0 dof_M0 actuator_acc0 meaninertia "
    derived += "tendon_invweight0 meanmass cam_poscom0 light_poscom0"
    assert all((wanted[name] != nominal[name]).any() for name in derived.split())


class Choosing(Cart):
    """An environment with one or several models, which builds one anew for each episode."""

    def __init__(self, *worlds):
        self.worlds = itertools.cycle(worlds)
        self.choose()

    def choose(self):
        self.model = mujoco.MjModel.from_xml_string(next(self.worlds))
        self.data = mujoco.MjData(self.model)

    def reset(self, **kwargs):
        self.choose()
        return super().reset(**kwargs)


def test_models_that_reset_builds_anew():
    worlds = MODEL, MODEL.replace('size="0.1"', 'size="0.3"')
    env = Choosing(*worlds)
    masses = [mujoco.MjModel.from_xml_string(text).body_mass for text in worlds]
    noisy = RandomDynamics(env, 1.0, 0.5, 1.5)
    for chosen in (1, 0, 1):
        factors = noisy.reset(seed=1)[1]["dynamics"]["body_mass"]
        np.testing.assert_array_equal(env.model.body_mass, factors * masses[chosen])


def test_an_environment_may_be_wrapped_again():
    env = Cart()
    nominal = values(env.model)
    for factor in (0.5, 1.0, 2.0):
        RandomDynamics(env, 1.0, factor, factor).reset(seed=0)
        np.testing.assert_array_equal(env.model.body_mass, factor * nominal["body_mass"])
    RandomDynamics(env, 0.0, 0.5, 1.5)
    assert changed(nominal, env.model) == set()


@pytest.mark.parametrize(
    ("actuator", "gain", "bias"),  # which of their parameters are the strength
    [
        ('motor joint="slide"', [0], []),
        ('position joint="slide" kp="30" kv="5"', [0], [1, 2]),  # kp (control - q) - kv dq/dt
        ('velocity joint="slide" kv="30"', [0], [2]),  # kv (control - dq/dt)
        ('muscle joint="slide" force="30" lengthrange="0 1"', [2, 3], [2, 3]),
    ],
)
def test_half_the_strength_of_an_actuator(actuator, gain, bias):
    env = Choosing(MODEL.replace('motor joint="slide" gear="50"', actuator))
    nominal = values(env.model)
    RandomDynamics(env, 1.0, 0.5, 0.5, fields=("actuator_gainprm",)).reset(seed=0)
    for name, halved in (("actuator_gainprm", gain), ("actuator_biasprm", bias)):
        expected = nominal[name][0].copy()
        assert expected[halved].all()
        expected[halved] *= 0.5
        np.testing.assert_array_equal(getattr(env.model, name)[0], expected)


def test_the_range_of_forces_is_a_field_of_its_own():
    env = Choosing(MODEL.replace('kp="3"', 'kp="3" forcerange="-4 4"'))
    RandomDynamics(env, 1.0, 0.5, 0.5, fields=("actuator_forcerange",)).reset(seed=0)
    assert env.model.actuator_forcerange[1].tolist() == [-2, 2]
    assert env.model.actuator_gainprm[1, 0] == 3


class Randomizing(Cart):
    """An environment that multiplies fields itself, at every third reset."""

    def __init__(self, *fields):
        super().__init__()
        self.fields, self.episode = fields, -1

    def reset(self, **kwargs):
        found = super().reset(**kwargs)
        self.episode += 1
        if self.episode % 3 == 0:
            for field in self.fields:
                getattr(self.model, field)[:] *= self.np_random.uniform(0.5, 1.5)
        return found


OWN = ("actuator_gainprm", "actuator_biasprm", "cam_pos0")
SCALED = ("body_mass", "geom_friction", "dof_damping", "dof_armature", "jnt_stiffness")


def test_other_episodes_are_those_of_an_environment_that_randomizes_itself():
    """Bit for bit: nothing piles up, nothing is left of chosen episodes."""
    bare, env = Randomizing(*OWN), Randomizing(*OWN)
    noisy = RandomDynamics(env, 0.5, 0.5, 1.5, fields=SCALED)
    chosen = 0
    for episode in range(24):
        seed = 3 if episode == 0 else None
        bare.reset(seed=seed)
        info = noisy.reset(seed=seed)[1]
        different = changed(values(bare.model), env.model)
        if not info:
            assert different == set(), episode
            continue
        chosen += 1
        mass = info["dynamics"]["body_mass"]
        np.testing.assert_array_equal(env.model.body_mass, mass * bare.model.body_mass)
        assert {*SCALED, "body_inertia", "body_subtreemass"} <= different
        assert not different & {*OWN}
    assert 5 < chosen < 20


def test_fields_that_reset_sets_itself_are_refused():
    """At the first reset, whether the episode is chosen or not."""
    noisy = RandomDynamics(Randomizing("body_mass"), 0.01, 1.5, 1.5)
    with pytest.raises(SpaceError, match="fields: this environment's reset.. sets body_mass itse"):
        noisy.reset(seed=0)


def test_dm_control_keeps_its_model_in_its_physics():
    cart, env = Cart(), GenericEnv()
    del env.model
    env._env = SimpleNamespace(physics=SimpleNamespace(model=SimpleNamespace(ptr=cart.model)))
    RandomDynamics(env, 1.0, 0.5, 0.5).reset(seed=0)
    assert cart.model.body_mass[1] == 0.5 * Cart().model.body_mass[1]


def test_environments_that_it_cannot_change():
    motor, polynomial = '<motor joint="slide" gear="50"/>', Cart()
    polynomial.model.dof_dampingpoly[0] = 2  # beside the linear damping
    once = RandomNormalNoisyReward(RandomDynamics(Cart(), 0.1, 0.5, 1.5), 0.1, 1)
    dc = '<dcmotor joint="slide" motorconst="1" resistance="1"/>'
    constant = '<cylinder joint="slide" area="2" bias="1 -3 -1"/>'  # its constant force would stay
    for env, field, problem in (
        (gym.make("CartPole-v1"), "body_mass", "needs a MuJoCo model"),
        (gym.make("Hopper-v5"), "tendon_damping", "has no tendon_damping, or zeros only"),
        (Choosing(MODEL.replace(motor, dc)), "actuator_gainprm", "gainprm needs .* motors"),
        (Choosing(MODEL.replace(motor, constant)), "actuator_gainprm", "without a constant bias"),
        (polynomial, "dof_damping", "dof_damping of this environment's model is a polynomial"),
        (once, "body_mass", "another RandomDynamics .* scales body_"),
        (once, "body_inertia", "another RandomDynamics .* scales body_"),
    ):
        with pytest.raises(ValueError, match=problem):
            RandomDynamics(env, 0.1, 0.5, 1.5, fields=(field,))
