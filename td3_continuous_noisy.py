"""Twin Delayed DDPG (TD3), trained in a noisy environment and tested in a clean one.

The algorithm is Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477, with the choices and
defaults of CleanRL's td3_continuous_action.py. The noise is that of Khraishi and Okhrati (2023),
"Simple Noisy Environment Augmentation for Reinforcement Learning", https://arxiv.org/abs/2305.02882.

    python td3_continuous_noisy.py --env-id HalfCheetah-v5 --seed 1
    python td3_continuous_noisy.py --noise "RandomUniformScaleReward(0.5, 1.5)" --noise-rate 0.05

Writes config.json, eval.csv, TensorBoard events, policy.pt and result.json into a folder in runs/.
You can interrupt it at any time; run the same command again to resume.
"""

import contextlib
import fcntl
import json
import math
import os
import shlex
import signal
import sys
import time
import warnings
import zipfile
from collections import deque
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

if __name__ == "__main__":  # Ctrl-C during the imports below ends the program without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
import tyro
from torch.func import functional_call, grad_and_value
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

import noisy_wrappers as noisy

TEST_SEED = 1_000_000  # of the first test episode; the same in every test of every run
STEP_LIMIT = 10_000  # of an episode, where neither the environment nor the user sets one
EVAL_FREQUENCY = 10_000  # default of --eval-frequency; at most a tenth of the run


@dataclass
class Args:
    """Command-line arguments; the algorithm's are those of CleanRL and the paper (Appendix A.2)."""

    env_id: str = "HalfCheetah-v5"  # RUN: Gymnasium environment, Name-v0, or module:Name-v0
    seed: int = 1  # seed of everything that is random
    total_timesteps: int = 1_000_000  # environment steps to train for
    max_episode_steps: int | None = None  # time limit of an episode; None: the environment's own
    exp_name: str = Path(__file__).stem  # name of the experiment, part of the run folder's name
    runs_dir: str = "runs"  # folder in which the run's own folder is made
    overwrite: bool = False  # delete the files in the run's folder and start again
    checkpoint_frequency: int = 50_000  # environment steps between two checkpoints
    noise: tuple[str, ...] = ()  # NOISE: noises of the training environment; the baseline has none
    noise_rate: tuple[float | str, ...] = ()  # probability of each noise; 1.0:0.0 falls linearly
    eval_episodes: int = 10  # TESTS: episodes in each test
    eval_frequency: int | None = None  # steps between tests; None: up to 10,000; 0: only at the end

    cuda: bool = False  # SPEED: train on a GPU (not tested on one yet); these networks are small
    torch_threads: int = 1  # CPU threads; runs in parallel gain more than extra threads
    compile: bool = True  # compile the updates, if there is a C++ compiler
    # precision of float32 products, raised to highest where another would cost accuracy; with bf16
    # the updates are computed in bfloat16, even if this costs accuracy
    matmul_precision: Literal["highest", "medium", "bf16"] = "medium"

    buffer_size: int = 1_000_000  # ALGORITHM: transitions in the replay buffer
    gamma: float = 0.99  # discount factor
    tau: float = 0.005  # target smoothing coefficient
    batch_size: int = 256  # transitions in a minibatch
    learning_starts: int = 25_000  # environment steps with random actions before learning starts
    learning_rate: float = 3e-4  # learning rate of the policy and of the Q-functions
    policy_frequency: int = 2  # environment steps between two updates of the policy and the targets
    exploration_noise: float = 0.1  # std of the noise on training actions; 1: half of their range
    policy_noise: float = 0.2  # std of the noise on the target's actions; 1: half of their range
    noise_clip: float = 0.5  # largest noise on the target's actions; 1: half of their range


def make_env(env_id, **kwargs):
    """Make the clean environment: observations and actions are vectors, and every episode ends."""
    with fail_on(noisy.refusals(env_id), f"--env-id {env_id}"):
        env = gym.make(env_id, disable_env_checker=True, **kwargs)
        return noisy.make_flat(env, STEP_LIMIT)


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
    """A deterministic policy, squashed to the bounds of the action space."""

    def __init__(self, env):
        super().__init__()
        low, high = torch.Tensor(env.action_space.low), torch.Tensor(env.action_space.high)
        self.network = mlp(nn.Linear, env.observation_space.shape[0], len(low))
        self.action_space = env.action_space
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("action_scale", (high - low) / 2)
        self.register_buffer("action_bias", (high + low) / 2)

    def forward(self, observations, eps=0.0):
        """Return actions (B, A), moved by eps (B, A) half ranges, within the bounds."""
        actions = torch.tanh(self.network(observations)) + eps
        actions = actions * self.action_scale + self.action_bias
        return torch.clamp(actions, self.low, self.high)

    def policy(self, observation, eps=0.0):
        """Return the action for one observation, NumPy to NumPy."""
        scale, bias = self.action_scale.cpu().numpy(), self.action_bias.cpu().numpy()
        action = np.tanh(in_numpy(self.network, observation)) + eps
        return noisy.into_space(action * scale + bias, self.action_space)


class ReplayBuffer:
    """The last `capacity` transitions, each observation stored once to halve the memory.

    The next observation of row i is that of row i + 1; where an episode ended it is `final[i]`.
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
        row, next_row = self.position, (self.position + 1) % self.rows
        self.observations[row], self.observations[next_row] = observation, next_observation
        self.actions[row], self.rewards[row], self.terminated[row] = action, reward, terminated
        self.final.pop(row, None)
        if terminated or truncated:
            self.final[row] = torch.from_numpy(self.observations[next_row].copy())
        self.position, self.size = next_row, min(self.size + 1, self.rows - 1)

    def sample(self, batch_size, rng):
        """Draw (s, a, r, s', terminated) uniformly: float32 tensors with batch_size rows."""
        oldest = self.position - self.size
        rows = (oldest + rng.integers(self.size, size=batch_size)) % self.rows
        # take is twice as fast as [rows]
        arrays = [getattr(self, name).take(rows, axis=0) for name in self.ARRAYS]
        observations, actions, rewards, terminated = map(torch.from_numpy, arrays)
        next_observations = torch.from_numpy(self.observations.take((rows + 1) % self.rows, axis=0))
        for i, row in enumerate(rows.tolist()):
            if row in self.final:
                next_observations[i] = self.final[row]
        return observations, actions, rewards, next_observations, terminated

    def state_dict(self):
        """Return the filled rows, as tensors that share the buffer's memory."""
        filled = min(self.size + 1, self.rows)
        arrays = {name: torch.from_numpy(getattr(self, name)[:filled]) for name in self.ARRAYS}
        return {**arrays, "final": self.final, "position": self.position, "size": self.size}

    def load_state_dict(self, state):
        """Copy the rows of a state_dict back."""
        for name in self.ARRAYS:
            getattr(self, name)[: len(state[name])] = state[name].numpy()
        self.final, self.position, self.size = state["final"], state["position"], state["size"]


# LOSSES: pure functions of the parameters to learn and of what stays -> the loss, and curves


def critic_loss(params, critic, target_critic, target_actor, batch, eps, gamma):
    """Mean squared error of Q1 and Q2 to y = r + gamma min(Q1', Q2')(s', pi'(s') + eps)."""
    observations, actions, rewards, next_observations, terminated = batch
    next_actions = target_actor(next_observations, eps)
    next_q = target_critic(next_observations, next_actions).amin(0)
    y = rewards + (1 - terminated) * gamma * next_q
    q1, q2 = functional_call(critic, params, (observations, actions))
    qf1_loss, qf2_loss = (q1 - y).square().mean(), (q2 - y).square().mean()
    loss = qf1_loss + qf2_loss
    values = {"qf1_values": q1.mean(), "qf2_values": q2.mean()}
    losses = {"qf1_loss": qf1_loss, "qf2_loss": qf2_loss, "qf_loss": loss / 2}
    return loss, values | losses


def actor_loss(params, actor, critic, observations):
    """The mean of -Q1(s, pi(s)), with a frozen critic."""
    actions = functional_call(actor, params, (observations,))
    q1 = {name: twin[:1] for name, twin in critic.named_parameters()}  # the first of the twins
    loss = -functional_call(critic, q1, (observations, actions)).mean()
    return loss, {"actor_loss": loss}


def updater(loss, network, optimizer, args):
    """Return update(*inputs) -> curves: one optimizer step on loss(network parameters, *inputs)."""
    parameters = dict(network.named_parameters())
    gradient_of = grad_and_value(loss, has_aux=True)
    if args.compile:
        gradient_of = torch.compile(gradient_of, fullgraph=True, dynamic=False)
    device_type = "cuda" if args.cuda else "cpu"
    bf16 = torch.autocast(device_type, torch.bfloat16, enabled=args.matmul_precision == "bf16")

    def update(*inputs):
        with bf16:
            gradient, (_, curves) = gradient_of(parameters, *inputs)
        for name, parameter in parameters.items():
            # contiguous: the fused Adam of PyTorch 2.13 misreads any other strides, in silence
            parameter.grad = gradient[name].contiguous()
        # Adam's momentum of dead units ends at 1e-45, and Intel's processors are slow with that
        torch.set_flush_denormal(True)
        optimizer.step()
        torch.set_flush_denormal(False)
        return curves

    return update


def learn(args, env, test_env, stop):
    """Train one agent; return False if stop(), asked whenever an episode ends, ended it early."""
    if not np.isfinite([env.action_space.low, env.action_space.high]).all():
        fail(f"TD3 needs bounded actions; some actions of {args.env_id} are unbounded")
    torch.set_num_threads(args.torch_threads)
    device = torch.device("cuda" if args.cuda else "cpu")
    run = Run(args, "TD3", use_matmul_precision(args.matmul_precision, device), env)
    if run.is_finished:
        return True

    # SETUP: torch.func differentiates the losses, so autograd need not follow the networks
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)
    observation, _ = env.reset(seed=args.seed)
    buffer = ReplayBuffer(min(args.buffer_size, args.total_timesteps), env)
    actor, critic, target_actor, target_critic = Actor(env), Critic(env), Actor(env), Critic(env)
    target_actor.load_state_dict(actor.state_dict())
    target_critic.load_state_dict(critic.state_dict())
    for network in (actor, critic, target_actor, target_critic):
        network.requires_grad_(False).to(device)
    q_optimizer = torch.optim.Adam(critic.parameters(), lr=args.learning_rate, fused=True)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=args.learning_rate, fused=True)
    update_critic = updater(critic_loss, critic, q_optimizer, args)
    update_actor = updater(actor_loss, actor, actor_optimizer, args)
    online_parameters = [*actor.parameters(), *critic.parameters()]
    target_parameters = [*target_actor.parameters(), *target_critic.parameters()]

    # RESUME: between two episodes an environment is no more than its EnvState
    state = [actor, critic, target_actor, target_critic, q_optimizer, actor_optimizer]
    start = run.resume([*state, buffer, noisy.EnvState(env, rng)])
    if start > 0:
        noisy.set_progress(env, start / args.total_timesteps)
        observation, _ = env.reset()

    for global_step in range(start + 1, args.total_timesteps + 1):
        # ACT
        if global_step <= args.learning_starts:
            action = env.action_space.sample()
        else:
            eps = args.exploration_noise * torch.randn(env.action_space.shape).numpy()
            action = actor.policy(observation, eps)

        # STEP
        next_observation, reward, terminated, truncated, info = env.step(action)

        # STORE: terminated alone ends the values, a time limit does not
        buffer.add(observation, action, reward, next_observation, terminated, truncated)
        observation = next_observation

        done = global_step == args.total_timesteps
        if global_step > args.learning_starts:
            # LEARN: critic
            batch = [tensor.to(device) for tensor in buffer.sample(args.batch_size, rng)]
            eps = args.policy_noise * torch.randn(batch[1].shape).to(device)
            eps = eps.clamp(-args.noise_clip, args.noise_clip)
            curves = update_critic(critic, target_critic, target_actor, batch, eps, args.gamma)

            if global_step % args.policy_frequency == 0:
                # LEARN: actor
                curves |= update_actor(actor, critic, batch[0])

                # LEARN: targets
                torch._foreach_lerp_(target_parameters, online_parameters, args.tau)

            if done or global_step % 100 == 0:
                run.log(global_step, losses=curves, noise=noisy.noise_statistics(env))

        # TEST
        if done or (args.eval_frequency > 0 and global_step % args.eval_frequency == 0):
            results = evaluate(actor.policy, test_env, args.eval_episodes, stop)
            if results is None:
                return False
            run.log_test(global_step, results)

        # NEXT EPISODE
        if terminated or truncated:
            run.log_episode(global_step, info)
            if done:
                break
            stopping = stop()
            if stopping or global_step - run.saved_step >= args.checkpoint_frequency:
                run.save(global_step)
            if stopping:
                return False
            noisy.set_progress(env, global_step / args.total_timesteps)
            observation, _ = env.reset()

    run.finish(global_step, actor.state_dict())
    return True


def load_policy(run_dir, env):
    """Return the policy of a finished run."""
    actor = Actor(env).requires_grad_(False)
    actor.load_state_dict(torch.load(Path(run_dir, "policy.pt"), "cpu", weights_only=True))
    return actor.policy


# THE RUN: arguments, tests, speed, files; word for word the same in the three scripts.


def fail(message, code=2):
    """Exit after a line that says what is wrong and what to do."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(code)


@contextlib.contextmanager
def fail_on(errors, message, code=2):
    """Turn such errors into one line, the message and what the error says; note it on others."""
    try:
        yield
    except errors as error:
        fail(f"{message}: {noisy.reason(error)}", code)
    except Exception as error:  # of the environment, say: its traceback is what the user needs
        error.add_note(f"({message})")
        raise


def say(text):
    """Print a line; training goes on if its reader has left, as in `... | head`."""
    try:
        print(text, flush=True)
    except OSError:  # of a pipe, or of a terminal
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def read_args():
    """Read the command line; a whole number may be written as 1e6."""
    words = sys.argv[1:]
    for i, word in enumerate(words):
        flag, equals, number = word.partition("=") if word.startswith("--") else ("", "", word)
        is_name = (flag or words[i - 1]).replace("_", "-") in ("--exp-name", "--runs-dir")
        with contextlib.suppress(ValueError):  # it is no number
            if "e" in number.lower() and float(number).is_integer() and not is_name:
                words[i] = f"{flag}{equals}{float(number):.0f}"
    noises = "\n  ".join(["Noises:", *noisy.signatures()])
    return tyro.cli(Args, args=words, description=f"{__doc__}\n{noises}")


def train(args, stop=lambda: False):
    """Train one agent and close its environments; return False if stop() ended it early."""
    if args.exp_name in ("", ".", ".."):
        fail(f"--exp-name must be a name, not {args.exp_name!r}")
    if args.cuda and not torch.cuda.is_available():
        fail("--cuda: PyTorch finds no GPU; leave it out to run on the CPU")
    try:
        noisy.check_numbers(asdict(args))
        env_id = noisy.canonical_env_id(args.env_id)
        noise, noise_rate = noisy.Configuration.read(args.noise, args.noise_rate).texts
    except ValueError as error:
        fail(error)
    limit = {"max_episode_steps": args.max_episode_steps}
    noisy.seed_globals(TEST_SEED)  # a constructor may draw, too: all runs have the same tests
    with make_env(env_id, **limit) as test_env:
        noisy.seed_globals(args.seed)
        with make_env(env_id, **limit) as env:
            where = f"--noise in {env_id}" if noise else f"--env-id {env_id}"
            with fail_on(ValueError, where), warnings.catch_warnings(record=True) as notes:
                env = noisy.make_noisy(env, noise, noise_rate)
            told = [note.message for note in notes]
            for text in told + noisy.remarks(env_id, test_env, STEP_LIMIT):
                say(text)
            args = replace(args, env_id=env_id, noise=noise, noise_rate=noise_rate)
            return learn(args, env, test_env, stop)


def evaluate(policy, env, episodes, stop=lambda: False):
    """Play test episodes -> (N, 3): returns, lengths, noisy.outcome; None if stopped."""
    long = env.spec.max_episode_steps >= STEP_LIMIT  # there, and only there, stop() ends a test
    results = np.zeros((episodes, 3))
    with noisy.kept_generators(env):
        for episode in range(episodes):
            noisy.seed_globals(TEST_SEED + episode)
            observation, _ = env.reset(seed=TEST_SEED + episode)
            terminated = truncated = False
            while not (terminated or truncated):
                observation, reward, terminated, truncated, info = env.step(policy(observation))
                results[episode, :2] += reward, 1
                if long and stop():
                    return None
            results[episode, 2] = noisy.outcome(info)
    return results


def use_matmul_precision(precision, device):
    """Set the precision of float32 products, but "highest" where accuracy is lost; return it."""
    torch.set_float32_matmul_precision("highest" if precision == "bf16" else precision)
    a, b = torch.randn(2, 256, 256, generator=torch.Generator().manual_seed(0)).to(device)
    exact = a.double() @ b.double()
    if torch.norm(a @ b - exact) > 1e-6 * torch.norm(exact):  # TF32; bf16 on a CPU with AMX
        precision = "highest"
        torch.set_float32_matmul_precision(precision)
    return precision


class Run:
    """The run's folder: what is written into it, and read again to resume."""

    FILES = ("result.json", "checkpoint.pt", "policy.pt", "eval.csv", "config.json")
    EVENTS = "events.out.tfevents.*"

    def __init__(self, args, algorithm, precision, env):
        """Open the folder; fail if another process uses it, or if it holds a different run."""
        name = noisy.run_name(args.env_id, args.exp_name, args.noise, args.noise_rate, args.seed)
        self.folder = Path(args.runs_dir, name)
        self.args, self.start = args, time.monotonic() - 1e-6  # not 0 s ago: clocks may stand still
        self.noise, self.returns = noisy.noise_wrappers(env), env.get_wrapper_attr("return_queue")
        self.outcomes = deque(maxlen=100)  # of the last training episodes
        if self.folder.is_symlink():
            fail(f"{self.folder} is a link: remove it, or choose another --exp-name or --runs-dir")
        with fail_on(OSError, "--runs-dir"):
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            self.lock = os.fdopen(lock)
            with fail_on(BlockingIOError, f"{self.folder} is in use by another process"):
                fcntl.lockf(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until this process ends
            result, self.checkpoint, *_, config = ours = [self.folder / f for f in self.FILES]
            old = [path.with_suffix(".tmp") for path in ours]  # of a process that was killed
            if args.overwrite:
                old += [*ours, self.folder / "robustness.csv"]  # events: see resume()
            for path in old:
                path.unlink(missing_ok=True)
        self.is_finished = result.exists()
        if any(path.exists() for path in ours):
            self.config = self._old_config(config, algorithm)
        else:
            if args.eval_frequency is None:
                args.eval_frequency = max(1, min(EVAL_FREQUENCY, args.total_timesteps // 10))
            self.config = {"algorithm": algorithm, "args": asdict(args)}
        if self.is_finished:
            with self._reading(result):
                self.result = json.loads(result.read_text())
                self._say_finished()
            self.checkpoint.unlink(missing_ok=True)
        else:
            noises = " + ".join(map("{} at {}".format, args.noise, args.noise_rate))
            begun = f"{algorithm} on {args.env_id} | noise: {noises or 'none (baseline)'}"
            begun += f" | seed {args.seed} | {args.total_timesteps:,} steps"
            say(f"{begun} | {'cuda' if args.cuda else 'cpu'} | {self.folder}")
            for change in noisy.note_versions(self.config, precision):
                say(change)
            if args.compile:
                say("compiling ...")
                torch.compiler.reset()  # forget what earlier runs of this process compiled
                noisy.clean_compiler_cache()

    def _old_config(self, path, algorithm):
        with self._reading(path):
            config = json.loads(path.read_text())
            # an argument that an older version did not have is no difference
            old = asdict(self.args) | config["args"] | {"algorithm": config["algorithm"]}
        if self.args.eval_frequency is None:
            self.args.eval_frequency = old["eval_frequency"]
        new = {"algorithm": algorithm} | asdict(self.args)
        new = {name: new[name] for name in new if name not in noisy.MAY_DIFFER_IN_A_RUN}
        differ = [f"{name} {old[name]}, not {new[name]}" for name in new if old[name] != new[name]]
        if algorithm != old["algorithm"]:
            differ = differ[:1]  # others may be due to the scripts' defaults
        if differ:
            advice = "choose another --exp-name or --runs-dir; --overwrite deletes that run"
            fail(f"{self.folder} holds a run with {'; '.join(differ)}: {advice}")
        return config

    def resume(self, state):
        """Restore the last checkpoint of the objects in a list; return its step, or 0."""
        self.state, args, step, sizes = state, self.args, 0, {}
        self.eval_csv = "step,episode,episodic_return,episodic_length\n"
        if self.checkpoint.exists():
            with self._reading(self.checkpoint):
                step, sizes = self._load()
            say(f"resumed at step {step}")
        self._write("config.json", json.dumps(self.config, indent=2) + "\n")
        self._write("eval.csv", self.eval_csv)
        with self._writing("events.*"):
            # what was logged after the checkpoint is removed, and purged by a TensorBoard that runs
            for path in self.folder.glob(self.EVENTS):
                if path.name in sizes:
                    os.truncate(path, min(path.stat().st_size, sizes[path.name]))
                else:
                    path.unlink()
            self.writer = SummaryWriter(str(self.folder), purge_step=step + 1)
        if step == 0:
            table = "".join(f"|{name}|{value}|\n" for name, value in asdict(args).items())
            self.writer.add_text("hyperparameters", "|param|value|\n|-|-|\n" + table)
            # for the table HPARAMS: what tells runs apart, and what they achieved
            columns = {"env_id": args.env_id, "exp_name": args.exp_name, "seed": args.seed}
            columns["noise"] = " + ".join(args.noise) or "none"
            columns["noise_rate"] = " + ".join(map(str, args.noise_rate)) or "none"
            metrics = "eval/episodic_return_mean", "charts/episodic_return", "eval/success_rate"
            for summary in hparams(columns, dict.fromkeys(metrics, 0))[:2]:
                self.writer.file_writer.add_summary(summary)
        self.bar = tqdm(total=args.total_timesteps, initial=step, file=sys.stdout, disable=None)
        self.saved_step, self.learning, self.last_test = step, None, ""
        self.printed = time.monotonic() - 1e-6
        self.begun = step, self.printed
        return step

    def _load(self):
        if zipfile.ZipFile(self.checkpoint).testzip():  # torch.load checks no checksums
            raise ValueError("it is damaged")
        checkpoint = torch.load(self.checkpoint, weights_only=True)
        if checkpoint["format"] != 5:
            raise ValueError("another version wrote it: finish the run with that version")
        if checkpoint["run"] != self.folder.name:
            raise ValueError(f"it belongs to {checkpoint['run']}")
        for part, state in zip(self.state, checkpoint["state"], strict=True):
            part.load_state_dict(state)
        torch.set_rng_state(checkpoint["torch"])
        self.eval_csv = checkpoint["eval_csv"]
        self.outcomes.extend(checkpoint.get("outcomes", []))
        self.start = time.monotonic() - checkpoint["seconds"]
        return checkpoint["step"], checkpoint["events"]

    def save(self, step):
        """Write a checkpoint: all that resuming needs, between two episodes."""
        with self._writing("events.*"):
            self.writer.flush()  # to be no older than the checkpoint
        checkpoint = {
            "format": 5,
            "run": self.folder.name,
            "step": step,
            "state": [part.state_dict() for part in self.state],
            "torch": torch.get_rng_state(),
            "eval_csv": self.eval_csv,
            "outcomes": list(self.outcomes),
            "events": {path.name: path.stat().st_size for path in self.folder.glob(self.EVENTS)},
            "seconds": time.monotonic() - self.start,
        }
        self._write("checkpoint.pt", checkpoint)
        self.saved_step = step

    def log(self, step, **groups):
        """Log numbers as group/name to TensorBoard, and the speed; show the progress."""
        tags = {f"{g}/{n}": float(x) for g, values in groups.items() for n, x in values.items()}
        now = time.monotonic()
        if "losses" in groups and self.learning:
            tags["charts/SPS"] = (step - self.learning[0]) / (now - self.learning[1])
        elif "losses" in groups:  # the first ones: the time until now went into compiling
            self.learning = step, now - 1e-6
        if not all(map(math.isfinite, tags.values())):
            reason = f"step {step}: training diverged, some values are not finite: {tags}"
            raise noisy.NotFiniteError(reason)
        with self._writing("events.*"):
            for tag, value in tags.items():
                self.writer.add_scalar(tag, value, step)
        step = max(step, self.bar.n)  # PPO logs a test under the step at which it fell due
        self.bar.update(step - self.bar.n)
        self.bar.n = step  # update() does nothing where there is no terminal
        learned = self.learning and step > self.learning[0]
        first_step, since = self.learning if learned else self.begun
        if self.bar.disable and now - self.printed > 10:
            total, sps = self.bar.total, (step - first_step) / (now - since)
            eta = tqdm.format_interval((total - step) / sps) if learned else "?"
            # analysis/folders.py reads this line
            say(f"step={step}/{total} sps={sps:.0f} {self.last_test}eta={eta}")
            self.printed = now

    def log_episode(self, step, info):
        """Log a training episode as the info of its last step tells it."""
        self.outcomes.append(noisy.outcome(info))
        charts = {"episodic_return": info["episode"]["r"], "episodic_length": info["episode"]["l"]}
        self.log(step, charts=charts | noisy.success_rate(self.outcomes))

    def log_test(self, step, results):
        """Log the (N, 3) returns, lengths and outcomes of a test that fell due at a step."""
        told = ",success\n" in self.eval_csv  # by the environment, in an earlier test
        success = noisy.success_rate(np.nan_to_num(results[:, 2]) if told else results[:, 2])
        if success and not told:  # earlier tests, of which it said nothing, were no success
            self.eval_csv = self.eval_csv.replace("\n", ",0\n").replace(",0", ",success", 1)
        for i, (episodic_return, length, outcome) in enumerate(results.tolist()):
            column = f",{outcome == 1:d}" if success else ""
            self.eval_csv += f"{step},{i},{episodic_return},{length:.0f}{column}\n"
        self._write("eval.csv", self.eval_csv)
        mean, length, _ = results.mean(0)
        std = results[:, 0].std(ddof=1) if len(results) > 1 else 0.0
        test = {"return_mean": mean, "return_std": std}
        self.result = {f"final_{name}": value for name, value in (test | success).items()}
        self.last_test, self.printed = f"eval_return={noisy.rounded(mean, std)} ", -math.inf
        self.last_test += "".join(f"{name}={rate:.2f} " for name, rate in success.items())
        self.bar.set_description_str(self.last_test)
        test["length_mean"] = length
        self.log(step, eval={f"episodic_{name}": x for name, x in test.items()} | success)

    def finish(self, step, policy):
        """Write policy.pt and, last of all, result.json; the checkpoint has served."""
        seconds = time.monotonic() - self.start
        with self._writing("events.*"):
            self.writer.file_writer.add_summary(hparams({}, {})[2])  # HPARAMS: success
            self.writer.close()
        self.result |= {
            "final_return_n": self.args.eval_episodes,
            "total_timesteps": self.args.total_timesteps,
            "trained_timesteps": step,  # PPO: whole rollouts
            "train_return_mean_last_100": np.mean(self.returns) if self.returns else None,
            "steps_per_second": step / seconds,
            "wall_time_seconds": seconds,
            "noise_applied_fraction": {n: w.applied_fraction for n, w in self.noise.items()},
            "noise_applied": {n: [w.times_applied, w.opportunities] for n, w in self.noise.items()},
        }
        self._write("policy.pt", policy)
        self._write("result.json", json.dumps(self.result, indent=2) + "\n")
        self.checkpoint.unlink(missing_ok=True)
        self.bar.close()
        self._say_finished()

    def _say_finished(self):
        mean, std = self.result["final_return_mean"], self.result["final_return_std"]
        text = f"{self.folder} is finished: mean test return {noisy.rounded(mean, std)}"
        rate = self.result.get("final_success_rate")
        say(text if rate is None else f"{text}, success rate {rate:.2f}")
        say(f"See its curves with: tensorboard --logdir {shlex.quote(self.args.runs_dir)}")

    def _reading(self, path):
        return fail_on(Exception, f"cannot read {path} (if damaged, --overwrite starts afresh)")

    def _writing(self, name):
        return fail_on((OSError, RuntimeError), f"cannot write {self.folder / name}", code=1)

    def _write(self, name, content):
        # whole or not at all: a kill or a full disk leaves the previous file
        temporary = (self.folder / name).with_suffix(".tmp")
        try:
            with self._writing(name), open(temporary, "wb") as file:
                if isinstance(content, str):
                    file.write(content.encode())
                else:
                    torch.save(content, file)
                file.flush()
                os.fsync(file.fileno())
                temporary.replace(self.folder / name)
        finally:
            temporary.unlink(missing_ok=True)


if __name__ == "__main__":
    stop = noisy.stop_at_signals()
    sys.path.append(os.getcwd())  # for what the module of --env-id module:Name-v0 imports
    finished = False
    try:
        with fail_on((noisy.NotFiniteError, noisy.SpaceError), "training stopped", code=1):
            finished = train(read_args(), stop)
    except Exception as error:
        if not stop():  # the environment's processes may have got the signal, too
            noisy.start_again_if_not_compiled(error)
            raise
    if not finished:
        say("stopped; run the same command again to resume")
        raise SystemExit(128 + stop())
