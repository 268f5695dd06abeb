"""How fast the three scripts are, where the time goes, and how others compare on one CPU core.

    python bench.py                                    # the scripts on HalfCheetah and Humanoid
    python bench.py --algos sac --envs Hopper-v5 -- --no-compile    # after --: the scripts' flags
    python bench.py --against-cleanrl ../cleanrl --cleanrl-python ../cleanrl/.venv/bin/python
    python bench.py --against-sbx ../sbx/bin/python --against-checkout ../before
    python bench.py --jobs 2
    python bench.py --checkpoint

Every program runs with its defaults as a process of its own, with one thread, on one core, until
it has printed enough progress: ours and SBX through a hook, CleanRL of itself, every 100 steps
(PPO: every rollout). The reader notes when each line arrives; two of them give the steady speed,
without start-up, compilation and evaluation:
    SAC, TD3: learning starts after 1,000 random steps; 200 updates are left out, --steps measured
    PPO: three rollouts are left out, one measured for every 150 of --steps (1,500: ten)
`core` is the share of its core that the process got in that time: below 97 % the machine was not
quiet. --clock cpu counts only the time on the core, which other processes disturb less.

Without another mode, and with a full replay buffer, as at the end of a million steps:
    steps/s, start s    of an undisturbed run; seconds from command to first step
    act ... log         ms per step of a second run in which train() switches a clock at its labels
                        (# ACT, # STEP, ...) and around sampling and logging; env includes resets,
                        sample is PPO's advantages, in PPO act and env normalize observations
    MFLOP               the products of a step, counted from the shapes of the default networks
    GFLOP/s, peak       the rate of those products; the fastest product of two square matrices
                        (256 to 1024) in the same library at the same precision, and the share
    memory MB           the most that the process held

--against-... compares steps/s, in turn with ours, --pairs times: one ratio per pair, and the
median. CleanRL runs -v4 environments, as its pinned Gymnasium has no -v5. SBX gets the sizes of our
networks, batches and updates, no logging, and no observation and reward normalization in PPO,
which it leaves to a wrapper; XLA sees one core.
--jobs N compares N runs side by side, each on a core of its own, with one alone.
--checkpoint times the script's save_checkpoint with 100,000 and 1,000,000 transitions stored
(share: of the run's time, with one checkpoint every 50,000 steps).
"""

import argparse
import collections
import contextlib
import functools
import importlib
import inspect
import math
import json
import os
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE, ALGOS = Path(__file__).resolve().parent, ("sac", "td3", "ppo")
LEARNING_STARTS, BUFFER, CHECKPOINT_EVERY = 1_000, 1_000_000, 50_000
PHASES = ("act", "env", "store", "sample", "update", "log")
LABELS = {"ACT": "act", "STEP": "env", "STORE": "store", "LEARN": "update", "TEST": "env"}
LABELS |= {"LEARN: advantages": "sample"}
QUIET = {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "CUDA_VISIBLE_DEVICES": ""}
QUIET |= {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "JAX_PLATFORMS": "cpu"}


def fail(message, code=2):
    """Exit with one line."""
    print("error:", " ".join(str(message).split()), file=sys.stderr)
    raise SystemExit(code)


# COUNTING


def arithmetic(algo, observation, action):
    """Floating-point operations per step in the products of the default sizes, none wasted."""
    hidden = 64 if algo == "ppo" else 256

    def layers(inputs, outputs):
        return [(inputs, hidden), (hidden, hidden), (hidden, outputs)]

    def forward(network):
        return sum(2 * inputs * outputs for inputs, outputs in network)

    def backward(network):  # of every weight, and of the inputs of all layers but the first
        return 2 * forward(network) - 2 * network[0][0] * network[0][1]

    if algo == "ppo":  # acting, values and log-probabilities once, ten epochs
        actor, critic = layers(observation, action), layers(observation, 1)
        both = forward(actor) + forward(critic)
        return forward(actor) + both + 10 * (both + backward(actor) + backward(critic))
    actor = layers(observation, 2 * action if algo == "sac" else action)
    critic = layers(observation + action, 1)
    to_actions = forward(critic) - 2 * observation * hidden  # through a frozen critic
    update = forward(actor) + 4 * forward(critic) + 2 * backward(critic)
    if algo == "sac":  # one actor and one temperature update per step on average
        update += 2 * forward(actor) + backward(actor) + 2 * (forward(critic) + to_actions)
    else:  # an actor update every other step, through Q1
        update += (forward(actor) + backward(actor) + forward(critic) + to_actions) // 2
    return forward(actor) + 256 * update


# CHILDREN: what runs on the measured core


class Clock:
    """Time per phase: at every moment exactly one phase runs."""

    def __init__(self):
        self.phase = "env"
        self.restart()

    def restart(self):
        """Forget the past."""
        self.seconds, self.since = dict.fromkeys(PHASES, 0.0), time.perf_counter()

    def switch(self, phase):
        """End the running phase and start another; return the one that ended."""
        now = time.perf_counter()
        self.seconds[self.phase] += now - self.since
        ended, self.phase, self.since = self.phase, phase, now
        return ended

    def around(self, owner, name, phase):
        """Count a function's time as a phase of its own."""
        function = getattr(owner, name)

        @functools.wraps(function)
        def timed(*args, **kwargs):
            interrupted = self.switch(phase)
            try:
                return function(*args, **kwargs)
            finally:
                self.switch(interrupted)

        setattr(owner, name, timed)


def label_phases(source):
    """Turn the labels of a training loop into calls of switch(phase)."""

    def call(match):
        indent, text = match.groups()
        label = next(x for x in sorted(LABELS, key=len, reverse=True) if text.startswith(x))
        return f'{indent}switch("{LABELS[label]}")'

    return re.sub(rf"^( +)# ((?:{'|'.join(LABELS)})\b.*)$", call, source, flags=re.M)


def after(owner, name, action):
    """Have a method followed by action(self, *args)."""
    method = getattr(owner, name)

    @functools.wraps(method)
    def hooked(self, *args):
        result = method(self, *args)
        action(self, *args)
        return result

    setattr(owner, name, hooked)


def fill(buffer, rows):
    """Store random transitions, the end of an episode after every thousand."""
    import numpy as np

    shape = (1001, *buffer.observations.shape[1:])
    observations = np.random.default_rng(0).standard_normal(shape, np.float32)
    action = np.zeros(buffer.actions.shape[1:], np.float32)
    for i in range(rows):
        a, b = observations[i % 1000], observations[i % 1000 + 1]
        buffer.add(a, action, 0.0, b, False, i % 1000 == 999)


def load(folder, algo, rows, on_mark):
    """Import a script; it will call on_mark(step) as it starts (0) and whenever it logs losses."""
    sys.path.insert(0, folder)
    script, buffers = importlib.import_module(f"{algo}_continuous_noisy"), []

    def opened(*_):
        on_mark(0)
        for buffer in buffers:
            fill(buffer, int(rows))

    after(script.RunLog, "open", opened)
    after(script.RunLog, "losses", lambda log, step, *_: on_mark(step))
    if algo != "ppo":
        after(script.ReplayBuffer, "__init__", lambda buffer, *_: buffers.append(buffer))
    return script


def arguments(script, flags):
    """Parse a script's flags."""
    import tyro

    return tyro.cli(script.Args, args=flags)


def child_speed(folder, algo, rows, *flags):
    """Run a script undisturbed."""
    script = load(folder, algo, rows, lambda step: print("mark", step))
    script.train(arguments(script, flags))


def child_split(folder, algo, rows, first, last, *flags):
    """Run a script with a clock; print the result."""
    clock = Clock()

    def on_mark(step):
        print("mark", step)
        if step <= int(first):
            clock.restart()
        if step >= int(last):
            clock.switch(None)
            ms = {name: 1e3 * s / (step - int(first)) for name, s in clock.seconds.items()}
            print("result", json.dumps({"ms": ms, **machine_rate(), **sizes}))
            os._exit(0)

    script = load(folder, algo, rows, on_mark)
    args = arguments(script, flags)
    env = script.make_env(args.env_id)
    sizes = {"observation": env.observation_space.shape[0], "action": env.action_space.shape[0]}
    for name in ("losses", "scalars", "episode"):
        clock.around(script.RunLog, name, "log")
    if algo != "ppo":
        clock.around(script.ReplayBuffer, "sample", "sample")
    vars(script)["switch"] = clock.switch
    exec(label_phases(inspect.getsource(script.train)), vars(script))
    script.train(args)


def machine_rate():
    """The fastest product, in GFLOP/s, at the float32 precision that the run has set."""
    import torch

    rate = 0.0
    for n in (256, 512, 1024):
        a, b, out = torch.randn(3, n, n)
        for _ in range(20 * (1024 // n) ** 2):
            start = time.perf_counter()
            torch.mm(a, b, out=out)
            rate = max(rate, 2e-9 * n**3 / (time.perf_counter() - start))
    return {"peak": rate, "precision": torch.get_float32_matmul_precision()}


def child_checkpoint(folder, algo, rows, *flags):
    """Run a script to the end of its first episode; time its checkpoint there, three times."""
    script = load(folder, algo, rows, lambda step: print("mark", step))
    save = script.save_checkpoint

    def timed(run_dir, *args):
        seconds, before = [], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(3):
            start = time.perf_counter()
            save(run_dir, *args)
            seconds.append(time.perf_counter() - start)
        extra = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        result = {"seconds": statistics.median(seconds), "extra_mb": extra / 1024}
        result["mb"] = (run_dir / "checkpoint.pt").stat().st_size / 2**20
        print("result", json.dumps(result))
        os._exit(0)

    script.save_checkpoint = timed
    script.train(arguments(script, flags))


def child_sbx(algo, env_id):
    """Run SBX with our sizes; a mark as often as CleanRL prints one."""
    import gymnasium
    import numpy as np
    import sbx
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    class Mark(BaseCallback):
        def _on_step(self):
            if self.num_timesteps % stride(algo) == 0:
                print("mark", self.num_timesteps)
            return True

    env = gymnasium.make(env_id)
    width, shape = 64 if algo == "ppo" else 256, env.action_space.shape
    options = {"policy_kwargs": {"net_arch": [width, width]}, "learning_rate": 3e-4, "seed": 1}
    if algo == "ppo":  # tanh is its default
        options |= {"n_steps": 2048, "batch_size": 64, "n_epochs": 10}
    else:  # rectified linear units are its default
        options |= {"buffer_size": BUFFER, "batch_size": 256, "learning_starts": LEARNING_STARTS}
        options |= {"train_freq": 1, "gradient_steps": 1}
        options |= {"policy_delay": 1 if algo == "sac" else 2}
    if algo == "sac":
        options["qf_learning_rate"] = 1e-3
    if algo == "td3":
        options["action_noise"] = NormalActionNoise(np.zeros(shape), np.full(shape, 0.1))
    model = getattr(sbx, algo.upper())("MlpPolicy", env, **options)
    model.learn(1_000_000, callback=Mark())


CHILDREN = {"_speed": child_speed, "_split": child_split}
CHILDREN |= {"_checkpoint": child_checkpoint, "_sbx": child_sbx}


# MEASURING


def stride(algo):
    """Return the steps between two marks."""
    return 2048 if algo == "ppo" else 100


def window(algo, steps):
    """Return the steps at which measuring starts and ends."""
    if algo == "ppo":
        return 3 * 2048, (3 + max(1, steps // 150)) * 2048
    return LEARNING_STARTS + 200, LEARNING_STARTS + 200 + steps


def cpu_seconds(pid):
    """Return the time that all threads of a process have spent on a core."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Program:
    """A command to measure, with additions to its environment."""

    def __init__(self, name, algo, command, **environment):
        self.name, self.algo, self.command = name, algo, [str(word) for word in command]
        self.environment = os.environ | QUIET | environment
        self.every = stride(algo)
        self.first = self.every if algo == "ppo" else LEARNING_STARTS + self.every

    def run(self, core, last, together=None):
        """Run up to step `last`, or to a result -> {step: (wall, cpu)}, {"mb", "start", ...}."""
        marks, result, tail = {}, None, collections.deque(maxlen=3)
        os.sched_setaffinity(0, {core})  # of this thread, which the process inherits
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            process = subprocess.Popen(
                [word.replace("{folder}", folder) for word in self.command],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                cwd=folder,
                env=self.environment,
                start_new_session=True,
            )
            try:
                for line in process.stdout:
                    word, _, value = line.strip().partition(" ")
                    if word in ("mark", "SPS:"):  # SPS: CleanRL's, since learning starts
                        step = int(value) if word == "mark" else self.first + len(marks) * self.every
                        marks[step] = time.perf_counter(), cpu_seconds(process.pid)
                        if step >= last:
                            break
                    elif word == "result":
                        result = json.loads(value)
                        break
                    elif word:
                        tail.append(line)
                else:
                    fail(f"{self.name} {self.algo} ended early: {' '.join(tail)}", code=1)
                if together:  # the others are still measured, beside this one
                    together.wait()
            except BaseException:
                if together:
                    together.abort()
                raise
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.stdout.close()
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
        facts = {"mb": usage.ru_maxrss / 1024, "start": marks[0][0] - start if 0 in marks else None}
        return marks, facts | (result or {})


def speed(marks, algo, options):
    """Return steady steps per second, and the share of the core that the program had."""
    first = min(step for step in marks if step >= window(algo, options.steps)[0])
    (wall0, cpu0), (wall1, cpu1) = marks[first], marks[max(marks)]
    seconds = cpu1 - cpu0 if options.clock == "cpu" else wall1 - wall0
    return (max(marks) - first) / seconds, (cpu1 - cpu0) / (wall1 - wall0)


def our_program(algo, env_id, options, child="_speed", *numbers, folder=HERE, name="ours"):
    """Return one of the scripts, run by one of the children with its numbers."""
    starts, every = (1, 1) if child == "_checkpoint" else (LEARNING_STARTS, 10**9)
    flags = ["--env-id", env_id, "--runs-dir", "{folder}", "--eval-frequency", 0]
    flags += ["--checkpoint-frequency", every, "--eval-episodes", 1]
    flags += [] if algo == "ppo" else ["--learning-starts", starts]
    command = [sys.executable, __file__, child, folder, algo, *(numbers or [0])]
    return Program(name, algo, [*command, *flags, *options.flags])


def programs(algo, env_id, options):
    """Return ours and those it is compared with."""
    result = [our_program(algo, env_id, options)]
    if path := options.against_checkout:
        result.append(our_program(algo, env_id, options, folder=path, name="checkout"))
    if path := options.against_cleanrl:
        script = path / "cleanrl" / f"{algo}_continuous_action.py"
        command = [options.cleanrl_python, script, "--env-id", re.sub("-v5$", "-v4", env_id)]
        command += ["--no-cuda", *([] if algo == "ppo" else ["--learning-starts", LEARNING_STARTS])]
        result.append(Program("CleanRL", algo, command, PYTHONPATH=str(path)))
    if options.against_sbx:
        result.append(Program("SBX", algo, [options.against_sbx, __file__, "_sbx", algo, env_id]))
    return result


# MODES: each returns the rows of its table


def compare(algo, env_id, options):
    """Run ours and the others in turn."""
    runs, rows = programs(algo, env_id, options), []
    last, speeds = window(algo, options.steps)[1], {program.name: [] for program in runs}
    for _ in range(options.pairs):
        for program in runs:
            marks, _ = program.run(options.cores[0], last)
            sps, core = speed(marks, algo, options)
            speeds[program.name].append(sps)
            note(f"{algo} {env_id} {program.name}: {sps:.0f} steps/s, core {core:.0%}")
    for name, theirs in list(speeds.items())[1:]:
        ratios = [a / b for a, b in zip(speeds["ours"], theirs, strict=True)]
        row = {"algo": algo.upper(), "env": env_id, "ours": speeds["ours"], "against": name}
        rows.append(row | {"steps/s": theirs, "ratios": ratios, "median": median(ratios)})
    return rows


def side_by_side(algo, env_id, options):
    """Run one alone and several together, in turn."""
    program, last = our_program(algo, env_id, options), window(algo, options.steps)[1]
    alone, together = [], []
    for _ in range(options.pairs):
        for jobs, speeds in ((1, alone), (options.jobs, together)):
            barrier = threading.Barrier(jobs)
            cores = [options.cores[i % len(options.cores)] for i in range(jobs)]
            with ThreadPoolExecutor(jobs) as pool:
                runs = list(pool.map(lambda core, b=barrier: program.run(core, last, b), cores))
            speeds.append(sum(speed(marks, algo, options)[0] for marks, _ in runs))
            note(f"{algo} {env_id} {jobs} jobs: {speeds[-1]:.0f} steps/s")
    efficiency = [b / (a * options.jobs) for a, b in zip(alone, together, strict=True)]
    row = {"algo": algo.upper(), "env": env_id, "jobs": options.jobs, "alone": alone}
    return [row | {"together": together, "efficiency": efficiency, "median": median(efficiency)}]


def checkpoint(algo, env_id, options):
    """Time the checkpoints."""
    marks, _ = our_program(algo, env_id, options).run(
        options.cores[0], window(algo, options.steps)[1]
    )
    sps, rows = speed(marks, algo, options)[0], []
    for stored in (0,) if algo == "ppo" else (BUFFER // 10, BUFFER):
        program = our_program(algo, env_id, options, "_checkpoint", stored)
        result = program.run(options.cores[0], math.inf)[1]
        share = result["seconds"] / (result["seconds"] + CHECKPOINT_EVERY / sps)
        row = {"algo": algo.upper(), "env": env_id, "transitions": stored, "MB": result["mb"]}
        row |= {"seconds": result["seconds"], "share %": 100 * share, "steps/s": sps}
        rows.append(row | {"extra memory MB": result["extra_mb"]})
        note(f"{algo} {env_id} {stored} transitions: {result['seconds']:.2f} s")
    return rows


def profile(algo, env_id, options):
    """Measure the speed, then where the time goes."""
    first, last = window(algo, options.steps)
    marks, facts = our_program(algo, env_id, options, "_speed", BUFFER).run(options.cores[0], last)
    sps, core = speed(marks, algo, options)
    program = our_program(algo, env_id, options, "_split", BUFFER, first, last)
    split = program.run(options.cores[0], math.inf)[1]
    flop = arithmetic(algo, split["observation"], split["action"])
    row = {"algo": algo.upper(), "env": env_id, "steps/s": sps, "core %": 100 * core}
    row |= {"start s": facts["start"], **split["ms"], "MFLOP": flop / 1e6}
    row |= {"GFLOP/s": flop * sps / 1e9, "peak": split["peak"], "precision": split["precision"]}
    row |= {"share %": flop * sps / 1e7 / split["peak"], "memory MB": facts["mb"]}
    note(f"{algo} {env_id}: {sps:.0f} steps/s")
    return [row]


def median(values):
    """Return the median."""
    return statistics.median(values)


def note(text):
    """Tell whoever waits."""
    print(text, file=sys.stderr)


def table(rows):
    """Return rows, dicts with the same keys, as text."""

    def cell(value):
        if isinstance(value, list):
            return " ".join(map(cell, value))
        if isinstance(value, float):
            return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
        return "-" if value is None else str(value)

    lines = [list(rows[0])] + [[cell(value) for value in row.values()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    left = [isinstance(value, str) for value in rows[0].values()]
    return "\n".join(
        "  ".join(
            text.ljust(width) if is_left else text.rjust(width)
            for text, width, is_left in zip(line, widths, left, strict=True)
        ).rstrip()
        for line in lines
    )


def parse(argv):
    """Return the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.error = fail
    parser.add_argument("--algos", nargs="+", choices=ALGOS, default=ALGOS)
    parser.add_argument("--envs", nargs="+", default=["HalfCheetah-v5", "Humanoid-v5"])
    parser.add_argument("--steps", type=int, default=1500, help="learning steps measured")
    parser.add_argument("--core", type=int, help="the CPU core (default: the last one)")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--pairs", type=int, default=3, help="runs of each program")
    parser.add_argument("--against-cleanrl", type=Path, metavar="PATH", help="CleanRL's checkout")
    parser.add_argument("--cleanrl-python", metavar="PYTHON", help="with what CleanRL needs")
    parser.add_argument("--against-sbx", metavar="PYTHON", help="one with sbx-rl installed")
    parser.add_argument("--against-checkout", type=Path, metavar="PATH", help="other scripts")
    parser.add_argument("--jobs", type=int, metavar="N", help="runs side by side")
    parser.add_argument("--checkpoint", action="store_true", help="size and time of checkpoints")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    split = argv.index("--") if "--" in argv else len(argv)
    options = parser.parse_args(argv[:split])
    options.flags = argv[split + 1 :]

    cores = sorted(os.sched_getaffinity(0))
    if options.core not in (None, *cores):
        fail(f"--core must be one of {', '.join(map(str, cores))}, not {options.core}")
    first = cores.index(options.core) if options.core is not None else len(cores) - 1
    options.cores = cores[first:] + cores[:first]
    for name, low in (("steps", 100), ("pairs", 1), ("jobs", 2)):
        if (value := getattr(options, name)) is not None and value < low:
            fail(f"--{name} must be at least {low}, not {value}")
    for name in ("cleanrl_python", "against_sbx"):
        if (value := getattr(options, name)) and not shutil.which(value):
            fail(f"--{name.replace('_', '-')} {value}: not a program")
    if bool(options.against_cleanrl) != bool(options.cleanrl_python):
        fail("--against-cleanrl and --cleanrl-python go together")
    for name, file in (
        ("cleanrl", "cleanrl/sac_continuous_action.py"),
        ("checkout", "sac_continuous_noisy.py"),
    ):
        path = getattr(options, f"against_{name}")
        if path and not (path / file).is_file():
            fail(f"--against-{name} {path}: no {file} there")
    return options


def main(argv):
    """Measure and print."""
    options = parse(argv)
    against = options.against_cleanrl or options.against_sbx or options.against_checkout
    modes = [compare] if against else []
    modes += [side_by_side] if options.jobs else []
    modes += [checkpoint] if options.checkpoint else []
    figures = {}
    for mode in modes or [profile]:
        cases = [(algo, env_id) for algo in options.algos for env_id in options.envs]
        figures[mode.__name__] = rows = [row for case in cases for row in mode(*case, options)]
        print(table(rows), flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in CHILDREN:
        CHILDREN[sys.argv[1]](*sys.argv[2:])
    else:
        main(sys.argv[1:])
