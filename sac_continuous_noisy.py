"""Soft Actor-Critic (SAC), trained in a noisy environment and tested in a clean one.

The algorithm is Haarnoja et al. (2018), https://arxiv.org/abs/1812.05905, with the choices and
defaults of CleanRL's sac_continuous_action.py. The noise is that of Khraishi and Okhrati (2023),
"Simple Noisy Environment Augmentation for Reinforcement Learning", https://arxiv.org/abs/2305.02882.

    python sac_continuous_noisy.py --env-id HalfCheetah-v5 --seed 1
    python sac_continuous_noisy.py --noise "RandomUniformScaleReward(0.5, 1.5)" --noise-rate 0.05

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
LOG_STD_MIN, LOG_STD_MAX = -5, 2


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
    """environment steps to train for"""
    eval_frequency: int = 10_000
    """steps between two evaluations in the clean test environment (0: only after training)"""
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
    matmul_precision: Literal["highest", "high", "medium", "bf16"] = "medium"
    """PyTorch's precision of float32 products, raised to highest where accuracy is lost; bf16:
    the updates under torch.autocast in bfloat16, whatever accuracy they lose"""

    buffer_size: int = 1_000_000
    """transitions in the replay buffer"""
    gamma: float = 0.99
    """discount factor"""
    tau: float = 0.005
    """target smoothing coefficient"""
    batch_size: int = 256
    """transitions per update"""
    learning_starts: int = 5_000
    """steps with random actions before learning starts"""
    policy_lr: float = 3e-4
    """learning rate of the policy"""
    q_lr: float = 1e-3
    """learning rate of the Q-functions and of the temperature"""
    policy_frequency: int = 2
    """every so many steps the policy is updated, as many times"""
    target_network_frequency: int = 1
    """steps between two updates of the target networks"""
    alpha: float = 0.2
    """entropy temperature, without autotune"""
    autotune: bool = True
    """tune the entropy temperature"""


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


def mlp(linear, inputs, outputs):
    """Two hidden layers of 256 rectified linear units."""
    hidden = [linear(inputs, 256), nn.ReLU(), linear(256, 256), nn.ReLU()]
    return nn.Sequential(*hidden, linear(256, outputs))


def in_numpy(network, observation):
    """Evaluate an mlp for one observation; for one, NumPy is several times faster than PyTorch."""
    w1, b1, w2, b2, w3, b3 = (parameter.cpu().numpy() for parameter in network.parameters())
    hidden = np.maximum(w1 @ np.asarray(observation, np.float32) + b1, 0)
    return w3 @ np.maximum(w2 @ hidden + b2, 0) + b3


class TwinLinear(nn.Module):
    """Two nn.Linear at once, in one batched product: -> (2, B, outputs)."""

    def __init__(self, inputs, outputs):
        super().__init__()
        q1, q2 = nn.Linear(inputs, outputs), nn.Linear(inputs, outputs)
        self.weight = nn.Parameter(torch.stack([q1.weight.T, q2.weight.T]))
        self.bias = nn.Parameter(torch.stack([q1.bias, q2.bias]).unsqueeze(1))

    def forward(self, inputs):
        """Apply both to the same inputs (B, inputs), or each to its own (2, B, inputs)."""
        if self.weight.shape[2] == 1:  # a sum is faster than a product with one column
            return (inputs * self.weight.mT).sum(2, keepdim=True) + self.bias
        return inputs @ self.weight + self.bias


class Critic(nn.Module):
    """Twin Q-functions of observations (B, O) and actions (B, A)."""

    def __init__(self, env):
        super().__init__()
        inputs = env.observation_space.shape[0] + env.action_space.shape[0]
        self.network = mlp(TwinLinear, inputs, 1)

    def forward(self, observations, actions):
        """Return Q1 and Q2, the rows of (2, B)."""
        return self.network(torch.cat([observations, actions], 1)).squeeze(2)


class Actor(nn.Module):
    """A Gaussian policy, squashed to the action bounds; its standard normal noise is an input."""

    def __init__(self, env):
        super().__init__()
        low, high = torch.Tensor(env.action_space.low), torch.Tensor(env.action_space.high)
        self.network = mlp(nn.Linear, env.observation_space.shape[0], 2 * len(low))
        self.register_buffer("action_scale", (high - low) / 2)
        self.register_buffer("action_bias", (high + low) / 2)

    def forward(self, observations, noise):
        """Return actions (B, A) and their log-probabilities (B,)."""
        mean, log_std = self.network(observations).chunk(2, dim=-1)
        # a smooth clamp, from SpinUp / Denis Yarats
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        squashed = torch.tanh(mean + log_std.exp() * noise)
        actions = squashed * self.action_scale + self.action_bias
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - torch.log(self.action_scale * (1 - squashed.square()) + 1e-6)
        return actions, log_prob.sum(1)

    def policy(self, observation, noise=0.0):
        """Return the action for one observation, NumPy to NumPy; noise 0 gives the mean action."""
        scale, bias = (buffer.cpu().numpy() for buffer in self.buffers())
        mean, log_std = np.split(in_numpy(self.network, observation), 2)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (np.tanh(log_std) + 1)
        return np.tanh(mean + np.exp(log_std) * noise) * scale + bias


def load_policy(run_dir, env):
    """Return the policy of a finished run."""
    actor = Actor(env).requires_grad_(False)
    actor.load_state_dict(torch.load(Path(run_dir, "policy.pt"), "cpu", weights_only=True))
    return actor.policy


class ReplayBuffer:
    """The last `capacity` transitions, each observation stored once to halve the memory.

    Row i + 1 holds row i's next observation, unless an episode ends at i: `final` holds that one.
    """

    ARRAYS = ("observations", "actions", "rewards", "terminated")

    def __init__(self, capacity, env):
        self.rows = capacity + 1  # one more for the newest next observation
        self.position, self.size, self.final = 0, 0, {}
        self.observations = np.zeros((self.rows, *env.observation_space.shape), np.float32)
        self.actions = np.zeros((self.rows, *env.action_space.shape), np.float32)
        self.rewards, self.terminated = np.zeros((2, self.rows), np.float32)

    def add(self, observation, action, reward, next_observation, terminated, truncated):
        """Store one transition in place of the oldest."""
        i, j = self.position, (self.position + 1) % self.rows
        self.observations[i], self.observations[j] = observation, next_observation
        self.actions[i], self.rewards[i], self.terminated[i] = action, reward, terminated
        self.final.pop(i, None)
        if terminated or truncated:
            self.final[i] = torch.from_numpy(self.observations[j].copy())
        self.position, self.size = j, min(self.size + 1, self.rows - 1)

    def sample(self, batch_size, rng):
        """Draw (s, a, r, s', terminated) uniformly: float32 tensors with batch_size rows."""
        oldest = self.position - self.size
        i = (oldest + rng.integers(self.size, size=batch_size)) % self.rows
        batch = [torch.from_numpy(getattr(self, name).take(i, axis=0)) for name in self.ARRAYS]
        batch.insert(3, torch.from_numpy(self.observations.take((i + 1) % self.rows, axis=0)))
        for b, row in enumerate(i.tolist()):
            if row in self.final:
                batch[3][b] = self.final[row]
        return batch

    def state_dict(self):
        """The filled rows, as tensors that share the buffer's memory."""
        filled = min(self.size + 1, self.rows)
        state = {name: torch.from_numpy(getattr(self, name)[:filled]) for name in self.ARRAYS}
        return state | {"final": self.final, "position": self.position, "size": self.size}

    def load_state_dict(self, state):
        """Copy the rows of a state_dict back."""
        for name in self.ARRAYS:
            getattr(self, name)[: len(state[name])] = state[name].numpy()
        self.final, self.position, self.size = state["final"], state["position"], state["size"]


# UPDATES: pure functions of networks, batch and standard normal noise. They return a gradient,
# named like the network's parameters, and curves; compiled and plain runs share them.


def critic_gradient(actor, critic, target, log_alpha, batch, noise, gamma):
    """Mean squared error of Q1 and Q2 to y = r + gamma (min(Q1', Q2') - alpha log pi)(s', a')."""
    observations, actions, rewards, next_observations, terminated = batch
    next_actions, next_log_prob = actor(next_observations, noise)
    next_q = target(next_observations, next_actions).amin(0)
    y = rewards + (1 - terminated) * gamma * (next_q - log_alpha.exp() * next_log_prob)

    def loss(params):
        q = functional_call(critic, params, (observations, actions))
        (qf1_values, qf2_values), (qf1_loss, qf2_loss) = q.mean(1), (q - y).square().mean(1)
        curves = {"qf1_values": qf1_values, "qf2_values": qf2_values}
        curves |= {"qf1_loss": qf1_loss, "qf2_loss": qf2_loss, "qf_loss": (qf1_loss + qf2_loss) / 2}
        return qf1_loss + qf2_loss, curves

    gradient, (_, curves) = grad_and_value(loss, has_aux=True)(dict(critic.named_parameters()))
    return gradient, curves


def actor_gradient(actor, critic, log_alpha, observations, noise):
    """The mean of alpha log pi(a|s) - min(Q1, Q2)(s, a), a ~ pi, with frozen critics."""

    def loss(params):
        actions, log_prob = functional_call(actor, params, (observations, noise))
        return (log_alpha.exp() * log_prob - critic(observations, actions).amin(0)).mean()

    gradient, actor_loss = grad_and_value(loss)(dict(actor.named_parameters()))
    return gradient, {"actor_loss": actor_loss}


def temperature_gradient(actor, log_alpha, observations, noise, target_entropy):
    """The mean of -alpha (log pi(a|s) + target entropy), a ~ pi, with a frozen policy."""
    _, log_prob = actor(observations, noise)

    def loss(log_alpha):
        return (-log_alpha.exp() * (log_prob + target_entropy)).mean()

    gradient, alpha_loss = grad_and_value(loss)(log_alpha)
    return {"log_alpha": gradient}, {"alpha_loss": alpha_loss, "alpha": log_alpha.exp()}


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
    ranges = {(0, 1): "gamma tau"}
    ranges[0, 2**63] = "seed eval_frequency learning_starts policy_lr q_lr alpha"
    ranges[1, 2**63] = """total_timesteps eval_episodes checkpoint_frequency torch_threads
        buffer_size batch_size policy_frequency target_network_frequency"""
    args = check(args, ranges)
    env = make_noisy(make_env(args.env_id), args.noise, args.noise_rate)
    test_env = make_env(args.env_id)  # never sees noise
    if not np.isfinite([env.action_space.low, env.action_space.high]).all():
        fail(f"--env-id {args.env_id}: SAC needs bounded actions, not {env.action_space}")
    torch.set_num_threads(args.torch_threads)
    device = torch.device("cuda" if args.cuda else "cpu")
    run_dir, lock = open_run(args, "SAC", use_matmul_precision(args.matmul_precision, device))
    if (run_dir / "result.json").exists():
        (run_dir / "checkpoint.pt").unlink(missing_ok=True)
        print(f"{run_dir} is finished")
        return True

    # SETUP: the updates take gradients of explicit parameters, autograd need not follow the rest
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)
    observation, _ = env.reset(seed=args.seed)
    actor, critic, target = Actor(env), Critic(env), Critic(env)
    alpha = torch.tensor(1.0 if args.autotune else args.alpha)
    temperature = nn.ParameterDict({"log_alpha": alpha.log()})
    target.load_state_dict(critic.state_dict())
    for network in (actor, critic, target, temperature):
        network.requires_grad_(False).to(device)
    online, targets = list(critic.parameters()), list(target.parameters())
    log_alpha, target_entropy = temperature["log_alpha"], -float(env.action_space.shape[0])
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=args.q_lr, fused=True)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=args.policy_lr, fused=True)
    alpha_optimizer = torch.optim.Adam(temperature.parameters(), lr=args.q_lr, fused=True)
    capacity = min(args.buffer_size, args.total_timesteps)
    buffer, log = ReplayBuffer(capacity, env), RunLog(run_dir, args, env)
    update_critic = updater(critic_gradient, critic_optimizer, args)
    update_actor = updater(actor_gradient, actor_optimizer, args)
    update_alpha = updater(temperature_gradient, alpha_optimizer, args)

    # RESUME: between two episodes an environment carries over no more than its generator
    state = {"actor": actor, "critic": critic, "target": target, "temperature": temperature}
    state |= {"critic_optimizer": critic_optimizer, "actor_optimizer": actor_optimizer}
    state |= {"alpha_optimizer": alpha_optimizer, "buffer": buffer, "log": log}
    state |= noise_wrappers(env)
    generators = (rng, env.action_space.np_random, env.unwrapped.np_random)
    if start := load_checkpoint(run_dir, state, generators):
        observation, _ = env.reset()
    saved_step = start
    log.open(start)

    def noise():
        return torch.randn(args.batch_size, *env.action_space.shape).to(device)

    for global_step in range(start + 1, args.total_timesteps + 1):
        # ACT
        if global_step <= args.learning_starts:
            action = env.action_space.sample()
        else:
            action = actor.policy(observation, torch.randn(env.action_space.shape).numpy())

        # STEP
        next_observation, reward, terminated, truncated, info = env.step(action)

        # STORE: terminated apart from truncated, since a time limit ends no values
        buffer.add(observation, action, reward, next_observation, terminated, truncated)
        observation = next_observation

        done = global_step == args.total_timesteps
        if global_step > args.learning_starts:
            # LEARN: critic
            batch = [tensor.to(device) for tensor in buffer.sample(args.batch_size, rng)]
            curves = update_critic(actor, critic, target, log_alpha, batch, noise(), args.gamma)

            # LEARN: actor and temperature, as many times as steps have passed
            if global_step % args.policy_frequency == 0:
                for _ in range(args.policy_frequency):
                    curves |= update_actor(actor, critic, log_alpha, batch[0], noise())
                    if args.autotune:
                        curves |= update_alpha(actor, log_alpha, batch[0], noise(), target_entropy)

            # LEARN: target
            if global_step % args.target_network_frequency == 0:
                torch._foreach_lerp_(targets, online, args.tau)

            if done or global_step % 100 == 0:
                log.losses(global_step, curves)

        # TEST
        if done or args.eval_frequency and global_step % args.eval_frequency == 0:
            results = evaluate(actor.policy, test_env, args.eval_episodes)
            log.evaluation(global_step, results, now=global_step)

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

    log.finish(global_step, actor.state_dict())
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
