"""Random masses and frictions of a MuJoCo model."""

from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cases import MODEL, Cart, GenericEnv, streams

from noisy_wrappers import RandomDynamics, RandomNormalNoisyReward, SpaceError, make_noisy


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
    env = Cart()
    model, nominal = env.model, values(env.model)
    noisy = RandomDynamics(env, 0.5, 0.5, 1.5, fields=("body_mass", "geom_friction"))
    gate, noise = streams(RandomDynamics, seed=3)
    chosen = 0
    for episode in range(40):
        _, info = noisy.reset(seed=3 if episode == 0 else None)
        mass, friction = noise.uniform(0.5, 1.5, 4), noise.uniform(0.5, 1.5)
        if gate.random() >= 0.5:
            assert info == {} and changed(nominal, model) == set()
            assert noisy.step(np.zeros(2))[4] == {}
            continue
        chosen += 1
        np.testing.assert_array_equal(model.body_mass, nominal["body_mass"] * mass)
        inertia = nominal["body_inertia"] * mass[:, None]
        np.testing.assert_array_equal(model.body_inertia, inertia)
        np.testing.assert_array_equal(model.geom_friction, nominal["geom_friction"] * friction)
        assert info["noise"] == ("RandomDynamics",) == noisy.step(np.zeros(2))[4]["noise"]
        assert info["dynamics"].keys() == {"body_mass", "geom_friction"}
        np.testing.assert_array_equal(info["dynamics"]["body_mass"], mass)
    assert (noisy.times_applied, noisy.opportunities) == (chosen, 40)


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
        self.worlds, self.episode = worlds, -1
        self.choose()

    def choose(self):
        self.episode += 1
        text = self.worlds[self.episode % len(self.worlds)]
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)

    def reset(self, **kwargs):
        self.choose()
        return super().reset(**kwargs)


def test_models_that_reset_builds_anew():
    env = Choosing(MODEL, MODEL.replace('size="0.1"', 'size="0.3"'))
    masses = [mujoco.MjModel.from_xml_string(text).body_mass for text in env.worlds]
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


ACTUATORS = {
    "motor": '<motor joint="arm" gear="3"/>',
    "position": '<position joint="arm" kp="30" kv="5"/>',
    "velocity": '<velocity joint="arm" kv="30"/>',
    "muscle": '<muscle joint="arm" force="30" lengthrange="0 1"/>',
}
ARM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="arm" axis="0 -1 0" damping="2"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" density="300"/>
    </body>
  </worldbody>
  <actuator>{}</actuator>
</mujoco>
"""


class Arm(Cart):
    """Holds an arm against gravity."""

    def __init__(self, actuator):
        self.model = mujoco.MjModel.from_xml_string(ARM.format(ACTUATORS[actuator]))
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        return self.data.qpos, {}


def driven(actuator, factor, steps=50):
    """Return an arm whose actuator has `factor` times its strength, after steps of control 1."""
    arm = Arm(actuator)
    RandomDynamics(arm, 1.0, factor, factor, fields=("actuator_gainprm",)).reset(seed=0)
    arm.data.ctrl[:] = 1
    mujoco.mj_step(arm.model, arm.data, steps)
    return arm


def test_a_position_servo_with_half_its_strength_settles_lower_on_the_same_target():
    arms = {gain: driven("position", gain / 30, steps=10_000) for gain in (30, 15)}
    np.testing.assert_array_equal(arms[15].model.actuator_gainprm[0, :3], [15, 0, 0])
    np.testing.assert_array_equal(arms[15].model.actuator_biasprm[0, :3], [0, -15, -2.5])
    load = 9.81 * arms[30].model.body_mass[1] * 0.25  # times the cosine of the angle
    angles = {gain: float(arm.data.qpos[0]) for gain, arm in arms.items()}
    for gain, angle in angles.items():
        assert gain * (1 - angle) == pytest.approx(load * np.cos(angle), rel=1e-3)
    assert 0 < angles[15] < angles[30] < 1


@pytest.mark.parametrize(
    ("actuator", "gain", "bias"), [("motor", 0.5, [0, 0, 0]), ("velocity", 15, [0, 0, -15])]
)
def test_a_motor_and_a_velocity_servo_with_half_their_strength_are_slower(actuator, gain, bias):
    weak = driven(actuator, 0.5)
    np.testing.assert_array_equal(weak.model.actuator_gainprm[0, :3], [gain, 0, 0])
    np.testing.assert_array_equal(weak.model.actuator_biasprm[0, :3], bias)
    assert weak.data.qvel[0] < driven(actuator, 1.0).data.qvel[0]


def test_the_strength_of_a_muscle_is_its_force_and_scale():
    weak, nominal = driven("muscle", 0.5).model, Arm("muscle").model
    for parameters in ("actuator_gainprm", "actuator_biasprm"):
        factor = getattr(weak, parameters)[0, :9] / getattr(nominal, parameters)[0, :9]
        np.testing.assert_array_equal(factor, [1, 1, 0.5, 0.5, 1, 1, 1, 1, 1])


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


MASS_AND_FRICTION = ("body_mass", "geom_friction")
OTHERS = ("dof_damping", "dof_armature", "jnt_stiffness", "actuator_gear", "actuator_gainprm")


@pytest.mark.parametrize(
    ("own", "scaled"),
    [
        (("actuator_gainprm", "actuator_biasprm"), MASS_AND_FRICTION),
        (("cam_pos0",), MASS_AND_FRICTION + OTHERS),
    ],
    ids=["servos", "cameras"],
)
def test_other_episodes_are_those_of_an_environment_that_randomizes_itself(own, scaled):
    """Bit for bit: nothing piles up, nothing is left of chosen episodes."""
    bare, env = Randomizing(*own), Randomizing(*own)
    noisy = RandomDynamics(env, 0.5, 0.5, 1.5, fields=scaled)
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
        assert {*scaled, "body_inertia", "body_subtreemass"} <= different
        assert not different & {*own}
    assert 5 < chosen < 20


def test_several_at_once_with_other_fields():
    """Equal wrappers in a stack draw different noise: positions are part of the seed."""
    names = ["RandomDynamics(0.8, 1.2, fields=('body_mass',))"]
    names += ["RandomDynamics(0.5, 2.0, fields=('dof_damping', 'dof_armature'))"]
    env = make_noisy(Cart(), names, [0.6])
    model, nominal = env.unwrapped.model, values(env.unwrapped.model)
    gates = [streams(RandomDynamics, 4, position) for position in (0, 1)]
    seen = set()
    for episode in range(40):
        info = env.reset(seed=4 if episode == 0 else None)[1]
        drawn = [gates[0][1].uniform(0.8, 1.2, 4), gates[1][1].uniform(0.5, 2, (2, 8))]
        chosen = tuple(gate.random() < 0.6 for gate, _ in gates)
        seen.add(chosen)
        assert info.get("noise", ()) == ("RandomDynamics",) * sum(chosen)
        mass = drawn[0] if chosen[0] else 1
        damping, armature = drawn[1] if chosen[1] else (1, 1)
        factors = {"body_mass": mass, "dof_damping": damping, "dof_armature": armature}
        for name, factor in factors.items():
            np.testing.assert_array_equal(getattr(model, name), nominal[name] * factor)
        if chosen == (True, True):
            assert info["dynamics"].keys() == factors.keys()
        if chosen == (False, False):
            assert changed(nominal, model) == set()
    assert len(seen) == 4


def test_a_wrapper_between_two_may_reset_twice():
    """As one does that begins anew until a start is good."""

    class Twice(gym.Wrapper):
        def reset(self, **given):
            self.env.reset(**given)
            return self.env.reset()

    inner = RandomDynamics(Cart(), 1, 0.5, 0.5, fields=("dof_damping",))
    env = RandomDynamics(Twice(inner), 1, 2, 2, fields=("body_mass",))
    model, nominal = env.unwrapped.model, values(env.unwrapped.model)
    for _ in range(2):
        env.reset(seed=0)
        np.testing.assert_array_equal(model.body_mass, 2 * nominal["body_mass"])
        np.testing.assert_array_equal(model.dof_damping, 0.5 * nominal["dof_damping"])


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
    with pytest.raises(ValueError, match="needs a MuJoCo model"):
        RandomDynamics(gym.make("CartPole-v1"), 0.1, 0.5, 1.5)
    with pytest.raises(ValueError, match="has no tendon_damping, or zeros only"):
        RandomDynamics(gym.make("Hopper-v5"), 0.1, 0.5, 1.5, fields=("tendon_damping",))
    with pytest.raises(ValueError, match="body_mass takes body_inertia along"):
        RandomDynamics(Cart(), 0.1, 0.5, 1.5, fields=("body_inertia", "body_mass"))
    for other in (
        '<dcmotor joint="slide" motorconst="1" resistance="1"/>',
        '<cylinder joint="slide" area="2" bias="1 -3 -1"/>',  # its constant force would stay
    ):
        env = Choosing(MODEL.replace('<motor joint="slide" gear="50"/>', other))
        with pytest.raises(ValueError, match="actuators of other kinds, or with a constant bias"):
            RandomDynamics(env, 0.1, 0.5, 1.5, fields=("actuator_gainprm",))
    env = Cart()
    env.model.dof_dampingpoly[0] = 2  # beside the linear damping
    with pytest.raises(ValueError, match="dof_damping of this environment's model is a polynomial"):
        RandomDynamics(env, 0.1, 0.5, 1.5, fields=("dof_damping",))
    once = RandomNormalNoisyReward(RandomDynamics(Cart(), 0.1, 0.5, 1.5), 0.1, 1)
    for field in ("body_mass", "body_inertia"):
        with pytest.raises(ValueError, match="another RandomDynamics .* scales body_"):
            RandomDynamics(once, 0.1, 0.5, 1.5, fields=(field,))
