"""Stands for a training script in the tests of sweeps: a run whose returns are known.

    python tests/stub_run.py SCRIPT ARGUMENTS...

It makes 100,000 steps a second, and a checkpoint after each tenth of them and when SIGTERM or
SIGINT stops it; started again, it goes on from there. STUB_FAILS is a pattern of folders whose runs
fail, STUB_LEAVES what a process runs that a run leaves behind, STUB_HIDES the seconds until a
result is seen, STUB_EPISODE the seconds until a run that is stopped ends. A file "refuse" in the
folder of the runs has a pattern of runs that are refused.
"""

import argparse
import fcntl
import fnmatch
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from statistics import fmean

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from noisy_wrappers import __version__, run_name  # noqa: E402

EPISODES = 10  # the scripts' default
STEPS, SECONDS = 4000, 0.04


def episodes_of(algorithm, env_id, noise, rates, seed):
    """Return the returns of ten tests of a run, a pure function of what it is: (tests, episodes).

    Every noise has a mean of its own, 100 +- 30; every episode is drawn around it.
    """
    kind = [algorithm, env_id, noise, rates]
    score = 100 + (random.Random(repr(kind)).gauss(0, 30) if noise else 0)
    rng = random.Random(repr([*kind, seed]))
    return [[score + rng.gauss(0, 5) for _ in range(EPISODES)] for _ in range(10)]


def tests_of(*run):
    return [fmean(episodes) for episodes in episodes_of(*run)]


def stop():
    """Return the number of the signal that has come: none in the process of a test."""
    return 0


def pretend_to_train(total_timesteps, checkpoint):
    """Wait as long as it takes, from the checkpoint on if there is one."""
    step = saved = int(checkpoint.read_text()) if checkpoint.exists() else 0
    if step:
        print(f"resumed at step {step}")
    while step < total_timesteps:
        step = min(step + STEPS, total_timesteps)
        time.sleep(SECONDS)
        print(f"step={step}/{total_timesteps} sps=100", flush=True)
        if stop():
            time.sleep(float(os.environ.get("STUB_EPISODE", 0.2)))  # a second signal may come
        if stop() or step - saved >= total_timesteps / 10:
            checkpoint.with_suffix(".tmp").write_text(str(step))
            checkpoint.with_suffix(".tmp").rename(checkpoint)
            saved = step
        if stop():
            sys.exit(128 + stop())
    checkpoint.unlink(missing_ok=True)


def parser():
    parser = argparse.ArgumentParser()
    parser.add_argument("script")
    parser.add_argument("--env-id", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--noise", nargs="*", default=[])
    parser.add_argument("--noise-rate", nargs="*", default=[])
    parser.add_argument("--total-timesteps", type=int, required=True)
    parser.add_argument("--runs-dir", required=True)
    parser.add_argument("--exp-name")
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--eval-frequency", type=int, default=100)
    return parser


def train(argv):
    args = parser().parse_args(argv)
    args.noise_rate = [rate if ":" in rate else float(rate) for rate in args.noise_rate]
    script = ROOT / args.script
    algorithm = script.name.removesuffix("_continuous_noisy.py")
    exp_name = args.exp_name or script.stem
    folder = Path(args.runs_dir, run_name(vars(args) | {"exp_name": exp_name}))
    folder.mkdir(parents=True, exist_ok=True)
    lock = open(folder / ".lock", "w")  # noqa: SIM115
    fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # as the scripts do
    refuse = Path(args.runs_dir, "refuse")
    if refuse.exists() and fnmatch.fnmatch(folder.name, refuse.read_text()):
        print("error: --gamma must be at most 1, not 2", file=sys.stderr)
        sys.exit(2)
    config = {"algorithm": algorithm.upper(), "versions": {"noisy_wrappers": __version__}}
    config["args"] = vars(args) | {"eval_episodes": EPISODES, "exp_name": exp_name}
    del config["args"]["script"]
    config["script"] = script.name
    config["script_sha256"] = hashlib.sha256(script.read_bytes()).hexdigest()
    (folder / "config.json").write_text(json.dumps(config))
    if fnmatch.fnmatch(folder.name, os.environ.get("STUB_FAILS", "")):
        sys.exit("error: this one fails")
    if code := os.environ.get("STUB_LEAVES"):
        subprocess.Popen([sys.executable, "-c", code])
    pretend_to_train(args.total_timesteps, folder / "checkpoint.pt")

    tests = episodes_of(algorithm, args.env_id, args.noise, args.noise_rate, args.seed)
    tells = "Success" in args.env_id  # whether an episode returned more than 100
    rows = ["step,episode,episodic_return,episodic_length" + ",success" * tells]
    for test, episodes in enumerate(tests, start=1):
        for episode, value in enumerate(episodes):
            step, success = test * args.total_timesteps // 10, f",{value > 100:d}" * tells
            rows.append(f"{step},{episode},{value},100{success}")
    (folder / "eval.csv").write_text("\n".join(rows) + "\n")
    result = {"total_timesteps": args.total_timesteps, "wall_time_seconds": 99.0}
    result |= {"processor_seconds": 36.0, "final_return_mean": fmean(tests[-1])}
    (folder / "result.tmp").write_text(json.dumps(result))
    if seconds := os.environ.get("STUB_HIDES"):  # as a network's file system may do
        late = "import sys, time, os; time.sleep(float(sys.argv[1])); os.rename(*sys.argv[2:])"
        words = [seconds, folder / "result.tmp", folder / "result.json"]
        subprocess.Popen([sys.executable, "-c", late, *words], start_new_session=True)
        return
    (folder / "result.tmp").rename(folder / "result.json")
    lock.close()


if __name__ == "__main__":
    received = []
    stop = lambda: received[0] if received else 0  # noqa: E731
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: received.append(number))
    train(sys.argv[1:])
