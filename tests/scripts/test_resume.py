"""A run killed anywhere and started again ends like a run left alone, bit for bit.

The commands are processes forked from a server (commands.py).
"""

import functools
import io
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import field, make_dataclass
from pathlib import Path

import commands
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import data_equivalence
from small_runs import (
    ROOT,
    SCRIPTS,
    arguments,
    differing,
    each_script,
    flags,
    folder,
    one_line,
    outcome,
    read_json,
    refused,
    run,
    slow,
    two_scripts,
    wait_for_a_later_name,
)

import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac

NOISE = (
    "RandomEarlyTermination(3, 25, truncate=True)",
    "RandomEarlyTermination(30)",  # so that no episode is long
    "RandomMixupObservation(0.5)",
    "RandomNormalNoisyReward(0.1)",
    "RandomUniformScaleObservation(0.9, 1.1)",
)
HOPPER = {"env_id": "Hopper-v5", "noise": NOISE, "noise_rate": (0.5, 1.0, 0.3, "0.5:0", 0.3)}
HOPPER |= {"test_noise": ("RandomObservationBias(0.1)",), "test_noise_rate": (1.0,)}
HOPPER |= {"total_timesteps": 260, "eval_frequency": 70, "eval_episodes": 2}
HOPPER |= {"checkpoint_frequency": 40}
ROLLOUTS = {"num_steps": 60, "num_minibatches": 4, "update_epochs": 2}
OFF_POLICY = {"total_timesteps": 180, "learning_starts": 135}
OFF_POLICY |= {"batch_size": 16, "buffer_size": 120}  # which overflows
TRAINING_STEP = "gymnasium.wrappers.RecordEpisodeStatistics.step"


def hopper(algorithm):
    """Return a short run's arguments: episodes, checkpoints and evaluations are frequent."""
    return HOPPER | (ROLLOUTS if algorithm == "PPO" else OFF_POLICY)


def die(*args):
    os.kill(os.getpid(), signal.SIGKILL)


class Nth:
    """Act at the number-th call that is about the file `name`."""

    def __init__(self, name, number, action):
        self.name, self.number, self.action = name, number, action

    def __call__(self, *args):
        if self.name in Path(args[0]).name:
            self.number -= 1
            if self.number == 0:
                self.action(*args)


def die_half_way(name, value, file):
    """Die in torch.save when half of a file is on the disk."""
    if name in getattr(file, "name", ""):
        whole = io.BytesIO()
        torch.serialization.save(value, whole)
        file.write(whole.getvalue()[: whole.tell() // 2])
        file.flush()
        die()


def half_way(name):
    return "torch.save", None, functools.partial(die_half_way, name)


def die_flushing_checkpoint(number):
    if "checkpoint" in os.readlink(f"/proc/self/fd/{number}"):
        die()


def die_once_in_place(temporary, path):
    os.rename(temporary, path)
    die()


def wait(*args):
    time.sleep(0.02)


def terminate(*args):
    os.kill(os.getpid(), signal.SIGTERM)


def fill_disk(*args, **kwargs):
    """From now on no file grows beyond what events and eval.csv need."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, resource.RLIM_INFINITY))


def start(algorithm, runs_dir, *moments, **kwargs):
    """Start a command; each moment is (dotted name, number of the call, action)."""
    Path(runs_dir).mkdir(exist_ok=True)
    words = flags(arguments(algorithm, runs_dir, **kwargs))
    before = functools.partial(wait_for_a_later_name, runs_dir)
    return commands.start(SCRIPTS[algorithm].__file__, words, *moments, before=before)


def command(*args, **kwargs):
    return commands.ended(start(*args, **kwargs))


def finish(algorithm, runs_dir, **kwargs):
    """Finish a run by a command; return its outcome."""
    result = command(algorithm, runs_dir, **kwargs)
    assert (result.code, result.err) == (0, "")
    return outcome(folder(runs_dir))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the outcome of a run that nothing interrupted, trained once for all tests."""

    @functools.cache
    def train_once(algorithm):
        run_dir = run(algorithm, tmp_path_factory.mktemp("alone"), **hopper(algorithm))
        return outcome(run_dir)

    return train_once


@pytest.fixture(scope="module")
def copy_of_stopped(tmp_path_factory):
    """Return a function that copies a run, which was stopped, into an empty folder."""

    @functools.cache
    def stop_once(algorithm):
        runs_dir = tmp_path_factory.mktemp("stopped")
        run(algorithm, runs_dir, episodes=10, **hopper(algorithm))  # near step 150
        return runs_dir

    def copy(algorithm, runs_dir):
        shutil.copytree(stop_once(algorithm), runs_dir, dirs_exist_ok=True)
        return folder(runs_dir)

    return copy


@pytest.fixture
def stopped(copy_of_stopped, tmp_path):
    """Return the folder of a run of PPO that was stopped."""
    return copy_of_stopped("PPO", tmp_path)


# KILLED ANYWHERE

KILLS = {
    "before learning starts and before the first checkpoint": (TRAINING_STEP, 30, die),
    "the first checkpoint half written": half_way("checkpoint"),
    "the first one written, not on the disk": ("os.fsync", None, die_flushing_checkpoint),
    "the first one on the disk, not in place": ("os.replace", None, Nth("checkpoint", 1, die)),
    "mid-episode, after an evaluation that the checkpoint lacks": (TRAINING_STEP, 80, die),
    "the next but one not in place": ("os.replace", None, Nth("checkpoint", 2, die)),
    "the policy half written": half_way("policy"),
    "a test not in place": ("os.replace", None, Nth("eval", 2, die)),  # the first is on resuming
    "the result not in place": ("os.replace", None, Nth("result", 1, die)),
}


@pytest.mark.slow
@two_scripts
def test_killed_again_and_again_it_ends_as_if_left_alone(algorithm, alone, tmp_path):
    steps, cut = [], False
    for name, moment in KILLS.items():
        result = command(algorithm, tmp_path, moment, **hopper(algorithm))
        assert result.code == -signal.SIGKILL, (name, result)
        path = folder(tmp_path)
        if (path / "checkpoint.pt").exists():
            checkpoint = sac.read_state(path / "checkpoint.pt")
            steps.append(checkpoint["step"])
            cut |= len((path / "eval.csv").read_text()) > len(checkpoint["eval_csv"])
    assert steps == sorted(steps) and len(set(steps)) > 2, steps
    assert any(step % 60 for step in steps)  # in mid-rollout, for PPO
    assert cut  # there were rows of eval.csv newer than the checkpoint
    assert not differing(finish(algorithm, tmp_path, **hopper(algorithm)), alone(algorithm))


@pytest.mark.slow
def test_stopped_at_random_moments_it_ends_as_if_left_alone(alone, tmp_path):
    seed = random.randrange(10**6)
    print("seed", seed)  # which pytest shows if this fails
    rng, codes = random.Random(seed), []
    for action in (die, terminate) * 3:
        moment = (TRAINING_STEP, rng.randint(1, 60), action)
        codes.append(command("PPO", tmp_path, moment, **hopper("PPO")).code)
    assert codes[:2] == [-signal.SIGKILL, 143] and set(codes[2:]) <= {*codes[:2], 0}
    assert not differing(finish("PPO", tmp_path, **hopper("PPO")), alone("PPO"))


@pytest.mark.slow
def test_killed_while_every_step_ends_an_episode_it_logs_each_once(tmp_path):
    """The steps next to a checkpoint are logged too: one cut too many or too few would show."""
    short = {"noise": ("RandomEarlyTermination(1)",), "noise_rate": (1.0,)}
    short |= {"checkpoint_frequency": 25, "total_timesteps": 120, "eval_frequency": 0}
    second = ("os.replace", None, Nth("checkpoint", 2, die))
    for _ in range(2):  # the log is flushed with each checkpoint: newer events than the last one's
        assert command("SAC", tmp_path / "killed", second, **short).code == -signal.SIGKILL
    killed = finish("SAC", tmp_path / "killed", **short)
    assert [step for step, _ in killed["charts/episodic_return"]] == list(range(1, 121))
    assert killed["text"] == [(0, "")]
    assert not differing(killed, outcome(run("SAC", tmp_path / "alone", **short)))


@pytest.mark.slow
def test_events_are_on_the_disk_before_the_checkpoint_is(alone, tmp_path):
    slowly = ("tensorboard.summary.writer.record_writer.RecordWriter.write", None, wait)
    in_place = ("os.replace", None, Nth("checkpoint", 1, die_once_in_place))
    result = command("PPO", tmp_path, slowly, in_place, **hopper("PPO"))
    assert result.code == -signal.SIGKILL and (folder(tmp_path) / "checkpoint.pt").exists()
    assert not differing(finish("PPO", tmp_path, **hopper("PPO")), alone("PPO"))


# FROM A CHECKPOINT
# A state that were not saved, or not loaded, would begin anew here: the run would end differently.


@pytest.mark.parametrize("algorithm", ["PPO", slow("SAC"), slow("TD3")])
def test_stopped_and_resumed_it_ends_as_if_left_alone(algorithm, alone, copy_of_stopped, tmp_path):
    stopped = copy_of_stopped(algorithm, tmp_path)
    (stopped / "eval.csv").write_text("damaged, and healed")
    assert not differing(outcome(run(algorithm, tmp_path, **hopper(algorithm))), alone(algorithm))


@pytest.mark.slow
def test_compiled_and_resumed_it_ends_as_if_left_alone(tmp_path, capsys):
    compiled = {"compile": True, "num_steps": 16, "total_timesteps": 64}
    alone = outcome(run("PPO", tmp_path / "alone", **compiled))
    said = capsys.readouterr().out
    if "InvalidCxxCompiler" in said:
        pytest.skip("no C++ compiler")
    assert "not compiled" not in said
    run("PPO", tmp_path / "stopped", episodes=6, **compiled)
    assert not differing(outcome(run("PPO", tmp_path / "stopped", **compiled)), alone)


def test_processor_seconds_are_those_of_all_sessions(stopped):
    checkpoint = ppo.read_state(stopped / "checkpoint.pt")
    torch.save(checkpoint | {"processor_seconds": 2e6}, stopped / "checkpoint.pt")
    run("PPO", stopped.parent, **hopper("PPO"))
    assert read_json(stopped / "result.json")["processor_seconds"] > 2e6


class Part:
    """A part of a run's state, as a researcher's: {name: value}."""

    def __init__(self, **state):
        self.state = state

    def state_dict(self):
        return self.state

    def load_state_dict(self, state):
        self.state = state


def a_run(runs_dir):
    """Begin or resume the run in a folder, without training."""
    args = arguments("PPO", runs_dir, eval_frequency=20)
    return ppo.Run(args, ppo.noisy.make_noisy(ppo.make_env(args.env_id), [], []))


def save(runs_dir, part):
    """Write a checkpoint of a run that has this part."""
    begun = a_run(runs_dir)
    assert begun.resume({"mine": part}) == 0
    begun.save(8)
    begun.lock.close()


def test_numbers_and_arrays_of_numpy_come_back(tmp_path):
    state = {"empty": np.zeros((0, 3), np.float32), "flags": np.array([True, False])}
    state |= {"number": np.float64(0.1), "count": np.int64(3), "half": np.float16([0.5])}
    state |= {"text": "é", "nested": [{"a": (1, None, 2.5)}]}
    save(tmp_path, Part(**state, tensor=torch.arange(3)))
    mine = Part()
    assert a_run(tmp_path).resume({"mine": mine}) == 8
    assert mine.state.pop("tensor").equal(torch.arange(3))
    assert data_equivalence(mine.state, state, exact=True)


def test_state_that_cannot_be_read_back_is_named_at_the_start(tmp_path, capsys):
    for value in (np.random.default_rng(), lambda: 0, np.array([Path("x")])):
        state = {"whole": Part(a=1), "mine": Part(value=value)}
        line = refused(capsys, lambda state=state: a_run(tmp_path).resume(state))
        assert line.startswith("error: 'mine' needs a state_dict() of tensors, arrays, numbers: ")


def test_what_an_optimizer_steps_is_in_the_state(tmp_path, capsys):
    network = torch.nn.Sequential(torch.nn.Linear(1, 1))
    optimizer = torch.optim.SGD(network.parameters())
    line = refused(capsys, lambda: a_run(tmp_path / "0").resume({"optimizer": optimizer}), code=1)
    assert "`state` lacks a tensor that an optimizer steps" in line
    run = a_run(tmp_path / "1")
    run.resume({"mine": Part(nested=[{"a": network[0].state_dict()}]), "optimizer": optimizer})
    run.save(8)  # the tensors may lie anywhere in a state_dict()
    run.state["mine"] = network
    network[0] = torch.nn.Linear(1, 1)
    assert "(was a layer replaced?)" in refused(capsys, run.save, 16, code=1)


def test_a_checkpoint_of_other_parts_is_named(tmp_path, capsys):
    save(tmp_path, Part(a=1))
    state = {"mine": Part(a=1), "scheduler": Part(b=2)}
    line = refused(capsys, lambda: a_run(tmp_path).resume(state), code=1)
    assert "it holds ['mine'], not ['mine', 'scheduler']" in line


# REFUSED


def files(path):
    """Return all that a folder holds but the lock."""
    found = [file for file in path.iterdir() if file.name != ".lock"]
    return {file.name: (file.stat().st_mtime_ns, file.read_bytes()) for file in found}


def untouched(capsys, path, code=2, **kwargs):
    """Check that a run is refused, and its folder left as it is; return the line."""
    before = files(path)
    line = refused(capsys, run, "PPO", path.parent, code=code, **hopper("PPO") | kwargs)
    assert files(path) == before and "--overwrite" in line
    return line


def test_a_damaged_checkpoint_is_noticed(stopped, capsys):
    path = stopped / "checkpoint.pt"
    whole = path.read_bytes()
    damaged = [whole[: len(whole) // 2], whole[:-1], b"", b"an essay"]
    for part in (0.4, 0.6):  # one bit of large arrays
        damaged.append(bytearray(whole))
        damaged[-1][int(part * len(whole))] ^= 1
    for content in damaged:
        path.write_bytes(content)
        assert f"cannot read {path}" in untouched(capsys, stopped, code=1)
    torch.save({"step": 1}, path)
    assert f"cannot read {path}" in untouched(capsys, stopped, code=1)


class Intruder:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_checkpoint_cannot_run_code(stopped, tmp_path, capsys):
    trace, path = tmp_path / "trace", stopped / "checkpoint.pt"
    torch.save(ppo.read_state(path) | {"eval_csv": Intruder(trace)}, path)
    untouched(capsys, stopped, code=1)
    assert not trace.exists()
    torch.load(path, weights_only=False)
    assert trace.exists()  # it works where it is let in


def test_a_run_with_other_arguments_is_refused_until_overwritten(stopped, alone, capsys):
    line = untouched(capsys, stopped, gamma=0.5, eval_episodes=3)
    assert "gamma 0.99, not 0.5" in line and "eval_episodes 2, not 3" in line
    assert "total_timesteps" not in line and "--exp-name" in line
    free = {"checkpoint_frequency": 90, "torch_threads": 2, "keep_policies": True}
    run("PPO", stopped.parent, episodes=1, **hopper("PPO") | free)  # goes on
    free |= {"torch_threads": 1, "keep_policies": False, "overwrite": True}
    run("PPO", stopped.parent, **hopper("PPO") | free)
    assert not differing(outcome(stopped), alone("PPO"))
    line = untouched(capsys, stopped, gamma=0.5)  # finished: likewise
    assert "gamma" in line and "overwrite True" not in line and "checkpoint" not in line
    config = stopped / "config.json"  # of a run with the same --exp-name
    config.write_text(config.read_text().replace('"PPO"', '"SAC"'))
    assert "it holds a run of SAC, not of PPO: " in untouched(capsys, stopped)


@pytest.mark.slow
def test_a_new_option_is_another_run_unless_it_has_its_default(stopped, monkeypatch, capsys):
    """A researcher adds options to a script, whose runs so far lack them."""
    sizes = ("sizes", tuple[int, ...], field(default=(64, 64)))
    options = [("layer_norm", bool, False), ("schedule", str, "none"), sizes]
    monkeypatch.setattr(ppo, "Args", make_dataclass("Args", options, bases=(ppo.Args,)))
    assert "layer_norm False, not True" in untouched(capsys, stopped, layer_norm=True)
    resumed = {"episodes": 1, "sizes": (64, 64)}  # a tuple and a list of JSON
    run("PPO", stopped.parent, **hopper("PPO") | resumed)
    run("PPO", stopped.parent, episodes=3, **hopper("PPO"), sizes=(32,), overwrite=True)
    config = read_json(stopped / "config.json")
    assert config["args"]["sizes"] == [32] and config["defaults"]["sizes"] == [64, 64]
    monkeypatch.undo()  # the script that lacks it knows its default from that config.json
    assert "sizes [32], not [64, 64]" in untouched(capsys, stopped)


def test_a_changed_script_is_said_and_recorded(stopped, tmp_path_factory, monkeypatch, capsys):
    config = read_json(stopped / "config.json")
    copy = tmp_path_factory.mktemp("copy") / "ppo_continuous_noisy.py"
    copy.write_text(Path(ppo.__file__).read_text() + "# changed\n")
    monkeypatch.setattr(ppo, "__file__", str(copy))
    monkeypatch.setattr(ppo.torch, "__version__", "99.0")
    run("PPO", stopped.parent, episodes=1, **hopper("PPO"))
    said = "the script has changed since the run began; if it matters, use --exp-name\n"
    assert said in capsys.readouterr().out
    found = read_json(stopped / "config.json")
    first, second = found["script_sha256"].split(", ")
    assert first == config["script_sha256"] != second and len(second) == 64
    assert found["versions"]["torch"] == config["versions"]["torch"] + ", 99.0"


@pytest.mark.slow
def test_a_second_process_is_refused_while_the_first_one_lives(tmp_path):
    long = {"total_timesteps": 10**9, "eval_frequency": 10**9, "checkpoint_frequency": 1}
    long |= {"learning_starts": 10**9 - 1}
    first = start("SAC", tmp_path, **long)
    while not list(tmp_path.glob("*/checkpoint.pt")):
        assert first.is_alive()
        time.sleep(0.01)
    for overwrite in (False, True):
        second = command("SAC", tmp_path, (TRAINING_STEP, 30, die), **long, overwrite=overwrite)
        assert second.code == 1
        assert f"another process trains in {folder(tmp_path)}: wait" in one_line(second.err)
    assert first.is_alive() and list(tmp_path.glob("*/checkpoint.pt"))
    first.kill()
    assert commands.ended(first).code == -signal.SIGKILL
    third = command("SAC", tmp_path, (TRAINING_STEP, 10, terminate), **long)
    assert (third.code, third.err) == (143, "")


@pytest.mark.slow
def test_a_full_disk_ends_the_run_and_leaves_whole_files(alone, stopped, tmp_path):
    path = stopped / "checkpoint.pt"
    before = path.read_bytes()
    result = command("PPO", tmp_path, (TRAINING_STEP, 1, fill_disk), **hopper("PPO"))
    assert result.code == 1 and "File too large" in result.err
    assert path.read_bytes() == before and not list(tmp_path.glob("*/result.json"))
    assert not differing(finish("PPO", tmp_path, **hopper("PPO")), alone("PPO"))


# RUNS OF 0.3, made by its scripts: the tools read them, a script does not go on with them

OLD_RUNS = {
    read_json(path)["algorithm"]: path.parent
    for path in (ROOT / "tests/data/runs_0.3").glob("*/config.json")
}


@each_script
def test_a_policy_of_0_3_plays_as_it_did(algorithm):
    script, run_dir = SCRIPTS[algorithm], OLD_RUNS[algorithm]
    with script.make_env("Pendulum-v1") as env:
        recorded = gym.wrappers.RecordEpisodeStatistics(env)
        results = script.noisy.play(recorded, script.load_policy(run_dir, env), 3, 1_000_000)
    lines = (run_dir / "eval.csv").read_text().splitlines()[-3:]
    expected = [float(line.split(",")[2]) for line in lines]
    np.testing.assert_allclose(results[:, 0], expected, rtol=1e-3)


def test_a_run_of_0_3_is_not_resumed(tmp_path, capsys):
    run_dir = tmp_path / OLD_RUNS["PPO"].name
    shutil.copytree(OLD_RUNS["PPO"], run_dir)
    saved = read_json(run_dir / "config.json")["args"]
    before = files(run_dir)
    line = refused(capsys, ppo.train, ppo.Args(**saved | {"runs_dir": str(tmp_path)}))
    assert "a run of version 0.3, whose numbers differ: finish it with that one" in line
    assert "--exp-name" in line and files(run_dir) == before


@pytest.mark.slow
def test_tools_read_runs_of_0_3(tmp_path):
    for run_dir in OLD_RUNS.values():
        shutil.copytree(run_dir, tmp_path / run_dir.name)
    names = [run_dir.name for run_dir in OLD_RUNS.values()]
    tested = commands.run(ROOT / "evaluate.py", ["--episodes", "1", *names], cwd=tmp_path)
    analysed = commands.run(ROOT / "analyze.py", ["--runs-dir", "."], cwd=tmp_path)
    for algorithm in SCRIPTS:
        assert f"Pendulum-v1    {algorithm}  " in tested.out
        assert f"{algorithm}: 1 run of 600 steps, seeds: 1, " in analysed.out
    assert tested.code == analysed.code == 0 and tested.err == analysed.err == ""
    line = [ROOT / "benchmark.sh", "status", "--runs-dir", tmp_path]
    environment = os.environ | {"PYTHON": sys.executable}
    counted = subprocess.check_output(line, text=True, env=environment)
    assert "3 runs: 3 done, " in counted and "by release 0.3, and this is 0.4" in counted
