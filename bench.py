"""How fast the three scripts are, where the time goes, and how others compare on one CPU core.

    python bench.py                                    # the scripts on HalfCheetah and Humanoid
    python bench.py --algos sac --envs Hopper-v5 -- --no-compile    # after --: the scripts' flags
    python bench.py --against-cleanrl ../cleanrl --cleanrl-python ../cleanrl/.venv/bin/python
    python bench.py --against-sbx ../sbx/bin/python --against-checkout ../before
    python bench.py --jobs 2
    python bench.py --checkpoint

Every program is a process with one thread on one core, with its defaults. It prints a line every
100 steps (PPO: every rollout): CleanRL of itself, ours and SBX through a hook. Here the lines get
their times, and two lines give a speed without start-up, compilation and evaluation:
    SAC, TD3: learning starts after 1,000 steps; 200 updates are left out, --steps measured
    PPO: three rollouts are left out, and one measured for every 150 of --steps (1,500: ten)
"core" is the share of the core that the process got meanwhile; below 97 % the machine was not
quiet. With --clock cpu only time on the core counts, which depends less on other processes.

Without another mode, and with a full replay buffer, as at the end of a million steps:
    steps/s, start s   of an undisturbed run; seconds from command to first step
    act ... log        ms per step of a second run, whose train() switches a clock at its labels
                       (# ACT, # STEP, ...) and around sampling and logging; env includes resets;
                       PPO's sample is the advantages; its act and env normalize observations
    MFLOP, GFLOP/s     the products of a step, counted from the layer shapes; their rate
    peak, share        GFLOP/s of the fastest product of square matrices (256 to 1024) in the same
                       library at the run's precision, and the share of it that is reached
    memory MB          the most that the process held

--against-... runs others in turn with ours, --pairs times: a ratio of steps/s for each pair, and
the median. CleanRL's pinned Gymnasium has -v4 environments (Humanoid-v4: 376 observations, -v5:
348). SBX gets the sizes of our networks, batches and updates; it logs nothing, and in PPO it
normalizes neither observations nor rewards.
--jobs N compares N runs side by side, on a core each, with one alone.
--checkpoint times save_checkpoint with 100,000 and 1,000,000 stored transitions; its share of the
time is that of one checkpoint in 50,000 steps.
"""

import argparse
import collections
import contextlib
import functools
import importlib
import inspect
import json
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median

HERE, ALGOS = Path(__file__).resolve().parent, ("sac", "td3", "ppo")
LEARNING_STARTS, BUFFER_SIZE, CHECKPOINT_FREQUENCY = 1_000, 1_000_000, 50_000
PHASES = ("act", "env", "store", "sample", "update", "log")
LABELS = {"ACT": "act", "STEP": "env", "STORE": "store", "LEARN: advantages": "sample"}
LABELS |= {"LEARN": "update", "TEST": "env"}  # the first that fits
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "CUDA_VISIBLE_DEVICES": ""}
ENVIRONMENT |= {"JAX_PLATFORMS": "cpu"}  # whose threads are as many as the process has cores


def fail(message, code=2):
    """Exit with one line."""
    print("error:", " ".join(str(message).split()), file=sys.stderr)
    raise SystemExit(code)


def arithmetic(algo, observation, action):
    """Floating-point operations per step in the products of the default sizes, none wasted."""
    hidden = 64 if algo == "ppo" else 256

    def layers(inputs, outputs):
        return [(inputs, hidden), (hidden, hidden), (hidden, outputs)]

    def forward(network):
        return sum(2 * inputs * outputs for inputs, outputs in network)

    def backward(network):  # to every weight, and to the inputs of all layers but the first
        return 2 * forward(network) - 2 * network[0][0] * network[0][1]

    if algo == "ppo":  # acting, values and log-probabilities once, ten epochs
        actor, critic = layers(observation, action), layers(observation, 1)
        both = forward(actor) + forward(critic)
        return forward(actor) + both + 10 * (both + backward(actor) + backward(critic))
    actor = layers(observation, 2 * action if algo == "sac" else action)
    critic = layers(observation + action, 1)
    to_action = forward(critic) - 2 * observation * hidden  # back through a frozen critic
    update = forward(actor) + 4 * forward(critic) + 2 * backward(critic)
    if algo == "sac":  # one actor and one temperature update per step on average
        update += 2 * forward(actor) + backward(actor) + 2 * (forward(critic) + to_action)
    else:  # an actor update every other step, through Q1
        update += (forward(actor) + backward(actor) + forward(critic) + to_action) // 2
    return forward(actor) + 256 * update


# CHILDREN: what runs on the measured core; they use the script's own imports


class Clock:
    """Time per phase: at every moment exactly one phase runs."""

    def __init__(self, name):
        self.phase, self.now = "env", {"wall": time.perf_counter, "cpu": time.process_time}[name]
        self.restart()

    def restart(self):
        """Forget the past."""
        self.seconds, self.since = dict.fromkeys(PHASES, 0.0), self.now()

    def switch(self, phase):
        """End the running phase and begin another; return the one that ended."""
        now = self.now()
        self.seconds[self.phase] += now - self.since
        ended, self.phase, self.since = self.phase, phase, now
        return ended

    def around(self, owner, name, phase):
        """Make a method a phase of its own."""
        method = getattr(owner, name)

        @functools.wraps(method)
        def timed(*args, **kwargs):
            interrupted = self.switch(phase)
            result = method(*args, **kwargs)
            self.switch(interrupted)
            return result

        setattr(owner, name, timed)


def label_phases(source):
    """Turn the labels of a training loop into calls of switch(phase)."""

    def call(match):
        return f'{match[1]}switch("{LABELS[match[2]]}")'

    return re.sub(rf"^( +)# ({'|'.join(LABELS)})\b.*$", call, source, flags=re.M)


def after(owner, name, action):
    """Have a method followed by action(self, *args)."""
    method = getattr(owner, name)

    @functools.wraps(method)
    def hooked(*args):
        result = method(*args)
        action(*args)
        return result

    setattr(owner, name, hooked)


def load(folder, algo, stored, mark):
    """Import a script: it calls mark(0) as it starts, then stores transitions, mark(step) later."""
    sys.path.insert(0, folder)
    script, buffers = importlib.import_module(f"{algo}_continuous_noisy"), []

    def opened(*_):
        mark(0)
        for buffer in buffers:
            shape, action = (1001, *buffer.observations.shape[1:]), buffer.actions[0].copy()
            observations = script.np.random.default_rng(0).standard_normal(shape, script.np.float32)
            for i in range(int(stored)):
                j = i % 1000
                buffer.add(observations[j], action, 0.0, observations[j + 1], False, j == 999)

    after(script.RunLog, "open", opened)
    after(script.RunLog, "losses", lambda log, step, curves: mark(step))
    if algo != "ppo":
        after(script.ReplayBuffer, "__init__", lambda buffer, *_: buffers.append(buffer))
    return script


def print_mark(step):
    """Tell the parent how far the run is."""
    print("mark", step)


def finish(**result):
    """Tell the parent the result and end the process."""
    print("result", json.dumps(result))
    os._exit(0)


def child_speed(folder, algo, stored, *flags):
    """Run a script undisturbed."""
    script = load(folder, algo, stored, print_mark)
    script.train(script.tyro.cli(script.Args, args=flags))


def child_split(folder, algo, stored, first, last, clock, *flags):
    """Run a script with a clock between two steps."""
    clock, first, last = Clock(clock), int(first), int(last)

    def mark(step):
        if step <= first:
            clock.restart()
        elif step >= last:
            clock.switch("env")
            ms = {phase: 1e3 * s / (step - first) for phase, s in clock.seconds.items()}
            precision = script.use_matmul_precision(args.matmul_precision, "cpu")
            peak = peak_rate(script.torch, precision)
            finish(ms=ms, peak=peak, precision=precision, sizes=sizes)

    script = load(folder, algo, stored, mark)
    args = script.tyro.cli(script.Args, args=flags)
    env = script.make_env(args.env_id)
    sizes = (env.observation_space.shape[0], env.action_space.shape[0])
    for method in ("losses", "scalars", "episode"):
        clock.around(script.RunLog, method, "log")
    if algo != "ppo":
        clock.around(script.ReplayBuffer, "sample", "sample")
    script.switch = clock.switch
    exec(label_phases(inspect.getsource(script.train)), vars(script))
    script.train(args)


def peak_rate(torch, precision):
    """The fastest product, in GFLOP/s, at the precision of the run."""
    rate, dtype = 0.0, torch.bfloat16 if precision == "bf16" else torch.float32
    for n in (256, 512, 1024):
        a, b, out = torch.randn(3, n, n).to(dtype)
        for _ in range(20 * (1024 // n) ** 2):
            start = time.perf_counter()
            torch.mm(a, b, out=out)
            rate = max(rate, 2e-9 * n**3 / (time.perf_counter() - start))
    return rate


def child_checkpoint(folder, algo, stored, *flags):
    """Run a script up to its first checkpoint and write that three times."""
    script = load(folder, algo, stored, print_mark)
    save = script.save_checkpoint

    def memory():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    def timed(run_dir, *args):
        before, times = memory(), [time.perf_counter()]
        for _ in range(3):
            save(run_dir, *args)
            times.append(time.perf_counter())
        seconds = median(b - a for a, b in zip(times, times[1:], strict=False))
        size = (run_dir / "checkpoint.pt").stat().st_size / 2**20
        finish(seconds=seconds, size=size, extra=memory() - before)

    script.save_checkpoint = timed
    script.train(script.tyro.cli(script.Args, args=flags))


def child_sbx(algo, env_id):
    """Run SBX with our sizes; rectified linear units, PPO's tanh and the rest are its defaults."""
    import gymnasium
    import numpy as np
    import sbx
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    class Mark(BaseCallback):
        def _on_step(self):
            if self.num_timesteps % stride(algo) == 0:
                print_mark(self.num_timesteps)
            return True

    env = gymnasium.make(env_id)
    width, shape = 64 if algo == "ppo" else 256, env.action_space.shape
    options = {"policy_kwargs": {"net_arch": [width, width]}, "learning_rate": 3e-4, "seed": 1}
    if algo == "ppo":
        options |= {"n_steps": 2048, "batch_size": 64, "n_epochs": 10}
    else:
        options |= {"buffer_size": BUFFER_SIZE, "learning_starts": LEARNING_STARTS}
        options |= {"batch_size": 256, "train_freq": 1, "gradient_steps": 1}
    if algo == "sac":
        options |= {"policy_delay": 1, "qf_learning_rate": 1e-3}
    if algo == "td3":
        noise = NormalActionNoise(np.zeros(shape), np.full(shape, 0.1))
        options |= {"policy_delay": 2, "action_noise": noise}
    model = getattr(sbx, algo.upper())("MlpPolicy", env, **options)
    model.learn(1_000_000, callback=Mark())


CHILDREN = {"_speed": child_speed, "_split": child_split}
CHILDREN |= {"_checkpoint": child_checkpoint, "_sbx": child_sbx}


# MEASURING


def stride(algo):
    """Return the steps between two lines of a program."""
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
    """A command to measure, with additions to its environment variables."""

    def __init__(self, name, algo, command, **variables):
        self.name, self.algo, self.variables = name, algo, os.environ | ENVIRONMENT | variables
        self.command = [str(word) for word in command]

    def run(self, core, last=math.inf, barrier=None):
        """Run up to a step, or to the result -> ({step: (wall, cpu)}, {"memory", "start", ...})."""
        os.sched_setaffinity(0, {core})  # of this thread; the process inherits it
        marks, tail, result, start = {}, collections.deque(maxlen=60), {}, time.perf_counter()
        every, done = stride(self.algo), False
        first = every if self.algo == "ppo" else LEARNING_STARTS + every
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        with tempfile.TemporaryDirectory() as folder:
            process = subprocess.Popen(
                self.command, cwd=folder, env=self.variables, start_new_session=True, **streams
            )
            try:
                for line in process.stdout:
                    word, _, value = line.partition(" ")
                    if word in ("mark", "SPS:"):  # SPS: is CleanRL's, from the first update on
                        step = first + every * len(marks) if word == "SPS:" else int(value)
                        marks[step] = time.perf_counter(), cpu_seconds(process.pid)
                    elif word == "result":
                        result = json.loads(value)
                    else:
                        tail += re.findall(r"[^\s─│╭╮╰╯]+", line)  # no boxes
                    if done := bool(result) or max(marks, default=0) >= last:
                        break
                if barrier:  # go on until the others are measured
                    barrier.wait() if done else barrier.abort()
            except threading.BrokenBarrierError:
                raise SystemExit(1) from None  # another one has failed, and said so
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.stdout.close()
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
        if not done:
            bad_arguments = process.returncode == 2
            text = " ".join(tail).removeprefix("error: ")
            fail(f"{self.name} {self.algo}: {text}", code=2 if bad_arguments else 1)
        result |= {"memory": usage.ru_maxrss / 1024}
        return marks, result | {"start": marks[0][0] - start if 0 in marks else None}


def speed(marks, algo, options):
    """Return steady steps per second, and the share of the core that the program had."""
    first = min(step for step in marks if step >= window(algo, options.steps)[0])
    steps, times = max(marks) - first, zip(marks[max(marks)], marks[first], strict=True)
    wall, cpu = (end - start for end, start in times)
    return steps / (cpu if options.clock == "cpu" else wall), cpu / wall


def ours(algo, env_id, options, child, *numbers, name="ours", folder=HERE):
    """Return one of the scripts, run by one of the children."""
    starts, frequency = (1, 1) if child == "_checkpoint" else (LEARNING_STARTS, 10**9)
    flags = ["--env-id", env_id, "--eval-frequency", 0, "--checkpoint-frequency", frequency]
    flags += [] if algo == "ppo" else ["--learning-starts", starts]
    command = [sys.executable, __file__, child, folder.resolve(), algo, *numbers]
    return Program(name, algo, [*command, *flags, *options.flags])


def others(algo, env_id, options):
    """Return what ours is compared with."""
    if folder := options.against_checkout:
        yield ours(algo, env_id, options, "_speed", 0, name="checkout", folder=folder)
    if folder := options.against_cleanrl:
        script = folder.resolve() / "cleanrl" / f"{algo}_continuous_action.py"
        flags = ["--no-cuda", "--env-id", re.sub("-v5$", "-v4", env_id)]
        flags += [] if algo == "ppo" else ["--learning-starts", LEARNING_STARTS]
        command = [options.cleanrl_python, script, *flags]
        yield Program("CleanRL", algo, command, PYTHONPATH=str(folder.resolve()))
    if options.against_sbx:
        yield Program("SBX", algo, [options.against_sbx, __file__, "_sbx", algo, env_id])


# MODES: each returns rows of its table


def profile(algo, env_id, options):
    """Measure the speed, then where the time goes."""
    first, last = window(algo, options.steps)
    plain = ours(algo, env_id, options, "_speed", BUFFER_SIZE)
    marks, facts = plain.run(options.cores[0], last)
    split = ours(algo, env_id, options, "_split", BUFFER_SIZE, first, last, options.clock)
    _, where = split.run(options.cores[0])
    sps, core = speed(marks, algo, options)
    flop = arithmetic(algo, *where["sizes"])
    row = {"script": algo, "env_id": env_id, "steps/s": sps, "core %": 100 * core}
    row |= {"start s": facts["start"], **where["ms"], "MFLOP": flop / 1e6}
    row |= {"GFLOP/s": flop * sps / 1e9, "peak": where["peak"], "precision": where["precision"]}
    row |= {"share %": flop * sps / 1e7 / where["peak"], "memory MB": facts["memory"]}
    return [row]


def compare(algo, env_id, options):
    """Run ours and the others in turn."""
    programs = [ours(algo, env_id, options, "_speed", 0), *others(algo, env_id, options)]
    speeds = {program.name: [] for program in programs}
    for _ in range(options.pairs):
        for program in programs:
            marks, _ = program.run(options.cores[0], window(algo, options.steps)[1])
            sps, core = speed(marks, algo, options)
            note(f"{algo} {env_id} {program.name}: {sps:.0f} steps/s, core {core:.0%}")
            speeds[program.name].append(sps)
    rows = []
    for name, theirs in list(speeds.items())[1:]:
        ratios = [a / b for a, b in zip(speeds["ours"], theirs, strict=True)]
        row = {"script": algo, "env_id": env_id, "ours": speeds["ours"], "against": name}
        rows.append(row | {"steps/s": theirs, "ratios": ratios, "median": median(ratios)})
    return rows


def side_by_side(algo, env_id, options):
    """Run one alone and several together, in turn."""
    program, last = ours(algo, env_id, options, "_speed", 0), window(algo, options.steps)[1]
    speeds = {1: [], options.jobs: []}
    for jobs in (1, options.jobs) * options.pairs:
        run = functools.partial(program.run, last=last, barrier=threading.Barrier(jobs))
        cores = [options.cores[i % len(options.cores)] for i in range(jobs)]
        with ThreadPoolExecutor(jobs) as pool:
            speeds[jobs].append(sum(speed(m, algo, options)[0] for m, _ in pool.map(run, cores)))
        note(f"{algo} {env_id}, {jobs} at once: {speeds[jobs][-1]:.0f} steps/s")
    alone, together = speeds.values()
    efficiency = [b / (a * options.jobs) for a, b in zip(alone, together, strict=True)]
    row = {"script": algo, "env_id": env_id, "alone": alone, f"{options.jobs} jobs": together}
    return [row | {"efficiency": efficiency, "median": median(efficiency)}]


def checkpoint(algo, env_id, options):
    """Time the checkpoints."""
    core, last, rows = options.cores[0], window(algo, options.steps)[1], []
    sps, _ = speed(ours(algo, env_id, options, "_speed", 0).run(core, last)[0], algo, options)
    for stored in (0,) if algo == "ppo" else (BUFFER_SIZE // 10, BUFFER_SIZE):
        _, result = ours(algo, env_id, options, "_checkpoint", stored).run(core)
        share = 100 / (1 + CHECKPOINT_FREQUENCY / sps / result["seconds"])
        row = {"script": algo, "env_id": env_id, "stored": stored, "MB": result["size"]}
        row |= {"seconds": result["seconds"], "steps/s": sps, "share %": share}
        rows.append(row | {"extra memory MB": result["extra"]})
    return rows


def note(text):
    """Tell whoever waits."""
    print(text, file=sys.stderr)


def table(rows):
    """Return dicts with the same keys as text in columns."""

    def cell(value):
        if isinstance(value, list):
            return " ".join(map(cell, value))
        if isinstance(value, float):
            return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
        return "-" if value is None else str(value)

    columns = [[name, *(cell(row[name]) for row in rows)] for name in rows[0]]
    padded = [[text.rjust(max(map(len, column))) for text in column] for column in columns]
    return "\n".join("  ".join(line) for line in zip(*padded, strict=True))


def parse(argv):
    """Return the options; what follows -- is for the scripts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.error = fail
    add = parser.add_argument
    add("--algos", nargs="+", choices=ALGOS, default=ALGOS)
    add("--envs", nargs="+", default=["HalfCheetah-v5", "Humanoid-v5"], metavar="ENV_ID")
    add("--steps", type=int, default=1500, help="learning steps measured")
    add("--core", type=int, help="the CPU core (default: the last)")
    add("--clock", choices=("wall", "cpu"), default="wall")
    add("--pairs", type=int, default=3, help="runs of each program that is compared")
    add("--against-cleanrl", type=Path, metavar="PATH", help="a checkout of CleanRL")
    add("--cleanrl-python", metavar="PYTHON", help="one with CleanRL's requirements")
    add("--against-sbx", metavar="PYTHON", help="one with sbx-rl")
    add("--against-checkout", type=Path, metavar="PATH", help="another version of the scripts")
    add("--jobs", type=int, metavar="N", help="runs side by side")
    add("--checkpoint", action="store_true", help="size and time of checkpoints")
    add("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    end = argv.index("--") if "--" in argv else len(argv)
    options = parser.parse_args(argv[:end])
    options.flags = argv[end + 1 :]

    cores = sorted(os.sched_getaffinity(0))
    if options.core not in (None, *cores):
        fail(f"--core must be one of {', '.join(map(str, cores))}, not {options.core}")
    first = len(cores) - 1 if options.core is None else cores.index(options.core)
    options.cores = cores[first:] + cores[:first]
    for name, low in (("steps", 100), ("pairs", 1), ("jobs", 2)):
        if (value := getattr(options, name)) is not None and value < low:
            fail(f"--{name} must be at least {low}, not {value}")
    if bool(options.against_cleanrl) != bool(options.cleanrl_python):
        fail("--against-cleanrl and --cleanrl-python go together")
    for name in ("cleanrl_python", "against_sbx"):
        if value := getattr(options, name):
            if not (found := shutil.which(value)):
                fail(f"--{name.replace('_', '-')}: {value} is not a program")
            setattr(options, name, os.path.abspath(found))  # the runs have a folder of their own
    if options.json and not options.json.parent.is_dir():
        fail(f"--json: there is no folder {options.json.parent}")
    files = {"cleanrl": "cleanrl/sac_continuous_action.py", "checkout": "sac_continuous_noisy.py"}
    for name, file in files.items():
        if (path := getattr(options, f"against_{name}")) and not (path / file).is_file():
            fail(f"--against-{name}: there is no {path / file}")
    return options


def main(argv):
    """Measure and print."""
    options, figures = parse(argv), {}
    against = (options.against_cleanrl, options.against_sbx, options.against_checkout)
    wanted = {compare: any(against), side_by_side: options.jobs, checkpoint: options.checkpoint}
    for mode in [mode for mode in wanted if wanted[mode]] or [profile]:
        rows = []
        for algo in options.algos:
            for env_id in options.envs:
                note(f"{mode.__name__} {algo} {env_id}")
                rows += mode(algo, env_id, options)
        print(table(rows), flush=True)
        figures[mode.__name__] = rows
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1] in CHILDREN:
        CHILDREN[sys.argv[1]](*sys.argv[2:])
    else:
        main(sys.argv[1:])
