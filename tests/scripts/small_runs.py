"""Runs of a second or less, and what they leave in their folders."""

import csv
import itertools
import json
import math
import os
import socket
import time
from dataclasses import asdict
from pathlib import Path

import commands
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac
import td3_continuous_noisy as td3

ROOT = Path(__file__).parents[2]
SCRIPTS = {"SAC": sac, "TD3": td3, "PPO": ppo}
OFF_POLICY = {"total_timesteps": 60, "learning_starts": 50, "batch_size": 8, "buffer_size": 50}
ON_POLICY = {"total_timesteps": 60, "num_steps": 12, "num_minibatches": 3, "update_epochs": 1}
SMALL = {"SAC": OFF_POLICY, "TD3": OFF_POLICY, "PPO": ON_POLICY}

each_script = pytest.mark.parametrize("algorithm", SCRIPTS)
# TD3 trains in SAC's order: where nothing of its own could break, it is not tested
two_scripts = pytest.mark.parametrize("algorithm", ["SAC", "PPO"])


def slow(*values):
    """Return values of a parametrized test that are left out by -m 'not slow'."""
    return pytest.param(*values, marks=pytest.mark.slow)


def arguments(algorithm, runs_dir, **kwargs):
    """Return the arguments of a run of a second or less."""
    common = {"env_id": "toy_envs:Tiny-v0", "eval_frequency": 20, "eval_episodes": 3}
    common |= {"compile": False, "runs_dir": str(runs_dir)}
    return SCRIPTS[algorithm].Args(**common | SMALL[algorithm] | kwargs)


def wait_for_a_later_name(runs_dir):
    """Let a new file of events be the last one by name, which is the order TensorBoard reads in.

    Its name has the second, the host and the process number, compared as text. Only processes that
    start within a second of one another, as these do, can be in the wrong order.
    """
    last = max((path.name for path in Path(runs_dir).glob("*/events.*")), default="")
    process = f"{socket.gethostname()}.{os.getpid()}"
    while last > f"events.out.tfevents.{int(time.time())}.{process}":
        time.sleep(0.05)


def run(algorithm, runs_dir, *, episodes=math.inf, **kwargs):
    """Train in this process, stopped after a number of episodes; return the run's folder."""
    wait_for_a_later_name(runs_dir)
    ended = itertools.count(1)
    args = arguments(algorithm, runs_dir, **kwargs)
    finished = SCRIPTS[algorithm].train(args, stop=lambda: next(ended) >= episodes)
    assert finished == (episodes == math.inf)
    return folder(runs_dir)


def folder(runs_dir):
    """Return the one run folder there is."""
    [path] = Path(runs_dir).iterdir()
    return path


def flags(args):
    """Return the command line of arguments."""
    line = []
    for name, value in asdict(args).items():
        flag = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            line.append(flag if value else "--no-" + flag[2:])
        elif value not in (None, ()):
            line += [flag, *(value if isinstance(value, tuple) else (value,))]
    return [str(word) for word in line]


def command(algorithm, *options, **kwargs):
    """Run a script as a user does, but for the imports (commands.py)."""
    return commands.run(SCRIPTS[algorithm].__file__, options, **kwargs)


def refused(capsys, function, *args, code=2, **kwargs):
    """Return the one line with which a call ends the program."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        function(*args, **kwargs)
    assert stopped.value.code == code
    return one_line(capsys.readouterr().err)


def one_line(stderr):
    """Check that there is one line, of an error; return it."""
    assert stderr.startswith("error: ") and stderr.endswith("\n") and stderr.count("\n") == 1, (
        stderr
    )
    return stderr


def read_json(path):
    return json.loads(path.read_text())


def evaluations(run_dir):
    """Return eval.csv as [(step, episode, return, length)]."""
    with open(run_dir / "eval.csv") as file:
        header, *rows = csv.reader(file)
    assert header == ["step", "episode", "episodic_return", "episodic_length", "success"]
    return [(int(step), int(i), float(value), int(length)) for step, i, value, length, _ in rows]


def policy(run_dir, name="policy.pt"):
    """Return what a saved policy holds: {name: tensor or array}."""
    saved = ppo.read_state(run_dir / name)
    parts = {part: values for part, values in saved.items() if part != "step"}
    return {f"{p}.{name}": value for p, values in parts.items() for name, value in values.items()}


def curves(run_dir):
    """Return what TensorBoard shows, but for the speed: {tag: [(step, value), ...]}."""
    sizes = {"scalars": 0, "tensors": 0}  # all of them
    events = EventAccumulator(str(run_dir), size_guidance=sizes).Reload()
    found = {"text": [(e.step, "") for e in events.Tensors("hyperparameters/text_summary")]}
    for tag in events.Tags()["scalars"]:
        found[tag] = [(event.step, repr(event.value)) for event in events.Scalars(tag)]
    found.pop("charts/SPS", None)
    return found


def outcome(run_dir):
    """Return what a finished run leaves that must not depend on interruptions."""
    names = {path.name for path in run_dir.iterdir() if "tfevents" not in path.name}
    assert names == {".lock", "config.json", "eval.csv", "policy.pt", "result.json"}
    result, logged = read_json(run_dir / "result.json"), curves(run_dir)
    for tag, values in logged.items():
        steps = [step for step, _ in values]
        assert steps == sorted(set(steps)), tag  # each once
    assert result.pop("processor_seconds") > 0
    tensors = {name: torch.as_tensor(x).numpy().tobytes() for name, x in policy(run_dir).items()}
    files = {name: (run_dir / name).read_bytes() for name in ("eval.csv", "policy.pt")}
    return logged | tensors | files | {"result": result}


def differing(found, expected):
    """Name what differs: pytest would take minutes to show where megabytes do."""
    assert found.keys() == expected.keys()
    return [name for name in found if found[name] != expected[name]]
