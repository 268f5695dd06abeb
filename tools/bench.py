"""How fast the three scripts are on one CPU core, and how others compare.

    python tools/bench.py                              # the scripts on HalfCheetah and Humanoid
    python tools/bench.py --algos sac --envs Hopper-v5 -- --no-compile    # after --: scripts' flags
    python tools/bench.py --against-checkout ../before --clock cpu
    python tools/bench.py --against-cleanrl ../cleanrl --cleanrl-python ../cleanrl/.venv/bin/python
    python tools/bench.py --against-sbx ../sbx/bin/python
    python tools/bench.py --algos sac td3 --against-rltools ../rltools/bin/python

Every program is a process with one thread on one core (the last; `taskset` chooses another). It has
its defaults, but SAC and TD3 learn from step 1,000 on, and none tests its policy or saves. Whenever
it logs losses to TensorBoard (every 100 steps; PPO: after every rollout) it reports the time and
waits for its next turn. So each program starts once, reports three times to warm up, and then runs
in blocks of --seconds, of which --pairs are measured. A speed is the median of its blocks.

"core %" is the share of the core that the process got; below 97 the machine was busy.
With --clock cpu only time on the core counts, which depends less on other processes.
--against-... runs other programs and ours in turn, one block each. "ours / its" is the median of
the ratios of neighbouring blocks; "from" and "to" are the 95 % interval of this median, from six
pairs on. CleanRL's pinned Gymnasium has -v4 environments
(Humanoid-v4: 376 observations, -v5: 348). SBX gets the sizes of our networks, batches and updates;
it logs nothing, and in PPO it normalizes neither observations nor rewards. RLtools, SAC and TD3 in
C++, gets these sizes when it is compiled, and uses MKL if mkl and mkl-include are installed.
"""

import argparse
import contextlib
import csv
import itertools
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

PROJECT = Path(__file__).resolve().parent.parent
ALGOS = ("sac", "td3", "ppo")
LEARNING_STARTS = 1000  # random steps of SAC and TD3, fewer than by default: they are not measured
ROLLOUT = 2048  # the steps of PPO's rollout, the default of all programs here
TOTAL_TIMESTEPS = 10**9  # more than any program takes before it is ended


# CHILDREN: what runs on the measured core, in the interpreter of the measured program. They rely on
# nothing but its command line and the tags of its TensorBoard curves.


class Marks:
    """Tells the parent how far the program is, and lets it go on only when the parent says so."""

    def __init__(self):
        self.wall = self.cpu = 0.0  # seconds, without those of waiting
        self.wait()

    def wait(self):
        """Wait for the parent."""
        if not sys.stdin.readline():  # the parent is gone
            os._exit(1)
        self.resumed = time.perf_counter(), time.process_time()

    def mark(self, step):
        """Report that the program has reached a step, and wait."""
        self.wall += time.perf_counter() - self.resumed[0]
        self.cpu += time.process_time() - self.resumed[1]
        print("mark", json.dumps([step, self.wall, self.cpu]), flush=True)
        self.wait()


def child_script(script, *flags):
    """Run a script as the command line does, with a mark at every step that logs losses."""
    from torch.utils.tensorboard import SummaryWriter

    marks, last_step = Marks(), 0
    add_scalar = SummaryWriter.add_scalar

    def watched(self, tag, scalar_value, global_step=None, *args, **kwargs):
        nonlocal last_step
        if tag.startswith("losses/") and global_step != last_step:
            last_step = global_step
            marks.mark(global_step)
        add_scalar(self, tag, scalar_value, global_step, *args, **kwargs)

    SummaryWriter.add_scalar = watched
    sys.argv = [script, *flags]
    runpy.run_path(script, run_name="__main__")


def child_sbx(algo, env_id):
    """Run SBX with our sizes; those of batches and buffer, and activations, are its defaults."""
    import gymnasium
    import numpy as np
    import sbx
    from stable_baselines3.common.noise import NormalActionNoise

    marks = Marks()

    def callback(*_):
        if model.num_timesteps % (ROLLOUT if algo == "ppo" else 100) == 0:
            marks.mark(model.num_timesteps)
        return True

    env = gymnasium.make(env_id)
    width = 64 if algo == "ppo" else 256
    options = {"policy_kwargs": {"net_arch": [width, width]}, "learning_rate": 3e-4, "seed": 1}
    if algo != "ppo":
        options["learning_starts"] = LEARNING_STARTS
    if algo == "sac":
        options["qf_learning_rate"] = 1e-3
    if algo == "td3":
        mean = np.zeros(env.action_space.shape)
        options["action_noise"] = NormalActionNoise(mean, mean + 0.1)
    model = getattr(sbx, algo.upper())("MlpPolicy", env, **options)
    model.learn(TOTAL_TIMESTEPS, callback)


def child_rltools(algo, env_id):
    """Run RLtools, compiled for our sizes; its learning rates and the like are its defaults."""
    import gymnasium
    import rltools

    def make_env():
        env = gymnasium.wrappers.RescaleAction(gymnasium.make(env_id), -1, 1)
        env.reset(seed=1)
        return env

    marks, step, sizes = Marks(), 0, {"HIDDEN_DIM": 256, "BATCH_SIZE": 256}
    options = {f"{part}_{name}": n for part in ("ACTOR", "CRITIC") for name, n in sizes.items()}
    options |= {"N_WARMUP_STEPS": LEARNING_STARTS, "REPLAY_BUFFER_CAP": 10**6}
    make_module = {"sac": rltools.SAC, "td3": rltools.TD3}[algo]
    module = make_module(make_env, enable_evaluation=False, STEP_LIMIT=TOTAL_TIMESTEPS, **options)
    state = module.State(1)
    while not state.step():
        step += 1
        if step % 100 == 0 and step > LEARNING_STARTS:
            marks.mark(step)


def start_child(core, folder, child, *arguments):
    """Prepare this process before it imports any library, and become a child in a folder."""
    os.chdir(folder)
    os.sched_setaffinity(0, {int(core)})
    os.environ.update(OMP_NUM_THREADS="1", JAX_PLATFORMS="cpu")
    if "--cuda" not in arguments:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    of_script = os.path.dirname(arguments[0])
    sys.path[:1] = [of_script, os.path.dirname(of_script)]  # CleanRL's scripts import from its root
    CHILDREN[child](*arguments)


CHILDREN = {"_script": child_script, "_sbx": child_sbx, "_rltools": child_rltools}


# MEASURING


class Program(contextlib.AbstractContextManager):
    """A child in a process and a folder of its own."""

    def __init__(self, name, core, *arguments, python=sys.executable):
        self.name, self.speeds, self.shares = name, [], []
        self.step = self.wall = self.cpu = 0
        self.folder = tempfile.TemporaryDirectory()
        command = [str(word) for word in (python, __file__, core, self.folder.name, *arguments)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self.process = subprocess.Popen(command, text=True, start_new_session=True, **pipes)

    def __exit__(self, *_):
        """End it, wherever it is."""
        with self.process, contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.folder.cleanup()

    def read_mark(self):
        """Wait for the next mark; exit with what the program has printed if it ends before."""
        printed = []
        for line in self.process.stdout:
            word, _, value = line.partition(" ")
            if word == "mark":
                self.step, self.wall, self.cpu = json.loads(value)
                return
            printed.append(line)
        sys.exit(f"{''.join(printed)}error: {self.name} has ended")


def advance(*programs):
    """Let programs run at the same time, each to its next mark."""
    for program in programs:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and read_mark says why
            os.write(program.process.stdin.fileno(), b"go on\n")
    for program in programs:
        program.read_mark()


@contextlib.contextmanager
def started(programs):
    """Start programs one after another, run each until its speed is steady, and end all."""
    with contextlib.ExitStack() as stack:
        begun = []
        for program in map(stack.enter_context, programs):
            begun.append(program)
            for _ in range(3):  # then what is compiled is compiled
                advance(program)
        yield begun


def measure(options, *programs):
    """Run programs at the same time for a block, and add to the speeds of each."""
    before = [(program.step, program.wall, program.cpu) for program in programs]
    while programs[0].wall - before[0][1] < options.seconds:
        advance(*programs)
    for program, (step, wall, cpu) in zip(programs, before, strict=True):
        seconds = program.cpu - cpu if options.clock == "cpu" else program.wall - wall
        program.speeds.append((program.step - step) / seconds)
        program.shares.append((program.cpu - cpu) / (program.wall - wall))


def flags(algo, env_id):
    """Return the flags that our scripts and CleanRL's share."""
    shared = ["--env-id", env_id, "--total-timesteps", TOTAL_TIMESTEPS]
    return shared if algo == "ppo" else [*shared, "--learning-starts", LEARNING_STARTS]


def ours(algo, env_id, options, name="ours", folder=None, job=0):
    """Start one of this project's scripts, without tests and checkpoints."""
    core = options.cores[job % len(options.cores)]
    script = (folder or PROJECT).resolve() / f"{algo}_continuous_noisy.py"
    never_save = ["--eval-frequency", 0, "--checkpoint-frequency", TOTAL_TIMESTEPS]
    arguments = [*flags(algo, env_id), *never_save, *options.flags]
    return Program(name, core, "_script", script, *arguments)


def ours_and_others(algo, env_id, options):
    """Start one program after another."""
    core = options.cores[0]
    yield ours(algo, env_id, options)
    if options.against_checkout:
        yield ours(algo, env_id, options, "checkout", options.against_checkout)
    if options.against_cleanrl:
        script = options.against_cleanrl.resolve() / "cleanrl" / f"{algo}_continuous_action.py"
        arguments = [script, *flags(algo, env_id.replace("-v5", "-v4"))]
        python = options.cleanrl_python
        yield Program("CleanRL", core, "_script", *arguments, "--no-cuda", python=python)
    if options.against_sbx:
        yield Program("SBX", core, "_sbx", algo, env_id, python=options.against_sbx)
    if options.against_rltools and algo != "ppo":
        yield Program("RLtools", core, "_rltools", algo, env_id, python=options.against_rltools)


def store_blocks(algo, env_id, programs, path):
    """Add a row for each block to a csv file; blocks of one number were neighbours."""
    columns = ["script", "env_id", "program", "block", "steps_per_second", "core_share"]
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(columns)
        for program in programs:
            for block, speed in enumerate(program.speeds):
                figures = f"{speed:.5g}", f"{program.shares[block]:.3f}"
                writer.writerow([algo, env_id, program.name, block, *figures])


def compare(algo, env_id, options):
    """Run ours and the others, if there are any, alternately."""
    from scipy.stats import quantile_test  # here, since the children's interpreters may not have it

    rows = []
    with started(ours_and_others(algo, env_id, options)) as programs:
        for pair in range(options.pairs):
            in_turn = programs if pair % 2 == 0 else programs[::-1]  # each is first as often
            for program in in_turn:
                measure(options, program)
    if options.blocks:
        store_blocks(algo, env_id, programs, options.blocks)
    for program in programs:
        ratios = [a / b for a, b in zip(programs[0].speeds, program.speeds, strict=True)]
        low, high = quantile_test(ratios).confidence_interval()  # of the median
        row = {
            "script": algo,
            "env_id": env_id,
            "program": program.name,
            "steps/s": median(program.speeds),
            "core %": 100 * median(program.shares),
            "ours / its": median(ratios),
            "from": low,
            "to": high,
        }
        rows.append(row)
    return rows


def parse(argv):
    """Return the options; what follows -- is for the scripts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--algos", nargs="+", choices=ALGOS, default=ALGOS)
    add("--envs", nargs="+", default=["HalfCheetah-v5", "Humanoid-v5"], metavar="ENV_ID")
    add("--pairs", type=int, default=20, help="blocks of each program (default: 20)")
    add("--seconds", type=float, default=2.0, help="shortest length of a block (default: 2)")
    add("--clock", choices=("wall", "cpu"), default="wall")
    add("--against-cleanrl", type=Path, metavar="PATH", help="a checkout of CleanRL")
    help = "with CleanRL's requirements (default: this one)"
    add("--cleanrl-python", metavar="PYTHON", default=sys.executable, help=help)
    add("--against-sbx", metavar="PYTHON", help="with sbx-rl")
    add("--against-rltools", metavar="PYTHON", help="with rltools, mkl and mkl-include; SAC, TD3")
    add("--against-checkout", type=Path, metavar="PATH", help="another version of this project")
    add("--blocks", type=Path, metavar="FILE", help="a csv file for the speed of every block")
    end = argv.index("--") if "--" in argv else len(argv)
    options = parser.parse_args(argv[:end])
    if options.pairs < 1:
        parser.error("argument --pairs: it must be at least 1")
    options.flags = argv[end + 1 :]
    options.cores = sorted(os.sched_getaffinity(0), reverse=True)
    return options


def main(argv):
    """Measure and print."""
    from tabulate import tabulate

    options, rows = parse(argv), []
    for algo, env_id in itertools.product(options.algos, options.envs):
        print(f"measuring {algo} on {env_id}", file=sys.stderr)
        rows += compare(algo, env_id, options)
    print(tabulate(rows, headers="keys", floatfmt=".4g"))


if __name__ == "__main__":
    if len(sys.argv) > 3 and sys.argv[3] in CHILDREN:
        start_child(*sys.argv[1:])
    else:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # which ends what it has started
        main(sys.argv[1:])
