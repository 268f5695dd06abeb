"""Proximal Policy Optimization (PPO), trained in a noisy environment and tested in a clean one.

The algorithm is Schulman et al. (2017), https://arxiv.org/abs/1707.06347, with the choices and
defaults of CleanRL's ppo_continuous_action.py. The noise is that of Khraishi and Okhrati (2023),
"Simple Noisy Environment Augmentation for Reinforcement Learning", https://arxiv.org/abs/2305.02882.

    python ppo_continuous_noisy.py --env-id HalfCheetah-v5 --seed 1
    python ppo_continuous_noisy.py --noise "RandomUniformScaleReward(0.5, 1.5)" --noise-rate 0.05

Writes config.json, eval.csv, TensorBoard events, policy.pt and result.json into a folder in runs/.
You can interrupt it at any time; run the same command again to resume.
"""

import contextlib
import fcntl
import functools
import io
import json
import math
import os
import signal
import sys
import time
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
from torch.func import functional_call, grad_and_value
from torch.utils._pytree import tree_leaves
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

import noisy_wrappers as noisy

TEST_SEED = 1_000_000  # seed of the first test episode, in every test of every run
STOPPING = signal.SIGTERM, signal.SIGINT, signal.SIGHUP  # a checkpoint, then the end
EVAL_FREQUENCY = 50_000  # default of --eval-frequency, or a tenth of the run if that is less


@dataclass
class Args:
    """Command-line arguments, CleanRL's and those of noise; --help shows their comments."""

    # RUN
    env_id: str = "HalfCheetah-v5"  # Gymnasium environment, Name-v0, or module:Name-v0
    seed: int = 1  # seed of everything that is random
    total_timesteps: int = 1_000_000  # environment steps, rounded down to whole rollouts
    env_kwargs: tuple[str, ...] = ()  # arguments of the environment, each as name:value
    max_episode_steps: int | None = None  # time limit of an episode; None: the environment's own
    exp_name: str = Path(__file__).stem  # name of the experiment, part of the run folder's name
    runs_dir: str = "runs"  # folder in which the run's own folder is made
    overwrite: bool = False  # delete the files in the run's folder and start again
    checkpoint_frequency: int = 50_000  # environment steps between two checkpoints

    # NOISE
    noise: tuple[str, ...] = ()  # noises of the training environment; none: a baseline
    noise_rate: tuple[float | str, ...] = ()  # probability, of all or each; 1:0 falls in training

    # TESTS
    test_noise: tuple[str, ...] = ()  # noises of the test environment; none by default
    test_noise_rate: tuple[float, ...] = ()  # probability of each test noise; 1 by default
    eval_episodes: int = 10  # episodes in each test
    eval_frequency: int | None = None  # steps between tests; None: 50,000 or less; 0: only the last
    keep_policies: bool = False  # keep the policy of every test as policy_STEP.pt

    # SPEED
    cuda: bool = False  # train on a GPU (not tested on one yet); these networks are small
    torch_threads: int = 1  # CPU threads; runs in parallel gain more than extra threads
    compile: bool = True  # compile the updates, if there is a C++ compiler
    # medium: other kernels, where they round no more than highest
    matmul_precision: Literal["highest", "medium"] = "highest"

    # ALGORITHM
    learning_rate: float = 3e-4  # learning rate of the optimizer
    num_steps: int = 2048  # environment steps in a rollout
    anneal_lr: bool = True  # lower the learning rate linearly to 0
    gamma: float = 0.99  # discount factor
    gae_lambda: float = 0.95  # lambda of the generalized advantage estimation
    num_minibatches: int = 32  # minibatches in an epoch
    update_epochs: int = 10  # epochs after each rollout
    norm_adv: bool = True  # normalize the advantages of each minibatch
    clip_coef: float = 0.2  # clipping of the probability ratio
    clip_vloss: bool = True  # clip the value loss, too
    ent_coef: float = 0.0  # coefficient of the entropy
    vf_coef: float = 0.5  # coefficient of the value loss
    max_grad_norm: float = 0.5  # gradients are clipped to this norm
    target_kl: float | None = None  # stop the epochs of a rollout above this KL divergence
    # bootstrap the value where a time limit ends an episode; CleanRL treats it as terminal
    bootstrap_truncated: bool = False


def make_env(env_id, **kwargs):
    """Make an environment of vectors, still without noise: make_environments() adds that."""
    env = gym.make(env_id, disable_env_checker=True, **kwargs)  # make_flat() checks every step
    return noisy.make_flat(env)


def mlp(inputs, outputs, std):
    """Two hidden layers of 64 tanh units; orthogonal weights, with gain `std` in the last layer."""
    layers = [nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)]
    for layer, gain in zip(layers, (math.sqrt(2), math.sqrt(2), std), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


class Agent(nn.Module):
    """The Gaussian policy and the value function of normalized observations (B, O)."""

    def __init__(self, env):
        super().__init__()
        inputs, outputs = env.observation_space.shape[0], env.action_space.shape[0]
        self.critic = mlp(inputs, 1, std=1.0)
        self.actor_mean = mlp(inputs, outputs, std=0.01)
        self.actor_logstd = nn.Parameter(torch.zeros(outputs))

    def forward(self, observations, actions):
        """Return the actions' log-probabilities (B,), the entropy () and the values (B,)."""
        z = (actions - self.actor_mean(observations)) / self.actor_logstd.exp()
        log_prob = (-0.5 * z.square() - self.actor_logstd - 0.5 * math.log(2 * math.pi)).sum(1)
        entropy = (self.actor_logstd + 0.5 + 0.5 * math.log(2 * math.pi)).sum()
        return log_prob, entropy, self.critic(observations).squeeze(1)


class Saved:
    """Base class: state_dict() holds every attribute, numbers and arrays."""

    def state_dict(self):
        """Return the attributes by name."""
        return vars(self).copy()

    def load_state_dict(self, state):
        """Set the attributes."""
        vars(self).update(state)


class Normalizer(Saved):
    """Running mean and variance, as in Gymnasium's NormalizeObservation and NormalizeReward."""

    def __init__(self, mean, var):
        self.mean, self.var, self.count = mean, var, 1e-4

    def update(self, x):
        """Take one observation or return into account, as a batch of one in Gymnasium."""
        delta, total = x - self.mean, self.count + 1
        self.mean += delta / total
        self.var += (delta * delta * (self.count / total) - self.var) / total
        self.count = total

    def normalize(self, observation):
        """Return the distance from the mean in standard deviations, at most 10 of them."""
        scaled = (observation - self.mean) / np.sqrt(self.var + 1e-8)
        return scaled.clip(-10, 10).astype(np.float32)


class Rollout(Saved):
    """T steps, and the observation after them."""

    def __init__(self, steps, env):
        self.observations = np.zeros((steps + 1, *env.observation_space.shape), np.float32)
        self.eps = np.zeros((steps, *env.action_space.shape), np.float32)  # the policy's noise
        self.actions = np.zeros_like(self.eps)
        self.rewards = np.zeros(steps, np.float32)
        self.dones = np.zeros(steps, np.float32)  # terminated or truncated
        self.discounted_return = 0.0  # it goes on in the next rollout


def compute_gae(rewards, values, dones, args):
    """Generalized advantage estimation: A_t = delta_t + gamma lambda (1 - done_t) A_(t+1).

    delta_t = r_t + gamma (1 - done_t) V_(t+1) - V_t. Rewards and dones (T,), values (T + 1,).
    """
    rewards, values, dones = (x.tolist() for x in (rewards, values, dones))  # faster than arrays
    advantages, advantage = [0.0] * len(rewards), 0.0
    for t in reversed(range(len(rewards))):
        discount = args.gamma * (1 - dones[t])
        delta = rewards[t] + discount * values[t + 1] - values[t]
        advantages[t] = advantage = delta + discount * args.gae_lambda * advantage
    return torch.tensor(advantages)


def ppo_loss(agent, minibatch, args):
    """Clipped surrogate, clipped value loss and entropy; updater() learns the first argument."""
    observations, actions, old_log_probs, advantages, returns, old_values = minibatch
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    log_probs, entropy, values = agent(observations, actions)
    log_ratio = log_probs - old_log_probs
    ratio = log_ratio.exp()
    clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = torch.maximum(-advantages * ratio, -advantages * clipped_ratio).mean()
    squared_error = (values - returns).square()
    if args.clip_vloss:
        clipped_change = (values - old_values).clamp(-args.clip_coef, args.clip_coef)
        clipped_error = (old_values + clipped_change - returns).square()
        squared_error = torch.maximum(squared_error, clipped_error)
    value_loss = 0.5 * squared_error.mean()
    curves = {"value_loss": value_loss, "policy_loss": policy_loss, "entropy": entropy}
    # http://joschu.net/blog/kl-approx.html
    curves |= {"old_approx_kl": -log_ratio.mean(), "approx_kl": (ratio - 1 - log_ratio).mean()}
    curves["clipfrac"] = ((ratio - 1).abs() > args.clip_coef).float().mean()
    return policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss, curves


@torch.no_grad()  # only the functions that updater() returns compute gradients
def learn(args, env, test_env, stop):
    """Train in the noisy `env` and test in `test_env`; return False if stop() ended it early."""
    # a minibatch needs two steps at least, for the standard deviation of its advantages
    if not 2 * args.num_minibatches <= args.num_steps <= args.total_timesteps:
        fail("--num-steps must be from 2 * --num-minibatches to --total-timesteps")
    device = torch.device("cuda" if args.cuda else "cpu")
    run = Run(args, env)
    if run.is_finished:
        return True

    # SETUP
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)  # an environment may draw from it
    observation, _ = env.reset(seed=args.seed)
    total_steps = args.total_timesteps // args.num_steps * args.num_steps  # of whole rollouts
    rollout = Rollout(args.num_steps, env)
    observation_stats = Normalizer(np.zeros(observation.shape), np.ones(observation.shape))
    return_stats = Normalizer(0.0, 1.0)
    agent = Agent(env).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    learning_rates = [group["lr"] for group in optimizer.param_groups]
    update = updater(ppo_loss, agent, optimizer, args)

    # RESUME: all that training changes belongs in `state`. What is missing there starts anew when a
    # run is resumed: tools/check_script.py finds it. Random numbers are drawn on the CPU, because
    # the generator of a GPU is not saved.
    state = {"agent": agent, "optimizer": optimizer, "rollout": rollout}
    state |= {"observation_stats": observation_stats, "return_stats": return_stats}
    start = run.resume(state | {"env": noisy.EnvState(env, rng)})
    if start > 0:  # the checkpoint was written between two episodes
        noisy.set_progress(env, start / total_steps)  # for rates that change
        observation, _ = env.reset()

    observation_stats.update(observation)
    # one loop over steps and not two, over rollouts and steps: a run may resume within a rollout
    for global_step in range(start + 1, total_steps + 1):
        step = (global_step - 1) % args.num_steps
        if step == 0:
            rollout.eps[:] = torch.randn(rollout.eps.shape)
        if step == 0 or global_step == start + 1:  # there is a new policy
            act, std = in_numpy(agent.actor_mean, device), agent.actor_logstd.exp().cpu().numpy()

        # ACT: log-probabilities and values are computed later, for whole rollouts
        rollout.observations[step] = observation_stats.normalize(observation)
        rollout.actions[step] = act(rollout.observations[step]) + std * rollout.eps[step]

        # STEP
        action = noisy.into_space(rollout.actions[step], env.action_space)  # clipped
        observation, reward, terminated, truncated, info = env.step(action)
        observation_stats.update(observation)

        # STORE: rewards in standard deviations of the discounted return, at most 10 of them. As in
        # Gymnasium, that drops the past at the last step of an episode, not after it.
        rollout.discounted_return *= args.gamma * (1 - terminated)
        rollout.discounted_return += reward
        return_stats.update(rollout.discounted_return)
        scaled = reward / math.sqrt(return_stats.var + 1e-8)
        rollout.rewards[step] = max(min(scaled, 10.0), -10.0)  # in this order NaN stays
        rollout.dones[step] = terminated or truncated
        if args.bootstrap_truncated and truncated and not terminated:
            value = in_numpy(agent.critic, device)(observation_stats.normalize(observation))
            rollout.rewards[step] += args.gamma * value[0]

        is_last = global_step == total_steps
        if step == args.num_steps - 1:
            # LEARN: advantages
            rollout.observations[-1] = observation_stats.normalize(observation)
            observations = torch.from_numpy(rollout.observations).to(device)
            actions = torch.from_numpy(rollout.actions).to(device)
            log_probs, _, values = agent(observations[:-1], actions)
            check_agent(agent, observations, log_probs, values, rollout, std)
            all_values = torch.cat([values, agent.critic(observations[-1])])
            advantages = compute_gae(rollout.rewards, all_values, rollout.dones, args).to(device)
            returns = advantages + values

            # LEARN: policy and value function
            if args.anneal_lr:
                left = 1 - (global_step - args.num_steps) / total_steps
                for group, rate in zip(optimizer.param_groups, learning_rates, strict=True):
                    group["lr"] = left * rate
            batch = (observations[:-1], actions, log_probs, advantages, returns, values)
            clipfracs = []
            for _ in range(args.update_epochs):
                # shuffle the whole rollout, which takes less time than picking each minibatch
                order = torch.from_numpy(rng.permutation(args.num_steps)).to(device)
                shuffled = [tensor[order].tensor_split(args.num_minibatches) for tensor in batch]
                for minibatch in zip(*shuffled, strict=True):
                    curves = update(minibatch, args)  # the inputs of ppo_loss()
                    clipfracs.append(curves["clipfrac"])
                if args.target_kl is not None and curves["approx_kl"] > args.target_kl:
                    break

            curves["clipfrac"] = torch.stack(clipfracs).mean()
            curves["explained_variance"] = 1 - (returns - values).var() / returns.var().clamp(1e-8)
            charts = {"learning_rate": optimizer.param_groups[0]["lr"]}
            run.log(global_step, charts=charts, losses=curves, noise=noisy.noise_statistics(env))

            # TEST: if it was due in this rollout, at the step that eval.csv has
            frequency = args.eval_frequency or args.total_timesteps
            due = args.total_timesteps if is_last else global_step // frequency * frequency
            if due > global_step - args.num_steps:
                policy = make_policy(agent, observation_stats, env)
                results = noisy.play(test_env, policy, args.eval_episodes, TEST_SEED)
                saved = {"agent": agent.state_dict()}
                saved["observation_stats"] = observation_stats.state_dict()
                run.log_test(global_step, results, saved, due)

        # NEXT EPISODE
        if terminated or truncated:
            run.log_episode(global_step, info)
            if is_last:  # no checkpoint: nothing is left to resume
                break
            stopping = stop()
            if stopping or global_step - run.saved_step >= args.checkpoint_frequency:
                run.save(global_step)
            if stopping:
                return False
            noisy.set_progress(env, global_step / total_steps)
            observation, _ = env.reset()
            observation_stats.update(observation)

    run.finish(global_step)
    return True


def check_agent(agent, observations, log_probs, values, rollout, std):
    """Exit where forward() is not what acts in learn(), or what bootstraps, by critic()."""
    value = agent.critic(observations[0])
    if value.shape != (1,) or (value - values[0]).abs() > 1e-3 * (1 + value.abs()):
        fail("the agent learns other values than those of critic(), which bootstraps", 1)
    # the density of the normal, where (x - mean) / std is eps
    expected = (-0.5 * rollout.eps**2 - np.log(std) - 0.5 * math.log(2 * math.pi)).sum(1)
    rounding = 1e-3 * (1 + np.abs(rollout.actions / std).sum(1))
    if (np.abs(log_probs.cpu().numpy() - expected) > rounding).any():
        fail("the agent acts with one policy and learns another: see ACT and forward()", 1)


def make_policy(agent, observation_stats, env):
    """Return the test policy, NumPy to NumPy: mean actions; it leaves observation_stats as is."""
    act = in_numpy(agent.actor_mean, agent.actor_logstd.device)
    normalize = observation_stats.normalize
    return lambda observation: noisy.into_space(act(normalize(observation)), env.action_space)


def load_policy(run_dir, env=None):
    """Return the policy of a run's last test; `env` is for runs of this project's version 0.3."""
    config = json.loads(Path(run_dir, "config.json").read_text())
    env = env or noisy.Spaces(config)
    agent, observation_stats = Agent(env), Normalizer(0.0, 1.0)
    saved = read_state(Path(run_dir, "policy.pt"))
    agent.load_state_dict(saved["agent"])
    # version 0.3 saved tensors
    stats = {name: np.asarray(value) for name, value in saved["observation_stats"].items()}
    observation_stats.load_state_dict(stats)
    return make_policy(agent, observation_stats, env)


def updater(loss, network, optimizer, args):
    """Return update(*inputs) -> curves: one step of the optimizer on loss(network, *inputs).

    Numbers among the inputs may change from one update to the next. The optimizer may be any whose
    step() needs no closure.
    """
    # Loss and gradient in one compiled graph are faster than backward(). functional_call() swaps
    # the parameters of a module while its forward() runs: here that is the loss.
    module = nn.ModuleList([network])
    module.forward = functools.partial(loss, network)
    parameters = dict(module.named_parameters())
    own = set(map(id, parameters.values()))
    groups = getattr(optimizer, "param_groups", [])
    if any(id(p) not in own for group in groups for p in group["params"]):
        fail("an optimizer also steps tensors that its update does not learn: leave them out", 1)
    layers = [x for _, x in module.named_modules(remove_duplicate=False) if x._parameters]
    is_shared = len(set(layers)) < len(layers)  # a layer at two places must be swapped once
    call = functools.partial(functional_call, module, tie_weights=not is_shared)

    def clipped_gradient(learned, inputs):
        gradient, (_, curves) = grad_and_value(call, has_aux=True)(learned, inputs)
        norm = torch.stack([value.norm() for value in gradient.values()]).norm()
        scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)  # as clip_grad_norm_()
        return {name: value * scale for name, value in gradient.items()}, curves

    gradient_of = compiled(clipped_gradient) if args.compile else clipped_gradient

    def update(*inputs):
        learned = {name: p for name, p in parameters.items() if p.requires_grad}  # not frozen
        # a compiled graph takes a Python number as a constant, and is compiled again for another
        numbers = (int, float, np.float32, np.float64, np.int32, np.int64)  # bools stay: `if flag`
        inputs = [torch.tensor(float(x)) if type(x) in numbers else x for x in inputs]
        gradient, curves = gradient_of(learned, tuple(inputs))
        for name, parameter in parameters.items():
            value = gradient.get(name)  # None: frozen
            # the fused Adam of PyTorch 2.13 silently misreads gradients of another memory layout
            if value is not None and value.stride() != parameter.stride():
                value = torch.empty_like(parameter).copy_(value)
            parameter.grad = value
        optimizer.step()
        return curves

    return update


def in_numpy(network, device):
    """Return a network as a function of one observation, NumPy to NumPy.

    A Sequential of Linear, Tanh and ReLU is computed in NumPy, several times faster than in
    PyTorch; anything else, also a method, is called as it is. Call this again after an update.
    """
    layers = [*network] if type(network) is nn.Sequential else [network]
    is_plain = {type(x) for x in layers} <= {nn.Linear, nn.Tanh, nn.ReLU}
    if not is_plain or any(x._forward_hooks or x._forward_pre_hooks for x in network.modules()):
        return lambda x: network(torch.from_numpy(x).to(device)).numpy(force=True)
    arrays = [{name: p.numpy(force=True) for name, p in x.named_parameters()} for x in layers]

    def call(x):
        for layer, array in zip(layers, arrays, strict=True):
            if isinstance(layer, nn.Linear):
                x = array["weight"] @ x + array.get("bias", 0.0)
            else:
                x = np.tanh(x) if isinstance(layer, nn.Tanh) else np.maximum(x, 0)
        return x

    return call


# THE RUN: environments, folder, signals. The same text in three scripts; you may change yours.


def fail(message, code=2):
    """Exit after a line that says what is wrong; code 2: in the arguments, 1: elsewhere."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(code)


@contextlib.contextmanager
def fail_on(errors, message, code=2):
    """Turn these errors into one line: the message, and what the error says."""
    try:
        yield
    except errors as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        fail(f"{message}: {reason}", code)


def say(text):
    """Print a line; training goes on if nobody reads it any more, as in `... | head`."""
    try:
        print(text, flush=True)
    except OSError:  # from here on, print to nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def compiled(function):
    """Compile a function as one graph; where that fails, say why and go on without."""
    graph = torch.compile(function, fullgraph=True, dynamic=False, isolate_recompiles=True)

    def call(*inputs):
        nonlocal graph
        # any call may compile, for other sizes: Ctrl-C would reach the compiler, too, and end it
        allowed = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
        try:
            return graph(*inputs)
        except torch._dynamo.exc.FailOnRecompileLimitHit:
            fail("a size, or a number read from args, changes too often: pass it to the update", 1)
        # an AssertionError where a loss reads a number of NumPy
        except (torch._dynamo.exc.TorchDynamoException, AssertionError) as error:
            cache = torch._inductor.runtime.cache_dir_utils.cache_dir()
            reason = " ".join(str(error).split())[:200]
            say(f"not compiled, so it is slower: {reason} (the compiler's cache is {cache})")
            graph = function
            return function(*inputs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, allowed)

    return call


def train(args, stop=lambda: 0):
    """Train one agent and close its environments; return False if stop() ended it early."""
    if args.cuda and not torch.cuda.is_available():
        fail("--cuda: PyTorch finds no GPU; leave it out to run on the CPU")
    try:
        args = replace(args, **noisy.canonical_arguments(asdict(args)))  # checks them, too
    except ValueError as error:
        fail(error)
    if args.eval_frequency is None:
        args.eval_frequency = max(1, min(EVAL_FREQUENCY, args.total_timesteps // 10))
    torch.compiler.reset()  # forget what earlier runs of this process compiled
    torch.set_num_threads(args.torch_threads)
    processor = torch.cpu.get_capabilities()
    has_bf16 = any(processor.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16"))
    if args.matmul_precision == "bf16" and not (has_bf16 or args.cuda):
        fail("--matmul-precision bf16: this processor has no bfloat16, so it would be slower")
    # "medium" would round to bfloat16 with AMX or on ARM, and to TF32 on a GPU
    would_round = args.cuda or processor.get("amx_tile") or processor.get("bf16")
    is_medium = args.matmul_precision == "medium" and not would_round
    torch.set_float32_matmul_precision("medium" if is_medium else "highest")
    with fail_on((gym.error.Error, noisy.SpaceError), f"--env-id {args.env_id}"):
        env, test_env = noisy.make_environments(make_env, asdict(args), TEST_SEED)  # adds noise
    with env, test_env:  # they are closed at the end
        return learn(args, env, test_env, stop)


class Run:
    """The run's folder: what is written into it, and read again to resume."""

    def __init__(self, args, env):
        """Open the folder; exit if another process uses it, or if it holds a different run."""
        self.args, self.env = args, env
        self.folder = Path(args.runs_dir, noisy.run_name(asdict(args)))
        if self.folder.is_symlink():  # --overwrite would delete what is elsewhere
            fail(f"{self.folder} is a link: remove it, or use another --exp-name or --runs-dir", 1)
        with fail_on(OSError, f"--runs-dir {args.runs_dir}"):
            self.folder.mkdir(parents=True, exist_ok=True)
            self.lock = (self.folder / ".lock").open("a")
        with fail_on(BlockingIOError, f"another process trains in {self.folder}: wait for it", 1):
            fcntl.lockf(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # as long as it is open
        if args.overwrite:  # in this order: without result.json a run is not finished
            self._delete("result.json", "checkpoint.pt", "policy.pt", "policy_*.pt", "eval.csv")
            self._delete("config.json", "robustness.csv", "robustness.csv.gz")
            self._delete("events.out.tfevents.*")
        new = noisy.describe_run(__file__, asdict(args), asdict(Args()), env)
        new["versions"]["torch"] = torch.__version__
        new["matmul_precision"] = torch.get_float32_matmul_precision()
        config = self.folder / "config.json"
        with fail_on(ValueError, str(self.folder)):
            old = json.loads(config.read_text()) if config.exists() else new
            self.config = noisy.resumed_run(old, new)  # ValueError: a run with other arguments
        if self.config["script_sha256"] != new["script_sha256"]:
            say("the script has changed since the run began; if it matters, use --exp-name")
        self.is_finished = (self.folder / "result.json").exists()
        begun = "training (the first updates wait for the compiler)" if args.compile else "training"
        say(f"{self.folder} is finished" if self.is_finished else f"{begun}: {self.folder}")

    def resume(self, state):
        """Restore {name: part with state_dict()} from a checkpoint; return its step, or 0."""
        self.state = state
        self.eval_csv = "step,episode,episodic_return,episodic_length,success\n"  # all of the file
        step, processor_seconds = 0, 0.0
        path = self.folder / "checkpoint.pt"
        if path.exists():
            with fail_on(Exception, f"cannot read {path} (delete it, or use --overwrite)", 1):
                if zipfile.ZipFile(path).testzip():  # torch.load checks no checksums
                    raise ValueError("it is damaged")
                checkpoint = read_state(path)
                if checkpoint["state"].keys() != state.keys():
                    raise ValueError(f"it holds {[*checkpoint['state']]}, not {[*state]}")
                for name, part in state.items():
                    part.load_state_dict(checkpoint["state"][name])
            torch.set_rng_state(checkpoint["torch"])
            step, self.eval_csv = checkpoint["step"], checkpoint["eval_csv"]
            processor_seconds = checkpoint["processor_seconds"]
            say(f"resumed at step {step}")
        else:
            self._delete("events.out.tfevents.*")  # of a process killed before its first checkpoint
            for name, part in state.items():  # fail now, and not when the run is resumed
                message = f"{name!r} needs a state_dict() of tensors, arrays, numbers"
                with fail_on(Exception, message):
                    file = io.BytesIO()
                    torch.save(part.state_dict(), file)
                    read_state(io.BytesIO(file.getvalue()))
        self._state_dicts()
        self._write("config.json", json.dumps(self.config, indent=2) + "\n")
        self._write("eval.csv", self.eval_csv)
        # TensorBoard drops what was logged after the checkpoint
        self.writer = SummaryWriter(str(self.folder), purge_step=step + 1)
        if step == 0:
            self._log_hyperparameters()
        total = self.args.total_timesteps
        # disable=None: a bar on a terminal alone
        self.bar = tqdm(total=total, initial=step, file=sys.stdout, disable=None, smoothing=0)
        self.first_step = self.saved_step = step
        self.last_test, self.begun, self.printed = "", time.monotonic(), -math.inf
        self.processor_begun = time.process_time() - processor_seconds
        return step

    def _log_hyperparameters(self):
        """Log all arguments as a table and for HPARAMS (add_hparams() would make a subfolder)."""
        args = {name: str(value) for name, value in asdict(self.args).items()}
        table = "".join(f"|{name}|{value}|\n" for name, value in args.items())
        self.writer.add_text("hyperparameters", "|param|value|\n|-|-|\n" + table)
        metrics = ["eval/episodic_return_mean", "charts/episodic_return", "eval/success_rate"]
        for summary in hparams(args, dict.fromkeys(metrics, 0)):
            self.writer.file_writer.add_summary(summary)

    def _state_dicts(self):
        """Return those of all parts; they hold each tensor that an optimizer steps."""
        states = {name: part.state_dict() for name, part in self.state.items()}
        saved = {x.data_ptr() for x in tree_leaves(states) if torch.is_tensor(x)}
        groups = [group for x in self.state.values() for group in getattr(x, "param_groups", [])]
        if any(p.data_ptr() not in saved for group in groups for p in group["params"]):
            fail("`state` lacks a tensor that an optimizer steps (was a layer replaced?)", 1)
        return states

    def save(self, step):
        """Write a checkpoint: all that resuming needs, between two episodes."""
        self.writer.flush()  # so that the curves reach as far as the checkpoint
        checkpoint = {
            "step": step,
            "state": self._state_dicts(),
            "torch": torch.get_rng_state(),
            "eval_csv": self.eval_csv,
            "processor_seconds": time.process_time() - self.processor_begun,
        }
        self._write("checkpoint.pt", checkpoint)
        self.saved_step = step

    def log(self, step, **groups):
        """Log numbers as group/name to TensorBoard, and the speed; show the progress."""
        now = time.monotonic()
        speed = (step - self.first_step) / (now - self.begun)
        tags = {"charts/SPS": speed}
        for group, values in groups.items():
            tags |= {f"{group}/{name}": float(value) for name, value in values.items()}
        if not all(map(math.isfinite, tags.values())):
            raise noisy.NotFiniteError(f"step {step}: training diverged: {tags}")
        for tag, value in tags.items():
            self.writer.add_scalar(tag, value, step)
        self._show_progress(step, speed, now)

    def _show_progress(self, step, speed, now):
        """Move the bar of a terminal; elsewhere print a line after ten seconds, or after a test."""
        self.bar.update(step - self.bar.n)
        if self.bar.disable and now - self.printed > 10:
            # analysis/logs.py reads this line
            say(f"step={step}/{self.bar.total} sps={speed:.0f} {self.last_test}")
            self.printed = now

    def log_episode(self, step, info):
        """Log a training episode by the info of its last step; its return has no reward noise."""
        charts = {"episodic_return": info["episode"]["r"], "episodic_length": info["episode"]["l"]}
        self.log(step, charts=charts | noisy.success_rate([noisy.outcome(info)]))

    def log_test(self, step, results, policy, due=None):
        """Log the (N, 3) returns, lengths and outcomes of a test, and save the policy."""
        due = due or step  # the step in eval.csv: PPO tests after whole rollouts
        for episode, (episodic_return, length, outcome) in enumerate(results.tolist()):
            success = "" if math.isnan(outcome) else int(outcome)
            self.eval_csv += f"{due},{episode},{episodic_return},{length:.0f},{success}\n"
        if self.args.keep_policies:
            self._write(f"policy_{due}.pt", policy | {"step": step})
        self._write("policy.pt", policy | {"step": step})
        self._write("eval.csv", self.eval_csv)
        mean, length, _ = results.mean(0)
        std = results[:, 0].std(ddof=1) if len(results) > 1 else 0.0
        success = noisy.success_rate(results[:, 2])
        self.result = {"final_return_mean": mean, "final_return_std": std}
        self.result |= {f"final_{name}": rate for name, rate in success.items()}
        self.last_test, self.printed = f"eval_return={mean:.2f}", -math.inf  # print a line now
        self.bar.set_description_str(self.last_test)
        test = {"episodic_return_mean": mean, "episodic_return_std": std}
        self.log(step, eval=test | {"episodic_length_mean": length} | success)

    def finish(self, step):
        """Write result.json, last of all, and delete the checkpoint."""
        self.writer.close()
        self.bar.close()
        noises = noisy.noise_wrappers(self.env).items()
        returns = self.env.get_wrapper_attr("return_queue")  # of the last 100 training episodes
        self.result |= {
            "trained_timesteps": step,  # PPO: whole rollouts
            "train_return_mean_last_100": np.mean(returns) if returns else None,
            "processor_seconds": time.process_time() - self.processor_begun,
            "noise_applied": {name: [w.times_applied, w.opportunities] for name, w in noises},
        }
        self._write("result.json", json.dumps(self.result, indent=2) + "\n")
        self._delete("checkpoint.pt")
        say(f"{self.folder} is finished after {step} steps: {self.last_test}")

    def _delete(self, *patterns):
        for pattern in patterns:
            for path in {*self.folder.glob(pattern), *self.folder.glob(f"{pattern}.tmp")}:
                path.unlink()

    def _write(self, name, content):
        # whole or not at all: a kill or a full disk leaves the previous file
        temporary = self.folder / f"{name}.tmp"
        with open(temporary, "wb") as file:
            if isinstance(content, str):
                file.write(content.encode())
            else:
                torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / name)


def read_state(file):
    """Read a checkpoint that may hold tensors, arrays and numbers of NumPy, but never code."""
    multiarray = np._core.multiarray
    types = [np.ndarray, np.dtype, bytes, multiarray._reconstruct, multiarray.scalar]
    types += {type(np.dtype(code)) for code in np.typecodes["All"]}
    with torch.serialization.safe_globals(types):
        return torch.load(file, "cpu", weights_only=True)  # also what was saved on a GPU


def stop_at_signals():
    """Keep signals until an episode ends: return stop() -> the number of the first, or 0."""
    received, script_pid = [], os.getpid()

    def remember(number, frame):
        received.append(number)
        # Ctrl-C also reaches processes that the environment forked; the last episode needs them
        is_worker = os.getpid() != script_pid
        is_second_ctrl_c = number == signal.SIGINT and len(received) > 1
        if is_second_ctrl_c or (is_worker and number != signal.SIGINT):
            os._exit(128 + number)
        if not is_worker:
            with contextlib.suppress(OSError):  # print() is not safe in here
                os.write(1, b"stopping after this episode; Ctrl-C again: at once, without saving\n")

    for number in STOPPING:
        if signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, remember)
    return lambda: received[0] if received else 0


if __name__ == "__main__":
    import tyro  # here, because load_policy() does not need it

    stop = stop_at_signals()
    sys.path.append(os.getcwd())  # so that the module of --env-id module:Name-v0 can import
    noises = "\n  ".join(["Noises:", *noisy.signatures()])
    args = tyro.cli(Args, description=f"{__doc__}\n{noises}")
    with fail_on((noisy.NotFiniteError, noisy.SpaceError), "training stopped", code=1):
        if not train(args, stop):
            say("stopped; run the same command again to resume")
            raise SystemExit(128 + stop())
