"""Proximal Policy Optimization (PPO), trained in a noisy environment and tested in a clean one.

The algorithm is Schulman et al. (2017), https://arxiv.org/abs/1707.06347, with the choices and
defaults of CleanRL's ppo_continuous_action.py. The noise is that of Khraishi and Okhrati (2023),
"Simple Noisy Environment Augmentation for Reinforcement Learning", https://arxiv.org/abs/2305.02882.

    python ppo_continuous_noisy.py --env-id HalfCheetah-v5 --seed 1
    python ppo_continuous_noisy.py --noise "RandomUniformScaleReward(0.5, 1.5)" --noise-rate 0.05

Writes runs/{env_id}__{exp_name}__{noise}__{seed}/: config.json, eval.csv, TensorBoard events, and
policy.pt and result.json when done. The same command again resumes from checkpoint.pt.
"""

import contextlib
import fcntl
import functools
import json
import math
import os
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Literal

import gymnasium as gym
import mujoco
import numpy as np
import torch
import torch.nn as nn
import tyro
from torch.func import functional_call, grad_and_value
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

from noisy_wrappers import canonical_noises, make_noisy, noise_wrappers, run_name

TEST_SEED = 1_000_000  # of the first test episode; the same in every run and evaluation


@dataclass
class Args:
    """Command-line arguments; the algorithm's are CleanRL's and the paper's (Appendix A.2)."""

    exp_name: str = Path(__file__).stem
    """the name of this experiment, part of the run folder's name"""
    seed: int = 1
    """seed of the experiment"""
    env_id: str = "HalfCheetah-v5"
    """the Gymnasium environment: Box observations, Box actions"""
    noise: tuple[str, ...] = ()
    """noise of the training environment in the paper's notation, one or several; none: baseline"""
    noise_rate: tuple[float, ...] = ()
    """probability p of each noise: one for all of them, or one for each"""
    runs_dir: str = "runs"
    """the folder that holds the run folders"""
    overwrite: bool = False
    """delete what the run folder holds and start afresh"""

    total_timesteps: int = 1_000_000
    """environment steps to train for, rounded down to whole rollouts"""
    eval_frequency: int = 50_000
    """steps between two evaluations in the clean test environment, each after the next rollout
    (0: only after training)"""
    eval_episodes: int = 10
    """test episodes per evaluation"""
    checkpoint_frequency: int = 50_000
    """steps between two checkpoints, each at the next end of an episode"""

    cuda: bool = False
    """run the networks on the GPU; for networks as small as these, the CPU is a good choice"""
    torch_threads: int = 1
    """CPU threads per run; a sweep gains more from several runs side by side"""
    compile: bool = True
    """compile the updates when learning starts, where a C++ compiler is at hand"""
    matmul_precision: Literal["highest", "high", "medium"] = "highest"
    """PyTorch's precision of float32 products, raised to highest where accuracy is lost"""

    learning_rate: float = 3e-4
    """learning rate of the optimizer"""
    num_steps: int = 2048
    """steps per rollout"""
    anneal_lr: bool = True
    """lower the learning rate linearly to 0"""
    gamma: float = 0.99
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of the generalized advantage estimation"""
    num_minibatches: int = 32
    """minibatches per epoch"""
    update_epochs: int = 10
    """epochs per rollout"""
    norm_adv: bool = True
    """normalize the advantages of each minibatch"""
    clip_coef: float = 0.2
    """clipping of the probability ratio"""
    clip_vloss: bool = True
    """clip the value loss too"""
    ent_coef: float = 0.0
    """coefficient of the entropy"""
    vf_coef: float = 0.5
    """coefficient of the value loss"""
    max_grad_norm: float = 0.5
    """largest norm of the gradient"""
    target_kl: float | None = None
    """stop a rollout's epochs at this KL divergence"""
    bootstrap_truncated: bool = False
    """bootstrap the value where a time limit ends an episode; CleanRL takes it for a terminal"""


def fail(message, code=2):
    """Exit with one line that says what to do."""
    print("error:", " ".join(str(message).split()), file=sys.stderr, flush=True)
    raise SystemExit(code)


def check(args, ranges):
    """Return the arguments with their noise in canonical notation, or fail.

    ranges: {(low, high): "the names of the arguments that must be from low to high"}
    """
    for (low, high), names in ranges.items():
        for name in names.split():
            if not low <= (value := getattr(args, name)) <= high:
                fail(f"--{name.replace('_', '-')} must be from {low} to {high:g}, not {value}")
    if args.cuda and not torch.cuda.is_available():
        fail("--cuda: PyTorch finds no GPU; leave it out to run on the CPU")
    try:
        noise, noise_rate = canonical_noises(args.noise, args.noise_rate)
    except ValueError as error:
        fail(error)
    return replace(args, noise=noise, noise_rate=noise_rate)


def make_env(env_id, **kwargs):
    """Make the clean environment; training adds its noise on top."""
    try:
        env = gym.make(env_id, disable_env_checker=True, **kwargs)
    except Exception as error:  # an environment's constructor may raise anything
        fail(f"--env-id {env_id}: {error}")
    spaces = ("observation", env.observation_space, "fiu"), ("action", env.action_space, "f")
    for name, space, kinds in spaces:
        if not isinstance(space, gym.spaces.Box) or space.dtype.kind not in kinds:
            fail(f"--env-id {env_id}: take one whose {name} space is a Box of floats, not {space}")
    if len(env.action_space.shape) != 1:
        fail(f"--env-id {env_id}: actions must be one-dimensional, not {env.action_space}")
    flat = len(env.observation_space.shape) == 1
    return env if flat else gym.wrappers.FlattenObservation(env)


def mlp(inputs, outputs, std):
    """Two hidden layers of 64 tanh units, with orthogonal weights; the last of scale `std`."""
    layers = [nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)]
    for layer, gain in zip(layers, (math.sqrt(2), math.sqrt(2), std), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


def in_numpy(network):
    """Return an mlp as a NumPy function of one observation, several times faster than PyTorch."""
    w1, b1, w2, b2, w3, b3 = (parameter.cpu().numpy() for parameter in network.parameters())
    return lambda x: w3 @ np.tanh(w2 @ np.tanh(w1 @ x + b1) + b2) + b3


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


class State:
    """NumPy arrays and numbers as attributes, with a state_dict."""

    def state_dict(self):
        """Return the attributes as tensors."""
        return {name: torch.as_tensor(value) for name, value in vars(self).items()}

    def load_state_dict(self, state):
        """Restore a state_dict."""
        vars(self).update({name: tensor.numpy()[()] for name, tensor in state.items()})


class Normalizer(State):
    """Running mean and variance of the samples so far, as in Gymnasium's Normalize wrappers."""

    def __init__(self, shape):
        # [()] makes a number of an array without dimensions, which is faster
        self.mean, self.var = np.zeros(shape)[()], np.ones(shape)[()]
        self.count = np.float64(1e-4)

    def update(self, sample):
        """Take one sample into account."""
        delta, total = sample - self.mean, self.count + 1
        self.mean += delta / total
        self.var += (delta * delta * (self.count / total) - self.var) / total
        self.count = total

    def scale(self, x):
        """Return x in standard deviations, at most 10 of them."""
        return (x / np.sqrt(self.var + 1e-8)).clip(-10, 10).astype(np.float32)

    def normalize(self, x):
        """Return the distance of x from the mean, scaled."""
        return self.scale(x - self.mean)


class Rollout(State):
    """T steps, and the observation after them."""

    def __init__(self, steps, env):
        self.observations = np.zeros((steps + 1, *env.observation_space.shape), np.float32)
        self.noise = np.zeros((steps, *env.action_space.shape), np.float32)
        self.actions = np.zeros_like(self.noise)
        self.rewards, self.dones = np.zeros((2, steps), np.float32)  # done: the episode ended
        self.discounted_return = np.float64(0)


def make_policy(agent, observation_stats, env):
    """Return the test policy, NumPy to NumPy: mean actions, observation statistics as they are."""
    act, low, high = in_numpy(agent.actor_mean), env.action_space.low, env.action_space.high
    return lambda observation: act(observation_stats.normalize(observation)).clip(low, high)


def load_policy(run_dir, env):
    """Return the policy of a finished run."""
    saved = torch.load(Path(run_dir, "policy.pt"), "cpu", weights_only=True)
    agent, observation_stats = Agent(env), Normalizer(env.observation_space.shape)
    agent.load_state_dict(saved["agent"])
    observation_stats.load_state_dict(saved["observation_stats"])
    return make_policy(agent.requires_grad_(False), observation_stats, env)


def compute_gae(rewards, values, dones, gamma, gae_lambda):
    """Generalized advantage estimation: A_t = delta_t + gamma lambda (1 - done_t) A_(t+1).

    delta_t = r_t + gamma (1 - done_t) V_(t+1) - V_t. Rewards and dones (T,), values (T + 1,).
    """
    rewards, values, dones = (x.tolist() for x in (rewards, values, dones))
    advantages, advantage = [0.0] * len(rewards), 0.0
    for t in reversed(range(len(rewards))):
        discount = gamma * (1 - dones[t])
        delta = rewards[t] + discount * values[t + 1] - values[t]
        advantages[t] = advantage = delta + discount * gae_lambda * advantage
    return torch.tensor(advantages)


# UPDATE: a pure function of the agent and a minibatch. It returns a gradient, named like the
# agent's parameters, and curves; compiled and plain runs share it.


def ppo_gradient(agent, batch, args):
    """Clipped surrogate, clipped value loss and entropy; the gradient's norm is clipped too."""
    observations, actions, old_log_probs, advantages, returns, old_values = batch
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

    def loss(params):
        log_probs, entropy, values = functional_call(agent, params, (observations, actions))
        log_ratio = log_probs - old_log_probs
        ratio = log_ratio.exp()
        clipped_ratio = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
        policy_loss = torch.maximum(-advantages * ratio, -advantages * clipped_ratio).mean()
        squared_error = (values - returns).square()
        if args.clip_vloss:
            step = (values - old_values).clamp(-args.clip_coef, args.clip_coef)
            squared_error = torch.maximum(squared_error, (old_values + step - returns).square())
        value_loss = 0.5 * squared_error.mean()
        curves = {"value_loss": value_loss, "policy_loss": policy_loss, "entropy": entropy}
        # http://joschu.net/blog/kl-approx.html
        curves |= {"old_approx_kl": -log_ratio.mean(), "approx_kl": (ratio - 1 - log_ratio).mean()}
        curves["clipfrac"] = ((ratio - 1).abs() > args.clip_coef).float().mean()
        return policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss, curves

    gradient, (_, curves) = grad_and_value(loss, has_aux=True)(dict(agent.named_parameters()))
    norm = torch.stack([value.norm() for value in gradient.values()]).norm()
    scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    return {name: value * scale for name, value in gradient.items()}, curves


def updater(gradient_function, optimizer, args):
    """Return a function of the same arguments that takes one optimizer step; it returns the curves.

    The gradient is in the order of the optimizer's parameters. Its function is compiled at the
    first call, when learning starts, if torch.compile works on this machine.
    """
    parameters = optimizer.param_groups[0]["params"]
    device, bf16 = parameters[0].device, args.matmul_precision == "bf16"

    @functools.cache
    def choose():
        try:
            if args.compile:
                torch.compile(torch.neg)(torch.zeros(8, device=device))
                return torch.compile(gradient_function, fullgraph=True, dynamic=False)
        except Exception as error:  # no C++ compiler, no Python headers, ...
            print("not compiled:", str(error).strip().partition("\n")[0])
        return gradient_function

    def update(*arguments):
        with torch.autocast(device.type, torch.bfloat16, bf16):
            gradient, curves = choose()(*arguments)
        for parameter, value in zip(parameters, gradient.values(), strict=True):
            parameter.grad = value.contiguous()  # other strides are misread by Adam(fused=True)
        optimizer.step()
        return curves

    return update


# THE RUN: tests, speed, files; word for word the same in the three scripts.


def evaluate(policy, env, episodes):
    """Play test episodes from fixed initial states -> (N, 2), their returns and lengths."""
    results = np.zeros((episodes, 2))
    for episode in range(episodes):
        observation, _ = env.reset(seed=TEST_SEED + episode)
        terminated = truncated = False
        while not (terminated or truncated):
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            results[episode] += reward, 1
    return results


def use_matmul_precision(precision, device):
    """Set the precision of float32 products, but "highest" where accuracy is lost; return it."""
    torch.set_float32_matmul_precision("highest" if precision == "bf16" else precision)
    a, b = torch.randn(2, 256, 256, generator=torch.Generator().manual_seed(0)).to(device)
    exact = a.double() @ b.double()
    if torch.norm(a @ b - exact) > 1e-6 * torch.norm(exact):  # TF32; bf16 on a CPU with AMX
        torch.set_float32_matmul_precision(precision := "highest")
    return precision


@contextlib.contextmanager
def writing(path):
    """Turn what the operating system (or torch.save) says into one line that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        fail(f"cannot write {path}: {error}", code=1)


def write_file(path, write):
    """Write a file whole or not at all: a kill or a full disk leaves the previous one."""
    temporary = path.with_suffix(".tmp")
    try:
        with writing(path), open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path, value):
    """Write a JSON file."""
    write_file(path, lambda file: file.write(json.dumps(value, indent=2).encode() + b"\n"))


def open_run(args, algorithm, precision):
    """Create or reopen the run's folder; return it and its lock, held until the process ends."""
    name = run_name(args.env_id, args.exp_name, args.noise, args.noise_rate, args.seed)
    run_dir, new = Path(args.runs_dir, name), json.loads(json.dumps(asdict(args)))
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        lock = open(run_dir / ".lock", "w")  # noqa: SIM115
        fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fail(f"{run_dir} is in use by another process")
    except OSError as error:
        fail(f"--runs-dir: {error}")
    for path in filter(Path.is_file, run_dir.glob("[!.]*" if args.overwrite else "*.tmp")):
        path.unlink()
    path = run_dir / "config.json"
    if any(run_dir.glob("*.json")) or (run_dir / "checkpoint.pt").exists():
        try:
            old = json.loads(path.read_text())["args"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            fail(f"cannot read {path} ({type(error).__name__}: {error}); --overwrite starts afresh")
        free = ("runs_dir", "overwrite", "torch_threads", "compile", "checkpoint_frequency")
        differ = [k for k in new if k not in free and old.get(k) != new[k]]
        if differ := "; ".join(f"{k} {old.get(k)}, not {new[k]}" for k in differ):
            fail(f"{run_dir} holds a run with {differ}; --overwrite replaces it")
        return run_dir, lock
    versions = {module.__name__: module.__version__ for module in (torch, gym, mujoco, np)}
    git = 'git -C "$0" describe --always --dirty --abbrev=40 --exclude="*"'
    git = ["/bin/sh", "-c", git, Path(__file__).parent]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip() or None
    config = {"algorithm": algorithm, "args": new, "matmul_precision": precision}
    versions["python"] = sys.version.split()[0]
    write_json(path, config | {"versions": versions, "git_commit": commit})
    return run_dir, lock


def save_checkpoint(run_dir, step, state, generators):
    """Write all that resuming needs, in one dict."""
    checkpoint = {name: value.state_dict() for name, value in state.items()}
    checkpoint |= {"format": 1, "run": run_dir.name, "step": step, "torch": torch.get_rng_state()}
    checkpoint["generators"] = [generator.bit_generator.state for generator in generators]
    write_file(run_dir / "checkpoint.pt", lambda file: torch.save(checkpoint, file))


def load_checkpoint(run_dir, state, generators):
    """Restore what save_checkpoint wrote; return the step, or 0 where there is no checkpoint."""
    if not (path := run_dir / "checkpoint.pt").exists():
        return 0
    try:
        if bad := zipfile.ZipFile(path).testzip():  # torch.load checks no checksums
            raise ValueError(f"{bad} is damaged")
        checkpoint = torch.load(path, weights_only=True)
        if (checkpoint["format"], checkpoint["run"]) != (1, run_dir.name):
            raise ValueError(f"format {checkpoint['format']} of {checkpoint['run']}")
        for name, value in state.items():
            value.load_state_dict(checkpoint[name])
        for generator, numpy_state in zip(generators, checkpoint["generators"], strict=True):
            generator.bit_generator.state = numpy_state
        torch.set_rng_state(checkpoint["torch"])
    except Exception as error:  # a damaged file may raise anything
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        fail(f"cannot resume from {path} ({reason}); --overwrite starts afresh")
    return checkpoint["step"]


class RunLog:
    """TensorBoard events for people, eval.csv for programs, progress for whoever waits."""

    def __init__(self, run_dir, args, env):
        self.run_dir, self.csv, self.args = run_dir, run_dir / "eval.csv", args
        self.noise, self.returns, self.seconds, self.text = noise_wrappers(env), [], 0.0, ""

    def open(self, step):
        """Start after `step`: what an interrupted run wrote later than its checkpoint is cut."""
        for path in () if step else self.run_dir.glob("events.*"):
            path.unlink()
        with writing(self.run_dir):
            self.writer = SummaryWriter(str(self.run_dir), purge_step=step and step + 1)
        with writing(self.csv):
            if step:
                os.truncate(self.csv, self.csv_size)
            else:
                self.csv.write_text("step,episode,episodic_return,episodic_length\n")
        if not step:
            table = "".join(f"|{name}|{value}|\n" for name, value in vars(self.args).items())
            self.writer.add_text("hyperparameters", "|param|value|\n|-|-|\n" + table)
            config = vars(self.args) | {"noise_rate": max(self.args.noise_rate, default=0.0)}
            config = {k: v if isinstance(v, int | float) else str(v) for k, v in config.items()}
            for summary in hparams(config, {"eval/episodic_return_mean": 0}):
                self.writer.file_writer.add_summary(summary)
        total, plain = self.args.total_timesteps, not sys.stdout.isatty()
        self.bar = tqdm(total=total, initial=step, file=sys.stdout, disable=plain)
        self.first_step, self.start, self.printed = step, time.time(), time.time()

    def scalars(self, step, values):
        """Log {tag: value} and the speed to TensorBoard; show the progress every ten seconds."""
        sps = (step - self.first_step) / (time.time() - self.start)
        with writing(f"events.* in {self.run_dir}"):
            for tag, value in (values | {"charts/SPS": sps}).items():
                self.writer.add_scalar(tag, value, step)
        self.bar.update(step - self.bar.n)
        if self.bar.disable and time.time() - self.printed > 10:
            eta = timedelta(seconds=round((self.args.total_timesteps - step) / sps))
            print(f"step={step}/{self.args.total_timesteps} sps={sps:.0f} {self.text}eta={eta}")
            self.printed = time.time()

    def losses(self, step, curves):
        """Log what an update returns and the realised noise rates; fail if it is not finite."""
        values = {f"losses/{name}": value.item() for name, value in curves.items()}
        if not all(map(math.isfinite, values.values())):
            fail(f"step {step}: training diverged, not every loss is finite: {values}", code=1)
        for name, wrapper in self.noise.items():
            values[f"noise/{name}/applied_fraction"] = wrapper.applied_fraction
        self.scalars(step, values)

    def episode(self, step, episode):
        """Log a training episode as RecordEpisodeStatistics saw it, before reward noise."""
        self.returns = [*self.returns[-99:], float(episode["r"])]
        charts = {"charts/episodic_return": episode["r"], "charts/episodic_length": episode["l"]}
        self.scalars(step, charts)

    def evaluation(self, step, results, now):
        """Log the (N, 2) returns and lengths of the test episodes."""
        if not np.isfinite(results).all():
            fail(f"step {step}: a test return is not finite", code=1)
        with writing(self.csv), open(self.csv, "a") as file:
            for i, (episodic_return, length) in enumerate(results.tolist()):
                file.write(f"{step},{i},{episodic_return},{length:.0f}\n")
            file.flush()
            os.fsync(file.fileno())
        self.mean, length, self.std = *results.mean(0), results[:, 0].std(ddof=len(results) > 1)
        self.text, self.printed = f"eval_return={self.mean:.1f} ", 0  # 0: print it now
        self.bar.set_description_str(self.text)
        values = {"return_mean": self.mean, "return_std": self.std, "length_mean": length}
        self.scalars(now, {f"eval/episodic_{name}": value for name, value in values.items()})

    def state_dict(self):
        """What a checkpoint keeps of the log; flushes its files, to be no older than that."""
        with writing(f"events.* in {self.run_dir}"):
            self.writer.flush()
        seconds = self.seconds + time.time() - self.start
        return {"returns": self.returns, "seconds": seconds, "csv_size": self.csv.stat().st_size}

    def load_state_dict(self, state):
        """Restore a state_dict."""
        if self.csv.stat().st_size < state["csv_size"]:
            raise ValueError(f"{self.csv} is shorter than it was")
        vars(self).update(state)

    def finish(self, step, policy):
        """Write policy.pt and, last of all, result.json; the checkpoint has served."""
        total, seconds = self.args.total_timesteps, self.state_dict()["seconds"]
        result = {"final_return_mean": self.mean, "final_return_std": self.std}
        result |= {"final_return_n": self.args.eval_episodes, "total_timesteps": total}
        result |= {"train_return_mean_last_100": np.mean(self.returns) if self.returns else None}
        result |= {"steps_per_second": step / seconds, "wall_time_seconds": seconds}
        counts = {name: [w.times_applied, w.opportunities] for name, w in self.noise.items()}
        fractions = {name: w.applied_fraction for name, w in self.noise.items()}
        result |= {"noise_applied_fraction": fractions, "noise_applied": counts}
        self.writer.close()
        write_file(self.run_dir / "policy.pt", lambda file: torch.save(policy, file))
        write_json(self.run_dir / "result.json", result)
        (self.run_dir / "checkpoint.pt").unlink(missing_ok=True)


def train(args, stop=lambda: False):
    """Train one agent; return False if stop(), asked whenever an episode ends, ended it early."""
    ranges = {(0, 1): "gamma gae_lambda"}
    ranges[0, 2**63] = """seed eval_frequency learning_rate clip_coef ent_coef vf_coef
        max_grad_norm"""
    ranges[1, 2**63] = """total_timesteps eval_episodes checkpoint_frequency torch_threads
        num_steps num_minibatches update_epochs"""
    args = check(args, ranges)
    if not 2 * args.num_minibatches <= args.num_steps <= args.total_timesteps:
        fail("--num-steps must be at least 2 * --num-minibatches and at most --total-timesteps")
    env = make_noisy(make_env(args.env_id), args.noise, args.noise_rate)
    test_env = make_env(args.env_id)  # never sees noise
    torch.set_num_threads(args.torch_threads)
    device = torch.device("cuda" if args.cuda else "cpu")
    run_dir, lock = open_run(args, "PPO", use_matmul_precision(args.matmul_precision, device))
    if (run_dir / "result.json").exists():
        (run_dir / "checkpoint.pt").unlink(missing_ok=True)
        print(f"{run_dir} is finished")
        return True

    # SETUP: the updates take gradients of explicit parameters, autograd need not follow the rest
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    observation, _ = env.reset(seed=args.seed)
    low, high = env.action_space.low, env.action_space.high
    agent, rollout = Agent(env).requires_grad_(False).to(device), Rollout(args.num_steps, env)
    observation_stats, return_stats = Normalizer(observation.shape), Normalizer(())
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    update = updater(ppo_gradient, optimizer, args)
    log = RunLog(run_dir, args, env)
    iterations = args.total_timesteps // args.num_steps

    # RESUME: between two episodes an environment carries over no more than its generator
    state = {"agent": agent, "optimizer": optimizer, "rollout": rollout, "log": log}
    state |= {"observation_stats": observation_stats, "return_stats": return_stats}
    state |= noise_wrappers(env)
    generators = (rng, env.unwrapped.np_random)
    if start := load_checkpoint(run_dir, state, generators):
        observation, _ = env.reset()
    saved_step = start
    log.open(start)

    act, std = in_numpy(agent.actor_mean), agent.actor_logstd.exp().cpu().numpy()
    observation_stats.update(observation)
    for global_step in range(start + 1, iterations * args.num_steps + 1):
        step = (global_step - 1) % args.num_steps
        if step == 0:
            rollout.noise[:] = torch.randn(rollout.noise.shape)

        # ACT: only that; log-probabilities and values are computed for whole rollouts
        rollout.observations[step] = observation_stats.normalize(observation)
        rollout.actions[step] = act(rollout.observations[step]) + std * rollout.noise[step]

        # STEP
        action = rollout.actions[step].clip(low, high)
        observation, reward, terminated, truncated, info = env.step(action)
        observation_stats.update(observation)

        # STORE
        rollout.discounted_return *= args.gamma * (1 - terminated)
        rollout.discounted_return += reward
        return_stats.update(rollout.discounted_return)
        rollout.rewards[step] = return_stats.scale(reward)
        rollout.dones[step] = terminated or truncated
        if args.bootstrap_truncated and truncated and not terminated:
            value = in_numpy(agent.critic)(observation_stats.normalize(observation))
            rollout.rewards[step] += args.gamma * value[0]

        done = global_step == iterations * args.num_steps
        if step == args.num_steps - 1:
            # LEARN: advantages
            rollout.observations[-1] = observation_stats.normalize(observation)
            observations = torch.from_numpy(rollout.observations).to(device)
            actions = torch.from_numpy(rollout.actions).to(device)
            log_probs, _, values = agent(observations[:-1], actions)
            all_values = torch.cat([values, agent.critic(observations[-1])])
            advantages = compute_gae(
                rollout.rewards, all_values, rollout.dones, args.gamma, args.gae_lambda
            ).to(device)
            returns = advantages + values

            # LEARN: policy and value function
            if args.anneal_lr:
                left = 1 - (global_step - args.num_steps) / (iterations * args.num_steps)
                optimizer.param_groups[0]["lr"] = left * args.learning_rate
            batch = (observations[:-1], actions, log_probs, advantages, returns, values)
            clipfracs = []
            for _ in range(args.update_epochs):
                order = torch.from_numpy(rng.permutation(args.num_steps)).to(device)
                shuffled = [tensor[order].tensor_split(args.num_minibatches) for tensor in batch]
                for minibatch in zip(*shuffled, strict=True):
                    curves = update(agent, minibatch, args)
                    clipfracs.append(curves["clipfrac"])
                if args.target_kl is not None and curves["approx_kl"] > args.target_kl:
                    break
            act, std = in_numpy(agent.actor_mean), agent.actor_logstd.exp().cpu().numpy()

            curves["clipfrac"] = torch.stack(clipfracs).mean()
            curves["explained_variance"] = 1 - (returns - values).var() / returns.var().clamp(1e-8)
            log.losses(global_step, curves)
            log.scalars(global_step, {"charts/learning_rate": optimizer.param_groups[0]["lr"]})

            # TEST: if an evaluation fell due during the rollout; eval.csv has the step it fell due
            due = args.eval_frequency and global_step - global_step % args.eval_frequency
            if done or due > global_step - args.num_steps:
                policy = make_policy(agent, observation_stats, env)
                results = evaluate(policy, test_env, args.eval_episodes)
                log.evaluation(args.total_timesteps if done else due, results, now=global_step)

        if terminated or truncated:
            log.episode(global_step, info["episode"])
            if done:
                break
            stopping = stop()
            if stopping or global_step - saved_step >= args.checkpoint_frequency:
                save_checkpoint(run_dir, global_step, state, generators)
                if stopping:
                    return False
                saved_step = global_step
            observation, _ = env.reset()
            observation_stats.update(observation)

    saved = {"agent": agent, "observation_stats": observation_stats}
    log.finish(global_step, {name: value.state_dict() for name, value in saved.items()})
    return True


if __name__ == "__main__":
    signals = []

    def stop_run(number, frame):
        """Remember the first signal for the end of the episode; exit at once at the second."""
        signals.append(number)
        if len(signals) > 1:
            os._exit(128 + number)

    signal.signal(signal.SIGTERM, stop_run)
    signal.signal(signal.SIGINT, stop_run)
    sys.stdout.reconfigure(line_buffering=True)
    finished = train(tyro.cli(Args), stop=lambda: bool(signals))
    raise SystemExit(0 if finished else 128 + signals[0])
