"""Short runs of a training script, trained in this process and watched while they learn."""

import contextlib
import copy
import functools
import importlib.util
import inspect
import io
import itertools
import os
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch.overrides import TorchFunctionMode

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import noisy_wrappers as noisy  # noqa: E402
from analysis.errors import fail  # noqa: E402
from analysis.words import counted  # noqa: E402
from sweep.options import GIVEN_BY_THE_GRID  # noqa: E402

# A test and the end of a rollout fall within an episode; the buffer is filled twice. Episodes have
# an odd number of steps, so that what counts steps or updates is not at 0 again where one ends.
SMALL = {"env_id": "Pendulum-v1", "total_timesteps": 150, "max_episode_steps": 21}
SMALL |= {"eval_frequency": 47, "eval_episodes": 2, "compile": False, "buffer_size": 80}
SMALL |= {"matmul_precision": "highest", "learning_starts": 40, "batch_size": 16}
SMALL |= {"num_steps": 50, "num_minibatches": 2, "update_epochs": 2}


class BrokenError(Exception):
    """A promise is broken: what is wrong, and what to do."""


class Lopsided(gym.Env):
    """A walk in the plane. Its two actions have other bounds, which are not centred at 0.

    What is wrong in the second action, or in the bounds, does not show on Pendulum-v1.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    low, high = np.array([[-1, -2], [1, 3]], np.float32)
    action_space = gym.spaces.Box(low, high)

    def reset(self, *, seed=None, options=None):
        """Begin at a random place."""
        super().reset(seed=seed)
        self.place = self.np_random.normal(size=2).astype(np.float32)
        return self.place.copy(), {}

    def step(self, action):
        """Move, and lose what the place is away from 0."""
        noise = self.np_random.normal(size=2).astype(np.float32)
        self.place = 0.5 * self.place + action + 0.1 * noise
        return self.place.copy(), -float(abs(self.place).sum()), False, False, {}


gym.register("Lopsided-v0", Lopsided, max_episode_steps=20)


def zeros(*size, generator=None, **options):
    """Stand in for torch.randn."""
    return torch.zeros(*size, **options)


def check(holds, text):
    """Raise BrokenError unless something holds."""
    if not holds:
        raise BrokenError(text)


class Trial:
    """A script, options of its own, and a folder to try it in."""

    def __init__(self, path, options, folder):
        self.path, self.options, self.folder = path, options, folder
        self.algorithm = path.name.removesuffix("_continuous_noisy.py").lower()
        self.own_options, in_grid = [], False  # without those that a sweep's grid sets
        for word in options:
            if word.startswith("--"):
                in_grid = word.partition("=")[0].replace("_", "-") in GIVEN_BY_THE_GRID
            self.own_options += [] if in_grid else [word]

    def train(self, name, **kwargs):
        """Return a short run, watched, in a folder of runs."""
        if "episodes" in kwargs:
            kwargs["updates"] = len(self.run.updates)
        return train(self.path, self.options, self.folder / name, **kwargs)

    def refuses(self, **changed):
        """Return whether the finished run is refused with other arguments."""
        try:
            self.train("whole", **changed)
        except Exception:  # the script may check its own options
            return True
        return False

    @property
    def lopsided(self):
        """The environment in which actions are compared, if the options name none."""
        env_id = self.run.args.env_id
        return "Lopsided-v0" if env_id == SMALL["env_id"] else env_id

    @functools.cached_property
    def run(self):
        """The run that others are compared with; exits where the script refuses the options."""
        try:
            return self.train("whole")
        except BrokenError as error:
            if self.options and getattr(error.__cause__, "code", 0) == 2:
                fail(str(error).removeprefix("error: "))
            raise

    @functools.cached_property
    def resumed(self):
        """The same run, stopped early and late, and resumed."""
        stopped = self.train("resumed", episodes=4)
        check(not stopped.finished, "it did not stop at the end of an episode: ask stop() there")
        late = 3 * self.run.episodes // 4 - stopped.episodes
        if late > 0:  # what changes late is in the state, too
            self.train("resumed", episodes=late)
        return self.train("resumed")

    def read(self, run, name):
        """Return a file of a run."""
        return (run.folder / name).read_bytes()

    def command(self, *words):
        """Return what a command prints that is started beside the script."""
        kwargs = {"cwd": self.path.parent, "env": os.environ | {"PYTHON": sys.executable}}
        result = subprocess.run(list(map(str, words)), capture_output=True, text=True, **kwargs)
        check(result.returncode == 0, (result.stdout + result.stderr).strip()[-500:])
        return result.stdout


def train(path, options, runs_dir, episodes=0, updates=0, **changed):
    """Train by a script, imported anew as in a new process.

    It is stopped when it has learned with a number of updates, and after a number of episodes.
    Return what was seen:
    - `updates`, for each loss the network that it learns, its parameters before the first update,
      the curves and the gradient of the first, the inputs of the last, and see plain_gradient()
    - `idle`, {name: (network, optimizer)} of the losses whose update was never called
    - `with_gradient`, the ids of parameters that had a gradient in any update
    - `start`, the step at which it began, and `episodes`, how many ended
    - `places`, where observations were returned: {bytes: [(episode, step, at a time limit), ...]}
    - `gaps`, how far the first action after each test was from that of load_policy()
    - `networks` of the state that resumes, {name: (network, its state_dict at the start)}
    - `others`, {name: (another part of the state, the bytes of its state_dict at the start)}
    """
    spec = importlib.util.spec_from_file_location(path.stem, path)
    sys.modules[path.stem] = script = importlib.util.module_from_spec(spec)
    seen = SimpleNamespace(script=script, idle={}, updates=[], gaps=[], places={})
    seen.episodes, seen.with_gradient, said = 0, set(), io.StringIO()

    def stop():
        seen.episodes += 1
        return seen.episodes >= episodes > 0 and len(seen.updates) >= updates

    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # for what it imports
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            spec.loader.exec_module(script)
            args = script.Args()
            small = {name: value for name, value in SMALL.items() if hasattr(args, name)}
            args = tyro.cli(script.Args, args=options, default=replace(args, **small))
            seen.args = replace(args, **{"runs_dir": str(runs_dir)} | changed)
            script.updater = watch_updates(script.updater, seen)
            script.learn = watch_environment(script.learn, seen)
            script.Run.resume = watch_networks(script.Run.resume, seen)
            seen.finished = script.train(seen.args, stop)
        except SystemExit as error:
            text = re.sub("[╭─╮│╰╯]+|-{3,}", "", said.getvalue())
            ours = [line for line in text.splitlines() if line.startswith("error: ")]
            raise BrokenError(ours[-1] if ours else " ".join(text.split())) from error
    seen.said = said.getvalue()
    return seen


def what_resuming_changes(trial, name):
    """Return "" or which file differs, and from which step on."""
    resumed, run = (trial.read(one, name) for one in (trial.resumed, trial.run))
    lines = zip(resumed.splitlines(), run.splitlines(), strict=False)
    other = [line for line, wanted in lines if line != wanted]
    is_table = name.endswith(".csv") and other
    at = f" from step {other[0].decode().partition(',')[0]} on" if is_table else ""
    return "" if resumed == run else f"another {name}{at}"


def other_values(args):
    """Return other values of numbers and flags that make another run."""
    values = {name: x for name, x in asdict(args).items() if isinstance(x, int | float)}
    for name in values.keys() & {"seed", *noisy.MAY_DIFFER_IN_A_RUN}:
        del values[name]
    return {name: not x if isinstance(x, bool) else x + 1 for name, x in values.items()}


def watch_updates(updater, seen):
    """Return a script's updater, which notes what it updates."""

    def watched_updater(loss, network, optimizer, *others):
        update = updater(loss, network, optimizer, *others)
        parameters = {name: p for name, p in network.named_parameters() if p.requires_grad}
        before = {name: p.detach().clone() for name, p in parameters.items()}
        own = SimpleNamespace(name=getattr(loss, "__name__", "a loss"), loss=loss, network=network)
        own.parameters, known = parameters, set(map(id, network.parameters()))
        own.optimizer = optimizer
        own.stepped = stepped = {id(p) for group in optimizer.param_groups for p in group["params"]}
        text = f"the optimizer of {own.name}() also steps {len(stepped - known)} tensors of others"
        # as updater() itself says, unless it was rewritten
        check(stepped <= known, f"{text}: give it this network's parameters alone")
        seen.idle[own.name] = (network, optimizer)

        def watched(*inputs):
            inputs = as_given(inputs)
            kept = known == set(map(id, network.parameters()))
            check(kept, f"{own.name}() learns a layer that was replaced: change it in place")
            if not hasattr(own, "first"):
                with noisy.kept_generators(), Broadcasts(own.name):
                    # copies, because a layer may change in forward(), as spectral_norm() does
                    loss(*copy.deepcopy((network, *inputs)))
                trainable = [p for p in network.parameters() if p.requires_grad]
                expected, own.strays = plain_gradient(loss, network, inputs, trainable)
            if seen.start == 0:
                check_transitions(own.name, inputs, seen.places)
            curves, own.inputs = update(*inputs), inputs
            moved = {id(p) for p in parameters.values() if p.grad is not None and p.grad.any()}
            seen.with_gradient |= moved
            if not hasattr(own, "first"):
                seen.updates.append(own)
                seen.idle.pop(own.name, None)
                own.before = before
                learned = {name: p for name, p in parameters.items() if p.grad is not None}
                own.first = curves | {name: p.grad.clone() for name, p in learned.items()}
                gradient = [torch.zeros_like(p) if p.grad is None else p.grad for p in trainable]
                own.gradient_gap = gap_between(gradient, expected)
            return curves

        return watched

    return watched_updater


def plain_gradient(loss, network, inputs, trainable):
    """Return a loss's gradient by autograd, for these parameters, and the ids of strays.

    A stray is a tensor that requires a gradient and is in no module that the loss was given.
    """
    if not trainable:
        return [], set()
    modules = [x for x in (network, *inputs) if isinstance(x, torch.nn.Module)]
    states = copy.deepcopy([module.state_dict() for module in modules])
    with noisy.kept_generators(), torch.enable_grad():
        value, _ = loss(network, *inputs)
    given = {id(p) for module in modules for p in module.parameters()}
    given |= set(map(id, tensors_among(inputs)))
    nodes, strays = {value.grad_fn}, set()
    new = nodes
    while new:
        new = {node for parent in new for node, _ in parent.next_functions if node} - nodes
        nodes |= new
        strays |= {id(node.variable) for node in new if hasattr(node, "variable")} - given
    gradient = torch.autograd.grad(value, trainable, materialize_grads=True)
    for module, state in zip(modules, states, strict=True):
        module.load_state_dict(state)
    return gradient, strays


def gap_between(gradient, other):
    """Return how far the directions of two gradients are from each other; PPO clips the length."""
    if not gradient:
        return 0.0
    gradient, other = (torch.cat([p.flatten() for p in tensors]) for tensors in (gradient, other))
    return float((gradient / gradient.norm() - other / other.norm()).abs().max())


class Broadcasts(TorchFunctionMode):
    """Refuses to make (B, B) of (B, 1) and (B,), the quietest of all mistakes in a loss."""

    def __init__(self, name):
        super().__init__()
        self.name = name

    def __torch_function__(self, function, types, args=(), kwargs=None):
        """Call a function of PyTorch."""
        result = function(*args, **(kwargs or {}))
        shapes = {tuple(x.shape) for x in args if torch.is_tensor(x)}
        for n in {shape[0] for shape in shapes if len(shape) == 1 and shape[0] > 1}:
            is_loss = function.__name__.endswith("_loss")  # returns the mean of them
            ends = {shape[-2:] for shape in shapes}  # (N, B, 1) of N networks at once
            if ends == {(n,), (n, 1)} and (is_loss or result.shape[-2:] == (n, n)):
                text = f"{self.name}() makes ({n}, {n}) of ({n}, 1) and ({n},)"
                raise BrokenError(f"{text}: give both the same shape, as squeeze(1) does")
        return result


def as_given(inputs):
    """Return the inputs of an update as updater() gives them to a loss: numbers are tensors."""
    numbers = (int, float, np.float32, np.float64, np.int32, np.int64)
    return tuple(torch.tensor(float(x)) if type(x) in numbers else x for x in inputs)


def tensors_among(inputs):
    """Return the tensors that an update was given, also those in a list."""
    lists = [x if isinstance(x, list | tuple) else [x] for x in inputs]
    return [x for given in lists for x in given if torch.is_tensor(x)]


def keys(batch):
    """Return the rows of a tensor as `places` has them."""
    return [row.tobytes() for row in batch.float().cpu().numpy()]


def raw_observations(inputs, places):
    """Return the batches that have observations as the environment returned them."""
    batches = [x for x in tensors_among(inputs) if x.ndim == 2]
    return [x for x in batches if any(key in places for key in keys(x))]


def check_transitions(name, inputs, places):
    """Check that next observations are later ones, and that no time limit counts as an end.

    That is seen where an update is given two batches of observations, s before s', and two numbers
    for each row at least, such as rewards. Nothing is said of rows that the environment did not
    return (those of a model, or relabelled), and nothing of two vectors of flags or discounts.
    """
    raw = raw_observations(inputs, places)
    size = len(raw[0]) if raw else 0
    numbers = [x for x in tensors_among(inputs) if x.shape in ((size,), (size, 1))]
    if len(raw) != 2 or len(raw[1]) != size or len(numbers) < 2:
        return
    rows, at_limit = [], []
    advice = "give s before s'; store what step() returned, before reset(); test in test_env alone"
    for row, (key, next_key) in enumerate(zip(keys(raw[0]), keys(raw[1]), strict=True)):
        if key in places and next_key in places:
            pairs = itertools.product(places[key], places[next_key])
            later = [b for a, b in pairs if a.episode == b.episode and a.step < b.step]
            check(later, f"{name}() is given a next observation that does not come later: {advice}")
            rows.append(row)
            at_limit.append(any(place.at_limit for place in later))
    columns = [x.flatten().tolist() for x in numbers]
    few = [column for column in columns if len(set(column)) <= size // 2]  # flags or discounts
    if len(few) == 1 and any(at_limit) and not all(at_limit):
        values = [few[0][row] for row in rows]
        is_flag = set(values) <= {0, 1} and values == at_limit
        is_discount = [value == 0 for value in values] == at_limit
        advice = "store `terminated` alone"
        check(not (is_flag or is_discount), f"{name}() takes a time limit for an end: {advice}")


def remarks(seen):
    """Yield what may be meant so."""
    for name in seen.idle:
        yield f" (with these options nothing learns by {name}())"
    learned = set().union(*(update.stepped for update in seen.updates))
    rounds = seen.args.matmul_precision == "bf16"
    for update in seen.updates:
        if update.strays - learned:
            number = counted(len(update.strays - learned), "tensor")
            yield f" ({update.name}() depends on {number} outside its modules that nothing learns)"
        if update.gradient_gap > 1e-6 and not rounds:  # no number where the gradient is zero
            yield f" ({update.name}() is learned by another gradient than autograd's)"
    tried = [(update, *one) for update in seen.updates for one in try_inputs(update)]
    used = {id(part) for _, _, part, is_used in tried if is_used}
    for update, name, part, is_used in tried:
        by_another = "[" in name and id(part) in used  # one minibatch for several losses
        if not is_used and not by_another:
            yield f" ({update.name}() does not depend on {name})"
    for name in unused_options(seen):
        yield f" (nothing reads --{name.replace('_', '-')})"
    for one, other in itertools.combinations(seen.updates, 2):
        both = len(one.stepped & other.stepped)
        if both and one.optimizer is not other.optimizer:
            yield f" (the optimizers of {one.name}() and {other.name}() share {both} tensors)"


def try_inputs(update):
    """Yield an input's name, such as "target" or "batch[4]", itself, and whether a loss uses it.

    Those are networks, tensors and numbers, but not whole numbers, which may be sizes.
    """
    expected = outcome_of(update, update.inputs)
    names = list(inspect.signature(update.loss).parameters)[1:]
    for i, (name, given) in enumerate(zip(names, update.inputs, strict=False)):
        is_list = isinstance(given, list | tuple)
        for j, part in enumerate(given if is_list else [given]):
            other = changed(part)
            if other is part:
                continue
            inputs = list(update.inputs)
            inputs[i] = [*given[:j], other, *given[j + 1 :]] if is_list else other
            is_used = outcome_of(update, inputs) != expected
            yield f"{name}[{j}]" if is_list else name, part, is_used


def outcome_of(update, inputs):
    """Return a loss and its curves as numbers."""
    with noisy.kept_generators():  # a loss may draw, though it should not
        loss, curves = update.loss(update.network, *inputs)
    values = map(torch.as_tensor, (loss, *curves.values()))
    return [float(value.detach().double().sum()) for value in values]


def changed(given):
    """Return another network, tensor or number in place of one; anything else as it is."""
    if isinstance(given, torch.nn.Module):
        given = copy.deepcopy(given)
        with torch.no_grad():
            for parameter in given.parameters():
                parameter.add_(torch.rand_like(parameter) + 0.5)
    elif isinstance(given, float) or (torch.is_tensor(given) and given.is_floating_point()):
        given = given + torch.rand_like(torch.as_tensor(given)) + 0.5
    return given


def unused_options(seen):
    """Return the options that stand nowhere in the script but where they are defined."""
    source = Path(seen.script.__file__).read_text("utf-8")
    names = {name for name in asdict(seen.args) if len(re.findall(rf"\b{name}\b", source)) == 1}
    elsewhere = Path(noisy.__file__).read_text("utf-8")  # it is given all arguments
    return sorted(name for name in names if f'"{name}"' not in elsewhere)


def watch_environment(learn, seen):
    """Return a script's learn(), whose environment notes what it returns.

    It also compares actions with the policy of the last test.
    """

    def watched_learn(args, env, *others):
        seen.folder = Path(args.runs_dir, noisy.run_name(asdict(args)))
        reset, step, policy_pt, written = env.reset, env.step, seen.folder / "policy.pt", 0
        episode = steps = 0
        observation = given = None

        def note(returned, at_limit=False):
            nonlocal observation, given
            given, observation = returned, copy.copy(returned)
            place = SimpleNamespace(episode=episode, step=steps, at_limit=at_limit)
            seen.places.setdefault(np.float32(returned).tobytes(), []).append(place)

        def watched_reset(**kwargs):
            nonlocal episode, steps
            episode, steps = episode + 1, 0
            returned, info = reset(**kwargs)
            note(returned)
            return returned, info

        def watched_step(action):
            nonlocal written, steps
            advice = "learn() changes an observation in place, and stores that: change a copy"
            check(np.array_equal(observation, given), advice)
            time = policy_pt.stat().st_mtime_ns if policy_pt.exists() else 0
            if time != written and steps > 0:  # nothing was learned since the test
                with noisy.kept_generators():
                    wanted = seen.script.load_policy(seen.folder)(observation)
                seen.gaps.append(np.abs(wanted - action).max())
            written, steps = time, steps + 1
            returned, reward, terminated, truncated, info = step(action)
            note(returned, at_limit=truncated and not terminated)
            return returned, reward, terminated, truncated, info

        env.reset, env.step = watched_reset, watched_step
        return learn(args, env, *others)

    return watched_learn


def watch_networks(resume, seen):
    """Return a script's Run.resume(), which notes the state and the step."""

    def watched_resume(run, state):
        modules = {name: x for name, x in state.items() if isinstance(x, torch.nn.Module)}
        networks = {name: x for name, x in modules.items() if any(True for _ in x.parameters())}
        seen.networks = {name: (x, copy.deepcopy(x.state_dict())) for name, x in networks.items()}
        others = {name: x for name, x in state.items() if name not in networks}
        seen.others = {name: (x, as_bytes(x.state_dict())) for name, x in others.items()}
        seen.start = resume(run, state)
        return seen.start

    return watched_resume


def as_bytes(state):
    """Return a state_dict() as a checkpoint has it."""
    file = io.BytesIO()
    torch.save(state, file)
    return file.getvalue()


def left_behind(seen):
    """Yield what in the state never changes, and what is wrong with targets.

    Targets are the networks in the state that no update learns. Their tensors move as those of the
    learned network do that it is a copy of; of another one, all parameters move. What is to stay as
    it is needs no place in the state.
    """
    idle = [part for parts in seen.idle.values() for part in parts]
    for name, (part, begun) in seen.others.items():
        if part not in idle and as_bytes(part.state_dict()) == begun:
            yield f"{name!r} never changes: update it, or leave it out of `state`"
    learned = [update.network for update in seen.updates]
    names = {}
    for name, (network, begun) in seen.networks.items():
        if network in names:
            yield f"{name!r} is {names[network]!r} itself: copy it"
        names.setdefault(network, name)
        if network in learned or network in idle:
            continue
        moving, of = {key for key, _ in network.named_parameters()}, ""
        for other, (leader, leader_begun) in seen.networks.items():
            if leader in learned and leader.state_dict().keys() == begun.keys():
                after, of = leader.state_dict(), f", a copy of {other!r},"
                moving = {key for key in begun if not torch.equal(after[key], leader_begun[key])}
        for key, value in network.state_dict().items():
            if key in moving and torch.equal(value, begun[key]):
                yield f"{key} of {name!r}{of} never changes (parameters() has no buffers)"


def is_saved(network, seen):
    """Tell whether policy.pt has a network as it is now."""
    state, saved = network.state_dict(), seen.script.read_state(seen.folder / "policy.pt")
    parts = [part for part in saved.values() if isinstance(part, dict)]
    alike = [part for part in parts if part.keys() == state.keys()]
    state = [value.cpu() for value in state.values()]  # as read_state() has them
    return any(all(map(torch.equal, part.values(), state)) for part in alike)


def gaps_in_losses(seen, policy):
    """Return {name: how far the actions that it learns are from the policy's} of actors' losses."""
    gaps = {}
    for update in seen.updates:
        if is_saved(update.network, seen):
            gaps[update.name] = 0.0
            if found := actions_in_loss(update, seen):
                gap = np.abs(np.stack([policy(row) for row in found[0]]) - found[1]).max()
                gaps[update.name] = gap
    return gaps


def actions_in_loss(update, seen):
    """Return the observations of an actor's last update, and the actions that it gave critics.

    Nothing is returned where it asked no other network about actions, as in PPO, or where the
    observations are not as the environment gave them.
    """
    own, asked = set(update.network.modules()), []
    raw = raw_observations(update.inputs, seen.places)

    def note(module, given):
        if module not in own:
            asked.extend(given[1:2])

    with torch.no_grad(), torch.nn.modules.module.register_module_forward_pre_hook(note):
        update.loss(update.network, *update.inputs)
    return (raw[0].numpy(force=True), asked[0].numpy(force=True)) if raw and asked else ()
