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
EVAL_FREQUENCY = 50_000  # default of --eval-frequency; at most a tenth of the run


@dataclass
class Args:
    """Command-line arguments; the algorithm's are those of CleanRL and the paper (Appendix A.2)."""

    env_id: str = "HalfCheetah-v5"  # RUN: Gymnasium environment, Name-v0, or module:Name-v0
    seed: int = 1  # seed of everything that is random
    total_timesteps: int = 1_000_000  # environment steps, rounded down to whole rollouts
    max_episode_steps: int | None = None  # time limit of an episode; None: the environment's own
    exp_name: str = Path(__file__).stem  # name of the experiment, part of the run folder's name
    runs_dir: str = "runs"  # folder in which the run's own folder is made
    overwrite: bool = False  # delete the files in the run's folder and start again
    checkpoint_frequency: int = 50_000  # environment steps between two checkpoints
    noise: tuple[str, ...] = ()  # NOISE: noises of the training environment; the baseline has none
    noise_rate: tuple[float | str, ...] = ()  # probability of each noise; 1.0:0.0 falls linearly
    eval_episodes: int = 10  # TESTS: episodes in each test
    eval_frequency: int | None = None  # steps between tests; None: up to 50,000; 0: only at the end

    cuda: bool = False  # SPEED: train on a GPU (not tested on one yet); these networks are small
    torch_threads: int = 1  # CPU threads; runs in parallel gain more than extra threads
    compile: bool = True  # compile the updates, if there is a C++ compiler
    # precision of float32 products, raised to highest where another would cost accuracy
    matmul_precision: Literal["highest", "medium"] = "highest"

    learning_rate: float = 3e-4  # ALGORITHM: learning rate of the optimizer
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
    """Make the clean environment: observations and actions are vectors, and every episode ends."""
    with fail_on(noisy.refusals(env_id), f"--env-id {env_id}"):
        env = gym.make(env_id, disable_env_checker=True, **kwargs)
        return noisy.make_flat(env, STEP_LIMIT)


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


class Saved:
    """Base of a class whose attributes, numbers and arrays, all go into a checkpoint."""

    def state_dict(self):
        """Return the attributes as tensors that share the arrays' memory."""
        return {name: torch.as_tensor(np.asarray(value)) for name, value in vars(self).items()}

    def load_state_dict(self, state):
        """Restore a state_dict."""
        vars(self).update({name: np.asarray(value)[()] for name, value in state.items()})


class Normalizer(Saved):
    """Running mean and variance of the samples so far, as in Gymnasium's Normalize wrappers."""

    def __init__(self, shape):
        # [()] makes a number of an array without dimensions, which is faster
        self.mean, self.var, self.count = np.zeros(shape)[()], np.ones(shape)[()], 1e-4

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


class Rollout(Saved):
    """T steps, and the observation after them."""

    def __init__(self, steps, env):
        self.observations = np.zeros((steps + 1, *env.observation_space.shape), np.float32)
        self.eps, self.actions = np.zeros((2, steps, *env.action_space.shape), np.float32)
        self.rewards, self.dones = np.zeros((2, steps), np.float32)  # done: ended in whatever way
        self.discounted_return = 0.0

    def state_dict(self):
        """Return the arrays as tensors that share their memory, and the discounted return."""
        return super().state_dict() | {"discounted_return": float(self.discounted_return)}


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


# LOSS: a pure function of the agent's parameters and a minibatch -> the loss, and curves


def ppo_loss(params, agent, minibatch, args):
    """Clipped surrogate, clipped value loss and entropy."""
    observations, actions, old_log_probs, advantages, returns, old_values = minibatch
    if args.norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
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


def updater(loss, network, optimizer, args):
    """Return update(*inputs) -> curves: one optimizer step on loss(network parameters, *inputs)."""
    parameters = dict(network.named_parameters())

    def clipped_gradient(parameters, *inputs):
        gradient, (_, curves) = grad_and_value(loss, has_aux=True)(parameters, *inputs)
        norm = torch.stack([value.norm() for value in gradient.values()]).norm()
        scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        return {name: value * scale for name, value in gradient.items()}, curves

    if args.compile:
        clipped_gradient = torch.compile(clipped_gradient, fullgraph=True, dynamic=False)

    def update(*inputs):
        gradient, curves = clipped_gradient(parameters, *inputs)
        for name, parameter in parameters.items():
            # contiguous: the fused Adam of PyTorch 2.13 misreads any other strides, in silence
            parameter.grad = gradient[name].contiguous()
        optimizer.step()
        return curves

    return update


def make_policy(agent, observation_stats, env):
    """Return the test policy, NumPy to NumPy: mean actions, observation statistics as they are."""
    act, normalize = in_numpy(agent.actor_mean), observation_stats.normalize
    return lambda observation: noisy.into_space(act(normalize(observation)), env.action_space)


def learn(args, env, test_env, stop):
    """Train one agent; return False if stop(), asked whenever an episode ends, ended it early."""
    torch.set_num_threads(args.torch_threads)
    device = torch.device("cuda" if args.cuda else "cpu")
    run = Run(args, "PPO", use_matmul_precision(args.matmul_precision, device), env)
    if run.is_finished:
        return True
    if remark := noisy.remark_on_bounds(args.env_id, env.action_space):
        say(remark)

    # SETUP: torch.func differentiates the losses, so autograd need not follow the networks
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)  # an environment may draw from it
    observation, _ = env.reset(seed=args.seed)
    total_steps = args.total_timesteps // args.num_steps * args.num_steps
    rollout = Rollout(args.num_steps, env)
    observation_stats, return_stats = Normalizer(observation.shape), Normalizer(())
    agent = Agent(env).requires_grad_(False).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    update = updater(ppo_loss, agent, optimizer, args)

    # RESUME: between two episodes an environment is no more than its EnvState
    state = [agent, optimizer, rollout, observation_stats, return_stats]
    start = run.resume([*state, noisy.EnvState(env, rng)])
    if start > 0:
        noisy.set_progress(env, start / total_steps)
        observation, _ = env.reset()

    act, std = in_numpy(agent.actor_mean), agent.actor_logstd.exp().cpu().numpy()
    observation_stats.update(observation)
    # one loop over steps and not two, over rollouts and steps: a run may resume within a rollout
    for global_step in range(start + 1, total_steps + 1):
        step = (global_step - 1) % args.num_steps
        if step == 0:
            rollout.eps[:] = torch.randn(rollout.eps.shape)

        # ACT: log-probabilities and values are computed later, for whole rollouts
        rollout.observations[step] = observation_stats.normalize(observation)
        rollout.actions[step] = act(rollout.observations[step]) + std * rollout.eps[step]

        # STEP
        action = noisy.into_space(rollout.actions[step], env.action_space)
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

        done = global_step == total_steps
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
                left = 1 - (global_step - args.num_steps) / total_steps
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
            charts = {"learning_rate": optimizer.param_groups[0]["lr"]}
            run.log(global_step, charts=charts, losses=curves, noise=noisy.noise_statistics(env))

            # TEST: if one fell due during the rollout; eval.csv has the step at which it fell due
            due = global_step - global_step % max(1, args.eval_frequency)
            if done or (args.eval_frequency > 0 and due > global_step - args.num_steps):
                policy = make_policy(agent, observation_stats, env)
                results = evaluate(policy, test_env, args.eval_episodes, stop)
                if results is None:
                    return False
                run.log_test(args.total_timesteps if done else due, results)

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
            noisy.set_progress(env, global_step / total_steps)
            observation, _ = env.reset()
            observation_stats.update(observation)

    saved = {"agent": agent.state_dict(), "observation_stats": observation_stats.state_dict()}
    run.finish(global_step, saved)
    return True


def load_policy(run_dir, env):
    """Return the policy of a finished run."""
    saved = torch.load(Path(run_dir, "policy.pt"), "cpu", weights_only=True)
    agent, observation_stats = Agent(env), Normalizer(env.observation_space.shape)
    agent.load_state_dict(saved["agent"])
    observation_stats.load_state_dict(saved["observation_stats"])
    return make_policy(agent.requires_grad_(False), observation_stats, env)


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
