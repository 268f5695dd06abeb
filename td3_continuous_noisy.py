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
EVAL_FREQUENCY = 10_000  # default of --eval-frequency, or a tenth of the run if that is less


@dataclass
class Args:
    """Command-line arguments, CleanRL's and those of noise; --help shows their comments."""

    # RUN
    env_id: str = "HalfCheetah-v5"  # Gymnasium environment, Name-v0, or module:Name-v0
    seed: int = 1  # seed of everything that is random
    total_timesteps: int = 1_000_000  # environment steps to train for
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
    eval_frequency: int | None = None  # steps between tests; None: 10,000 or less; 0: only the last
    keep_policies: bool = False  # keep the policy of every test as policy_STEP.pt

    # SPEED
    cuda: bool = False  # train on a GPU (not tested on one yet); these networks are small
    torch_threads: int = 1  # CPU threads; runs in parallel gain more than extra threads
    compile: bool = True  # compile the updates, if there is a C++ compiler
    # medium: faster kernels, where they round no more than highest; bf16: much faster, but rounds
    matmul_precision: Literal["highest", "medium", "bf16"] = "medium"

    # ALGORITHM
    buffer_size: int = 1_000_000  # rows; a step takes one, an episode's last observation another
    gamma: float = 0.99  # discount factor
    tau: float = 0.005  # target smoothing coefficient
    batch_size: int = 256  # transitions in a minibatch
    learning_starts: int = 25_000  # environment steps with random actions before learning starts
    learning_rate: float = 3e-4  # learning rate of the policy and of the Q-functions
    policy_frequency: int = 2  # environment steps between two updates of the policy and the targets
    exploration_noise: float = 0.1  # std of the noise on training actions, in half action ranges
    policy_noise: float = 0.2  # std of the noise on the target's actions, in half action ranges
    noise_clip: float = 0.5  # largest noise on the target's actions, in half action ranges


def make_env(env_id, **kwargs):
    """Make an environment of vectors, still without noise: make_environments() adds that."""
    env = gym.make(env_id, disable_env_checker=True, **kwargs)  # make_flat() checks every step
    return noisy.make_flat(env)


def mlp(inputs, outputs):
    """Two hidden layers of 256 rectified linear units."""
    hidden = [nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()]
    return nn.Sequential(*hidden, nn.Linear(256, outputs))


class Critic(nn.Module):
    """Two Q-functions of observations (B, O) and actions (B, A)."""

    def __init__(self, env):
        super().__init__()
        inputs = env.observation_space.shape[0] + env.action_space.shape[0]
        self.networks = nn.ModuleList([mlp(inputs, 1), mlp(inputs, 1)])

    def forward(self, observations, actions):
        """Return a list of the values (B,) of each Q-function."""
        inputs = torch.cat([observations, actions], 1)
        return [network(inputs).squeeze(1) for network in self.networks]


class Actor(nn.Module):
    """A deterministic policy, squashed to the bounds of the action space."""

    def __init__(self, env):
        super().__init__()
        low, high = torch.Tensor(env.action_space.low), torch.Tensor(env.action_space.high)
        self.network = mlp(env.observation_space.shape[0], len(low))
        self.action_space = env.action_space
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("action_scale", (high - low) / 2)
        self.register_buffer("action_bias", (high + low) / 2)

    def forward(self, observations, eps=0.0):
        """Return actions (B, A), within the bounds; eps (B, A) is added before the scaling."""
        actions = torch.tanh(self.network(observations)) + eps
        actions = actions * self.action_scale + self.action_bias
        return torch.clamp(actions, self.low, self.high)

    @torch.no_grad()
    def policy(self, observation, eps=0.0):
        """Return the action for one observation, NumPy to NumPy; eps as in forward()."""
        device = self.action_scale.device
        observations = torch.as_tensor(observation, dtype=torch.float32, device=device)[None]
        return noisy.into_space(self(observations, eps)[0].cpu().numpy(), self.action_space)


class ReplayBuffer:
    """The latest steps, in a ring; the next observation of row i is the observation of row i + 1.

    The final observation of an episode has a row, too: it is no step, so it is never drawn.
    """

    def __init__(self, rows, env):
        self.rows, self.position, self.size = rows, 0, 0
        self.observations = np.zeros((rows, *env.observation_space.shape), np.float32)
        self.actions = np.zeros((rows, *env.action_space.shape), np.float32)
        self.rewards, self.terminated = np.zeros(rows, np.float32), np.zeros(rows, np.float32)
        self.is_step = np.zeros(rows, bool)

    def add(self, observation, action, reward, next_observation, terminated, truncated):
        """Store a step in place of the oldest one; after an episode, skip its final observation."""
        row, next_row = self.position, (self.position + 1) % self.rows
        self.observations[row], self.observations[next_row] = observation, next_observation
        self.actions[row], self.rewards[row], self.terminated[row] = action, reward, terminated
        self.is_step[row], self.is_step[next_row] = True, False
        self.position = (next_row + int(terminated or truncated)) % self.rows
        self.size = max(self.size, row + 1, next_row + 1)

    def sample(self, batch_size, rng):
        """Draw (s, a, r, s', terminated) uniformly: float32 tensors with batch_size rows."""
        rows = rng.integers(self.size, size=batch_size)
        while not self.is_step[rows].all():  # draw the other rows again
            rows = np.where(self.is_step[rows], rows, rng.integers(self.size, size=batch_size))
        batch = [self.observations[rows], self.actions[rows], self.rewards[rows]]
        batch += [self.observations[(rows + 1) % self.rows], self.terminated[rows]]
        return [torch.from_numpy(array) for array in batch]

    def _arrays(self):
        """Return {name: array} of all arrays with a row for each step, also of those you add."""
        arrays = {name: x for name, x in vars(self).items() if isinstance(x, np.ndarray)}
        return {name: x for name, x in arrays.items() if x.shape[:1] == (self.rows,)}

    def state_dict(self):
        """Return the filled rows, as tensors: torch.save() writes these without copying them."""
        state = {name: torch.from_numpy(x[: self.size]) for name, x in self._arrays().items()}
        return state | {"position": self.position, "size": self.size}

    def load_state_dict(self, state):
        """Copy the rows of a state_dict back."""
        self.position, self.size = state["position"], state["size"]
        for name, array in self._arrays().items():
            array[: self.size] = state[name].numpy()


# LOSSES. Each returns (loss, {curve: value}). updater() differentiates it with respect to the
# parameters of the first argument, and of no other network.


def critic_loss(critic, target_critic, target_actor, batch, eps, gamma):
    """Mean squared error of Q1 and Q2 to y = r + gamma min(Q1', Q2')(s', pi'(s') + eps)."""
    observations, actions, rewards, next_observations, terminated = batch
    next_q1, next_q2 = target_critic(next_observations, target_actor(next_observations, eps))
    next_values = torch.minimum(next_q1, next_q2)
    y = (rewards + (1 - terminated) * gamma * next_values).detach()
    q1, q2 = critic(observations, actions)
    qf1_loss, qf2_loss = (q1 - y).square().mean(), (q2 - y).square().mean()
    loss = qf1_loss + qf2_loss
    values = {"qf1_values": q1.mean(), "qf2_values": q2.mean()}
    losses = {"qf1_loss": qf1_loss, "qf2_loss": qf2_loss, "qf_loss": loss / 2}
    return loss, values | losses


def actor_loss(actor, critic, observations):
    """The mean of -Q1(s, pi(s))."""
    q1, _ = critic(observations, actor(observations))
    loss = -q1.mean()
    return loss, {"actor_loss": loss}


@torch.no_grad()  # only the functions that updater() returns compute gradients
def learn(args, env, test_env, stop):
    """Train in the noisy `env` and test in `test_env`; return False if stop() ended it early."""
    if not noisy.is_bounded(env.action_space):
        fail(f"TD3 needs bounded actions; some actions of {args.env_id} are unbounded")
    if args.learning_starts >= args.total_timesteps:
        fail(f"--learning-starts must be below --total-timesteps, {args.total_timesteps}")
    with fail_on(MemoryError, f"--buffer-size {args.buffer_size}"):
        buffer = ReplayBuffer(args.buffer_size + 1, env)  # one for the next observation
    device = torch.device("cuda" if args.cuda else "cpu")
    run = Run(args, env)
    if run.is_finished:
        return True

    # SETUP
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env.action_space.seed(args.seed)
    observation, _ = env.reset(seed=args.seed)
    actor, critic = Actor(env).to(device), Critic(env).to(device)
    target_actor, target_critic = Actor(env).to(device), Critic(env).to(device)
    target_actor.load_state_dict(actor.state_dict())
    target_critic.load_state_dict(critic.state_dict())
    q_optimizer = torch.optim.Adam(critic.parameters(), lr=args.learning_rate, fused=True)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=args.learning_rate, fused=True)
    update_critic = updater(critic_loss, critic, q_optimizer, args)
    update_actor = updater(actor_loss, actor, actor_optimizer, args)
    online_parameters = [*actor.parameters(), *critic.parameters()]
    target_parameters = [*target_actor.parameters(), *target_critic.parameters()]

    # RESUME: all that training changes belongs in `state`. What is missing there starts anew when a
    # run is resumed: tools/check_script.py finds it. Random numbers are drawn on the CPU, because
    # the generator of a GPU is not saved.
    state = {"actor": actor, "critic": critic, "buffer": buffer, "env": noisy.EnvState(env, rng)}
    state |= {"target_actor": target_actor, "target_critic": target_critic}
    state |= {"q_optimizer": q_optimizer, "actor_optimizer": actor_optimizer}
    start = run.resume(state)
    if start > 0:  # the checkpoint was written between two episodes
        noisy.set_progress(env, start / args.total_timesteps)  # for rates that change
        observation, _ = env.reset()

    curves = {}  # the latest value of each
    for global_step in range(start + 1, args.total_timesteps + 1):
        # ACT
        if global_step <= args.learning_starts:
            action = env.action_space.sample()
        else:
            eps = args.exploration_noise * torch.randn(env.action_space.shape).to(device)
            action = actor.policy(observation, eps)

        # STEP
        next_observation, reward, terminated, truncated, info = env.step(action)

        # STORE: only `terminated` ends the values; after a time limit they go on
        buffer.add(observation, action, reward, next_observation, terminated, truncated)
        observation = next_observation

        is_last = global_step == args.total_timesteps
        if global_step > args.learning_starts:
            # LEARN: critic
            batch = [tensor.to(device) for tensor in buffer.sample(args.batch_size, rng)]
            observations, actions = batch[:2]
            eps = args.policy_noise * torch.randn(actions.shape).to(device)
            eps = eps.clamp(-args.noise_clip, args.noise_clip)
            curves |= update_critic(target_critic, target_actor, batch, eps, args.gamma)

            # LEARN: actor and targets
            if global_step % args.policy_frequency == 0:
                curves |= update_actor(critic, observations)
                for param, target_param in zip(online_parameters, target_parameters, strict=True):
                    target_param.lerp_(param, args.tau)  # target += tau * (online - target)

            if is_last or global_step % 100 == 0:
                run.log(global_step, losses=curves, noise=noisy.noise_statistics(env))

        # TEST
        if is_last or (args.eval_frequency > 0 and global_step % args.eval_frequency == 0):
            results = noisy.play(test_env, actor.policy, args.eval_episodes, TEST_SEED)
            run.log_test(global_step, results, {"actor": actor.state_dict()})

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
            noisy.set_progress(env, global_step / args.total_timesteps)
            observation, _ = env.reset()

    run.finish(global_step)
    return True


def load_policy(run_dir, env=None):
    """Return the policy of a run's last test; `env` is for runs of this project's version 0.3."""
    config = json.loads(Path(run_dir, "config.json").read_text())
    actor = Actor(env or noisy.Spaces(config))
    saved = read_state(Path(run_dir, "policy.pt"))
    actor.load_state_dict(saved.get("actor", saved))  # version 0.3 saved the actor alone
    return actor.policy


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
    gradient_of = grad_and_value(call, has_aux=True)
    gradient_of = compiled(gradient_of) if args.compile else gradient_of
    device = next(network.parameters()).device
    precision = torch.autocast(device.type, torch.bfloat16, enabled=args.matmul_precision == "bf16")

    def update(*inputs):
        learned = {name: p for name, p in parameters.items() if p.requires_grad}  # not frozen
        # a compiled graph takes a Python number as a constant, and is compiled again for another
        numbers = (int, float, np.float32, np.float64, np.int32, np.int64)  # bools stay: `if flag`
        inputs = [torch.tensor(float(x)) if type(x) in numbers else x for x in inputs]
        with precision:
            gradient, (_, curves) = gradient_of(learned, tuple(inputs))
        for name, parameter in parameters.items():
            value = gradient.get(name)  # None: frozen
            # the fused Adam of PyTorch 2.13 silently misreads gradients of another memory layout
            if value is not None and value.stride() != parameter.stride():
                value = torch.empty_like(parameter).copy_(value)
            parameter.grad = value
        # Intel's processors are slow with 1e-45, the momentum of dead units: flush it here
        torch.set_flush_denormal(True)
        optimizer.step()
        torch.set_flush_denormal(False)
        return curves

    return update


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
