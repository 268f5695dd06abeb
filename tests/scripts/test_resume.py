"""A run killed anywhere and started again ends like a run left alone, bit for bit.

The commands are processes forked from a server (commands.py).
"""

import errno
import fcntl
import functools
import io
import itertools
import json
import math
import os
import pickle
import random
import re
import resource
import shutil
import signal
import socket
import time
import zipfile
from importlib import import_module
from pathlib import Path

import commands
import gymnasium as gym
import numpy as np
import pytest
import torch
import tyro
from commands import ended
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parents[2]
ALGORITHMS = ("sac", "td3", "ppo")


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


# TD3 trains in SAC's order; that each script resumes exactly is tested in FROM A CHECKPOINT
two_scripts = pytest.mark.parametrize("algorithm", ["sac", "ppo"])
# Resuming, stopping and what is refused are in THE RUN, which is the same text in the three scripts
# (test_scripts.py compares them): where the algorithm's own part has no say, one script is enough.
one_script = pytest.mark.parametrize("algorithm", ["ppo"])

NOISE = (
    "RandomEarlyTermination(3, 25, truncate=True)",
    "RandomEarlyTermination(30)",  # so that no episode is long
    "RandomMixupObservation(0.5)",
    "RandomNormalNoisyReward(0.1)",
    "RandomUniformScaleObservation(0.9, 1.1)",
)
RATES = ("0.5", "1", "0.3", "0.3", "0.3")
EARLY, EXPLORING, LATE = 2, 5, 10  # ends of an episode: near steps 25, 75 and 150
TRAINING_STEP = "gymnasium.wrappers.RecordEpisodeStatistics.step"  # the test env has none of these


def script(algorithm):
    return import_module(f"{algorithm}_continuous_noisy")


def options(algorithm, runs_dir, env_id="Hopper-v5", noise=NOISE, rates=RATES, **more):
    """A short run's command-line options: episodes, checkpoints and evaluations are frequent."""
    values = {"env_id": env_id, "noise": noise, "noise_rate": rates, "runs_dir": runs_dir}
    values |= {"total_timesteps": 260, "eval_frequency": 70, "eval_episodes": 2}
    values |= {"checkpoint_frequency": 40, "compile": False}
    if algorithm == "ppo":
        values |= {"num_steps": 60, "num_minibatches": 4, "update_epochs": 2}
    else:  # a buffer that overflows
        values |= {"learning_starts": 110, "batch_size": 16, "buffer_size": 150}
    words = []
    for name, value in (values | more).items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words += [f"--{flag}" if value else f"--no-{flag}"]
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def wait_for_a_later_name(words):
    """Let a new file of events be the last one by name, which is the order TensorBoard reads in.

    Its name has the second, the host and the process number, compared as text. Only processes that
    start within a second of one another, as these do, can be in the wrong order.
    """
    runs_dir = Path(words[words.index("--runs-dir") + 1])
    last = max((path.name for path in runs_dir.glob("*/events.*")), default="")
    process = f"{socket.gethostname()}.{os.getpid()}"
    while last > f"events.out.tfevents.{int(time.time())}.{process}":
        time.sleep(0.05)


def train(algorithm, words, episodes=math.inf):
    """Train in this process, stopped after a number of episodes; return what train() does."""
    wait_for_a_later_name(words)
    module, ended = script(algorithm), itertools.count(1)
    return module.train(tyro.cli(module.Args, args=words), stop=lambda: next(ended) >= episodes)


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


def die_half_way(value, file):
    """Die in torch.save when half of the file is on the disk."""
    whole = io.BytesIO()
    torch.serialization.save(value, whole)
    file.write(whole.getvalue()[: whole.tell() // 2])
    file.flush()
    die()


def die_half_way_in_policy(value, file):
    if "policy" in Path(file.name).name:
        die_half_way(value, file)


def die_flushing_checkpoint(number):
    if "checkpoint" in os.readlink(f"/proc/self/fd/{number}"):
        die()


def die_once_in_place(temporary, path):
    os.rename(temporary, path)
    die()


def die_removing_checkpoint(path, *args, **kwargs):
    if path.name == "checkpoint.pt":
        die()


def uninstall_git(*args, **kwargs):
    os.environ["PATH"] = ""


def wait(*args):
    time.sleep(0.05)


def send(*numbers, pause=0):
    return functools.partial(send_all, numbers, pause)


def send_all(numbers, pause, *args):
    for number in numbers:
        os.kill(os.getpid(), number)
        time.sleep(pause)


def disk_full(file_size, name=""):
    return functools.partial(limit_files, file_size, name)


def limit_files(file_size, name, *args, **kwargs):
    """From now on no file grows beyond a size (if this is about the file `name`)."""
    if name in f"{args} {kwargs}":
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, resource.RLIM_INFINITY))


def start(algorithm, words, *moments):
    """Start a command; each moment is (dotted name, number of the call, action)."""
    before = functools.partial(wait_for_a_later_name, words)
    path = ROOT / f"{algorithm}_continuous_noisy.py"
    return commands.start(path, words, *moments, before=before)


def run(algorithm, words, *moments):
    return ended(start(algorithm, words, *moments))


def folder(runs_dir):
    """The one run folder there is."""
    (path,) = Path(runs_dir).iterdir()
    return path


def files(path):
    """All that a folder holds but the lock."""
    found = [file for file in path.iterdir() if file.name != ".lock"]
    return {file.name: (file.stat().st_mtime_ns, file.read_bytes()) for file in found}


def tensors(value):
    """Nested dicts of tensors -> one flat dict of bytes."""
    if isinstance(value, torch.Tensor):
        return {"": (value.dtype, tuple(value.shape), value.numpy().tobytes())}
    nested = {name: tensors(inner) for name, inner in value.items()}
    return {f"{name}/{key}": x for name, inner in nested.items() for key, x in inner.items()}


def events(path):
    """All scalars in TensorBoard, of the speed the steps alone -> {tag: [(step, value), ...]}."""
    accumulator = EventAccumulator(str(path), size_guidance={"scalars": 0, "tensors": 0})
    tags = accumulator.Reload().Tags()
    found = {tag: accumulator.Tensors(tag) for tag in tags["tensors"]}
    found = {tag: [event.step for event in found[tag]] for tag in found}
    for tag in tags["scalars"]:
        found[tag] = [(event.step, repr(event.value)) for event in accumulator.Scalars(tag)]
    found.pop("charts/SPS", None)  # the speed of a process, from its second log of losses on
    return found


def numbers(path):
    """What a run leaves behind that must not depend on interruptions, but for its events."""
    result = json.loads((path / "result.json").read_text())
    timing = ("steps_per_second", "wall_time_seconds")
    policy = tensors(torch.load(path / "policy.pt", weights_only=True))
    rows = (path / "eval.csv").read_bytes()
    result = {name: repr(value) for name, value in result.items() if name not in timing}
    return {"rows": rows, "policy": policy, "result": result}


def outcome(path):
    return numbers(path) | {"events": events(path)}


def differing(found, expected):
    """Name what differs: pytest would take minutes to show where megabytes do."""
    return [name for name in found if found[name] != expected[name]]


def assert_finished(path):
    found = {file.name for file in path.iterdir() if "tfevents" not in file.name}
    assert found == {".lock", "config.json", "eval.csv", "policy.pt", "result.json"}
    lines = (path / "eval.csv").read_text().splitlines()
    keys = [tuple(line.split(",")[:2]) for line in lines]
    assert len(set(keys)) == len(keys)
    for tag, logged in events(path).items():
        steps = [event[0] for event in logged if isinstance(event, tuple)]
        assert steps == sorted(set(steps)), tag  # strictly increasing


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The outcome of a run that nothing interrupted, trained once for all tests."""

    @functools.cache
    def train_once(algorithm):
        runs_dir = tmp_path_factory.mktemp("alone")
        assert train(algorithm, options(algorithm, runs_dir))
        assert_finished(folder(runs_dir))
        return outcome(folder(runs_dir))

    return train_once


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Run folders left by stopping after some episodes -> (runs_dir, checkpoint)."""

    @functools.cache
    def stop_after(algorithm, episodes):
        runs_dir = tmp_path_factory.mktemp("stopped")
        assert not train(algorithm, options(algorithm, runs_dir), episodes)
        return runs_dir, torch.load(folder(runs_dir) / "checkpoint.pt", weights_only=True)

    return stop_after


# KILLED ANYWHERE

KILLS = {
    "before learning starts and before the first checkpoint": (TRAINING_STEP, 30, die),
    "the first checkpoint half written": ("torch.save", 1, die_half_way),
    "the first one written, not on the disk": (
        "os.fsync",
        None,
        die_flushing_checkpoint,
    ),
    "the first one on the disk, not in place": ("os.replace", None, Nth("checkpoint", 1, die)),
    "mid-episode, after an evaluation that the checkpoint lacks": (TRAINING_STEP, 80, die),
    "the next checkpoint half written": ("torch.save", 1, die_half_way),
    "the next but one not in place": ("os.replace", None, Nth("checkpoint", 2, die)),
    "mid-episode": (TRAINING_STEP, 71, die),
    "the policy half written": ("torch.save", None, die_half_way_in_policy),
    "a test not in place": ("os.replace", None, Nth("eval", 2, die)),  # the first is on resuming
    "the result not in place": ("os.replace", None, Nth("result", 1, die)),
}


@pytest.mark.slow
@two_scripts
def test_killed_again_and_again_it_ends_as_if_left_alone(algorithm, alone, tmp_path):
    words, steps, cut = options(algorithm, tmp_path), [], False
    for name, moment in KILLS.items():
        result = run(algorithm, words, moment)
        assert result.code == -signal.SIGKILL, (name, result)
        path = folder(tmp_path)
        if (path / "checkpoint.pt").exists():
            checkpoint = torch.load(path / "checkpoint.pt", weights_only=True)
            steps.append(checkpoint["step"])
            cut |= len((path / "eval.csv").read_text()) > len(checkpoint["eval_csv"])
    assert steps == sorted(steps) and len(set(steps)) > 2, steps
    assert any(step % 60 for step in steps)  # in mid-rollout, for PPO
    assert cut  # there were rows of eval.csv newer than the checkpoint
    result = run(algorithm, words)
    assert (result.code, result.err) == (0, "")
    assert_finished(path)
    assert not differing(outcome(path), alone(algorithm))


@pytest.mark.slow
@two_scripts
def test_killed_while_every_step_ends_an_episode_it_logs_each_once(algorithm, tmp_path):
    """The steps next to a checkpoint are logged too: one cut too many or too few would show."""
    noise = ("RandomEarlyTermination(1)", "RandomNormalNoisyReward(1)")
    short = {"noise": noise, "rates": ("1",), "checkpoint_frequency": 25}
    short |= {"total_timesteps": 120, "eval_frequency": 0, "eval_episodes": 1}
    words = options(algorithm, tmp_path, **short)
    for _ in range(2):  # the log is flushed with each checkpoint: newer events than the last one's
        assert run(algorithm, words, ("torch.save", 2, die_half_way)).code == -signal.SIGKILL
    assert run(algorithm, words).code == 0
    logged = events(folder(tmp_path))
    for tag in ("charts/episodic_return", "charts/episodic_length"):
        assert [step for step, _ in logged[tag]] == list(range(1, 121))
    assert logged["hyperparameters/text_summary"] == [0]
    (tmp_path / "alone").mkdir()
    assert train(algorithm, options(algorithm, tmp_path / "alone", **short))
    assert not differing(
        outcome(folder(tmp_path / "alone")), outcome(next(tmp_path.glob("*__Hopper*")))
    )


@pytest.mark.slow
@one_script
def test_events_are_on_the_disk_before_the_checkpoint_is(algorithm, alone, tmp_path):
    slow = ("tensorboard.summary.writer.record_writer.RecordWriter.write", None, wait)
    words = options(algorithm, tmp_path)
    in_place = ("os.replace", None, Nth("checkpoint", 1, die_once_in_place))
    result = run(algorithm, words, slow, in_place)
    assert result.code == -signal.SIGKILL and (folder(tmp_path) / "checkpoint.pt").exists()
    assert run(algorithm, words).code == 0
    assert not differing(outcome(folder(tmp_path)), alone(algorithm))


@pytest.mark.slow
def test_killed_by_somebody_else_at_a_random_time_compiled(tmp_path):
    """With torch.compile, by kill -9 from outside."""
    # The networks, the batch and the precision of test_compiled_and_plain_updates_agree, so that
    # the compiler finds its own results.
    small = {"env_id": "toy_envs:Tiny-v0", "num_steps": 16, "matmul_precision": "highest"}
    small |= {"max_episode_steps": 40}
    small |= {"total_timesteps": 1000, "eval_frequency": 250, "compile": True}
    words = options("ppo", tmp_path / "killed", **small)
    (tmp_path / "killed").mkdir()
    uninterrupted = run("ppo", options("ppo", tmp_path / "alone", **small))
    assert (uninterrupted.code, uninterrupted.err) == (0, "")
    if "not compiled" in uninterrupted.out:
        pytest.skip("no C++ compiler")
    process, step = start("ppo", words), 0
    while step < 200:  # it has learned, and has written checkpoints since
        assert process.is_alive()
        time.sleep(0.05)
        for path in tmp_path.glob("killed/*/checkpoint.pt"):
            step = torch.load(path, weights_only=True)["step"]
    time.sleep(random.uniform(0, 0.2))
    process.kill()
    assert ended(process).code == -signal.SIGKILL
    result = run("ppo", words)
    assert (result.code, result.err) == (0, "")
    assert "resumed at step" in result.out
    assert_finished(folder(tmp_path / "killed"))
    assert not differing(outcome(folder(tmp_path / "killed")), outcome(folder(tmp_path / "alone")))


# STOPPED


@pytest.mark.slow
@pytest.mark.parametrize(
    "algorithm, number, code",
    [("sac", signal.SIGTERM, 143), ("ppo", signal.SIGINT, 130)],
)
def test_a_signal_ends_the_episode_and_the_run_resumes(algorithm, number, code, alone, tmp_path):
    words = options(algorithm, tmp_path)
    result = run(algorithm, words, (TRAINING_STEP, 65, send(number)))
    assert (result.code, result.err) == (code, "")
    stopping = "stopping at the end of this episode; Ctrl-C again to stop without a checkpoint"
    assert f"{stopping}\n" in result.out
    checkpoint = torch.load(folder(tmp_path) / "checkpoint.pt", weights_only=True)
    assert 65 <= checkpoint["step"] < 100
    assert "stopped; run the same command again to resume\n" in result.out
    assert not (folder(tmp_path) / "policy.pt").exists()
    result = run(algorithm, words, (TRAINING_STEP, 70, send(number)))
    assert (result.code, result.err) == (code, "")
    assert f"resumed at step {checkpoint['step']}\n" in result.out
    assert run(algorithm, words).code == 0
    assert_finished(folder(tmp_path))
    assert not differing(outcome(folder(tmp_path)), alone(algorithm))


@pytest.mark.slow
@pytest.mark.parametrize(
    "action, code",
    [
        (send(signal.SIGTERM, signal.SIGTERM, pause=1.1), 143),
        (send(signal.SIGTERM, signal.SIGINT), 130),
    ],
)
@one_script
def test_a_second_signal_exits_at_once(algorithm, action, code, tmp_path):
    result = run(algorithm, options(algorithm, tmp_path), (TRAINING_STEP, 30, action))
    assert (result.code, result.err) == (code, "")
    assert not (folder(tmp_path) / "checkpoint.pt").exists()


@pytest.mark.slow
@one_script
def test_one_request_that_arrives_twice_does_not_exit_at_once(algorithm, tmp_path):
    action = send(signal.SIGTERM, signal.SIGTERM, signal.SIGHUP)
    result = run(algorithm, options(algorithm, tmp_path), (TRAINING_STEP, 30, action))
    assert (result.code, result.err) == (143, "")
    assert (folder(tmp_path) / "checkpoint.pt").exists()


@pytest.mark.slow
@two_scripts
def test_a_signal_stops_a_run_that_has_an_evaluation_due_at_every_episode(algorithm, tmp_path):
    short = {"eval_frequency": 5, "eval_episodes": 1, "total_timesteps": 120}
    words = options(algorithm, tmp_path, **short)
    for _ in range(2):
        result = run(algorithm, words, (TRAINING_STEP, 20, send(signal.SIGTERM)))
        assert (result.code, result.err) == (143, "")
    assert run(algorithm, words, ("torch.save", 1, die_half_way)).code == -signal.SIGKILL
    assert run(algorithm, words).code == 0
    assert_finished(folder(tmp_path))
    (tmp_path / "alone").mkdir()
    assert train(algorithm, options(algorithm, tmp_path / "alone", **short))
    assert not differing(
        outcome(folder(tmp_path / "alone")), outcome(next(tmp_path.glob("*__Hopper*")))
    )


# FROM A CHECKPOINT
# A state that were not saved, or not loaded, would begin anew here: the run would end differently.


def ending(algorithm, runs_dir, checkpoint, tmp_path):
    """Finish a copy of a stopped run from a changed checkpoint; return its numbers."""
    shutil.copytree(runs_dir, tmp_path / "copy")
    torch.save(checkpoint, folder(tmp_path / "copy") / "checkpoint.pt")
    assert train(algorithm, options(algorithm, tmp_path / "copy"))
    return numbers(folder(tmp_path / "copy"))


@pytest.mark.parametrize("episodes", [slow(EARLY), slow(EXPLORING), LATE])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_unchanged_checkpoint_gives_the_same_run(
    algorithm, episodes, alone, checkpoints, tmp_path
):
    runs_dir, checkpoint = checkpoints(algorithm, episodes)
    ended = ending(algorithm, runs_dir, checkpoint, tmp_path)
    assert not differing(ended, alone(algorithm))


@one_script
def test_the_time_left_is_told_by_the_speed_since_resuming(
    algorithm, checkpoints, tmp_path, capsys
):
    runs_dir, checkpoint = checkpoints(algorithm, LATE)
    capsys.readouterr()
    ending(algorithm, runs_dir, checkpoint | {"seconds": 1e6}, tmp_path)
    [line, *_] = re.findall(r"step=(\d+)/260 sps=(\d+) .*eta=00:0\d\n", capsys.readouterr().out)
    assert int(line[0]) > checkpoint["step"] and int(line[1]) > 0
    result = json.loads((folder(tmp_path / "copy") / "result.json").read_text())
    assert result["wall_time_seconds"] > 1e6  # of all attempts


# REFUSED


def refused(algorithm, words, capsys):
    """Run a command that must fail with one line and touch nothing; return the line."""
    path = folder(words[words.index("--runs-dir") + 1])
    before = files(path)
    capsys.readouterr()
    with pytest.raises(SystemExit) as error:
        train(algorithm, words)
    assert error.value.code == 2
    assert files(path) == before
    line = capsys.readouterr().err
    assert line.startswith("error: ") and line.count("\n") == 1, line
    assert "--overwrite" in line
    return line


@pytest.fixture
def stopped(algorithm, checkpoints, tmp_path):
    """A copy of a stopped run -> (options, path of its checkpoint)."""
    runs_dir, _ = checkpoints(algorithm, LATE)
    shutil.copytree(runs_dir, tmp_path / "runs")
    path = folder(tmp_path / "runs") / "checkpoint.pt"
    return options(algorithm, tmp_path / "runs"), path


@one_script
def test_a_flipped_bit_anywhere_in_the_data_is_found(algorithm, stopped, capsys):
    words, path = stopped
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.file_size]
    for member in members[:: max(1, len(members) // 15)] + members[-3:]:
        header = whole[member.header_offset :][:30]
        lengths = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:], "little")
        flipped = bytearray(whole)
        flipped[member.header_offset + 30 + lengths + member.file_size // 2] ^= 1
        path.write_bytes(flipped)
        assert "checkpoint.pt" in refused(algorithm, words, capsys), member.filename


@one_script
def test_what_is_no_whole_checkpoint_is_refused(algorithm, stopped, capsys):
    words, path = stopped
    whole = path.read_bytes()
    for part in (whole[:1000], whole[: len(whole) // 2], whole[:-1], whole[:-100], whole[100:]):
        path.write_bytes(part)
        assert "checkpoint.pt" in refused(algorithm, words, capsys)
    for other in (b"", b"PK", b"an essay", bytes(100_000), random.Random(1).randbytes(100_000)):
        path.write_bytes(other)
        assert "checkpoint.pt" in refused(algorithm, words, capsys)
    for value in ({}, [], None, 1, {"format": 1}):
        torch.save(value, path)
        assert "checkpoint.pt" in refused(algorithm, words, capsys)


@one_script
def test_a_checkpoint_of_another_run_is_refused(algorithm, stopped, checkpoints, tmp_path, capsys):
    words, path = stopped
    checkpoint = torch.load(path, weights_only=True)
    torch.save(checkpoint | {"format": 1}, path)
    assert "another version wrote it" in refused(algorithm, words, capsys)
    assert not train(algorithm, options(algorithm, tmp_path / "seed", seed=2), episodes=3)
    shutil.copy(folder(tmp_path / "seed") / "checkpoint.pt", path)
    assert path.parent.name.replace("_s1_", "_s2_") in refused(algorithm, words, capsys)
    for other in set(ALGORITHMS) - {algorithm}:  # even under this run's name
        _, foreign = checkpoints(other, LATE)
        torch.save(foreign, path)
        assert f"{other}_continuous_noisy" in refused(algorithm, words, capsys)
        torch.save(foreign | {"run": path.parent.name}, path)
        assert "checkpoint.pt" in refused(algorithm, words, capsys)


class Intruder:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@one_script
def test_a_checkpoint_cannot_run_code(algorithm, stopped, tmp_path, capsys):
    words, path = stopped
    trace = tmp_path / "trace"
    checkpoint = torch.load(path, weights_only=True)
    pickle.loads(pickle.dumps(Intruder(trace)))
    assert trace.exists()  # it works where it is let in
    trace.unlink()
    path.write_bytes(pickle.dumps(Intruder(trace)))
    refused(algorithm, words, capsys)
    for zipped in (True, False):
        torch.save(
            checkpoint | {"eval_csv": Intruder(trace)}, path, _use_new_zipfile_serialization=zipped
        )
        refused(algorithm, words, capsys)
    assert not trace.exists()


@one_script
def test_a_damaged_eval_csv_is_healed(algorithm, stopped, alone):
    words, path = stopped
    path.with_name("eval.csv").write_text("an essay")
    assert train(algorithm, words)
    assert not differing(outcome(path.parent), alone(algorithm))


@one_script
def test_a_checkpoint_without_its_configuration_is_refused(algorithm, stopped, capsys):
    words, path = stopped
    config = path.with_name("config.json")
    for text in ("", "{}", "[]"):
        config.write_text(text)
        assert "config.json" in refused(algorithm, words, capsys)
    config.unlink()
    assert "config.json" in refused(algorithm, words, capsys)


@one_script
def test_a_folder_of_another_configuration_is_refused_until_overwritten(
    algorithm, stopped, alone, tmp_path, capsys
):
    words, path = stopped
    line = refused(algorithm, [*words, "--gamma", "0.5", "--eval-episodes", "3"], capsys)
    assert "gamma 0.99, not 0.5" in line and "eval_episodes" in line
    assert "total_timesteps" not in line
    assert line.index("--exp-name") < line.index("--runs-dir") < line.index("--overwrite")
    path.write_bytes(b"damaged")
    refused(algorithm, words, capsys)
    free = ["--checkpoint-frequency", "90", "--torch-threads", "1"]  # not part of the identity
    (path.parent / "somebody's folder").mkdir()
    assert train(algorithm, [*words, "--overwrite", *free])
    (path.parent / "somebody's folder").rmdir()
    assert_finished(path.parent)
    assert not differing(outcome(path.parent), alone(algorithm))
    line = refused(algorithm, [*words, "--gamma", "0.5"], capsys)  # finished: likewise
    assert "gamma" in line
    config = path.with_name("config.json")  # of a run with the same --exp-name
    config.write_text(config.read_text().replace('"PPO"', '"SAC"'))
    assert "holds a run with algorithm SAC, not PPO: " in refused(algorithm, words, capsys)


@one_script
def test_an_argument_that_an_older_version_did_not_have_is_no_difference(algorithm, stopped):
    words, path = stopped
    config = json.loads(path.with_name("config.json").read_text())
    del config["args"]["gamma"]
    path.with_name("config.json").write_text(json.dumps(config))
    assert train(algorithm, words)
    assert_finished(path.parent)


@one_script
def test_a_file_system_without_locks_is_one_line(algorithm, tmp_path, capsys, monkeypatch):
    def lockf(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "lockf", lockf)
    with pytest.raises(SystemExit) as error:
        train(algorithm, options(algorithm, tmp_path))
    assert error.value.code == 2
    assert capsys.readouterr().err == "error: --runs-dir: [Errno 37] No locks available\n"


@pytest.mark.slow
@one_script
def test_a_second_process_is_refused_while_the_first_one_lives(algorithm, tmp_path):
    long = {"total_timesteps": 10**9, "eval_frequency": 10**9, "checkpoint_frequency": 1}
    words = options(algorithm, tmp_path, **long)
    first = start(algorithm, words)
    while not list(tmp_path.glob("*/checkpoint.pt")):
        assert first.is_alive()
        time.sleep(0.01)
    for more in ([], ["--overwrite"]):
        second = run(algorithm, [*words, *more])
        assert second.code == 2
        assert second.err.startswith("error: ") and second.err.count("\n") == 1
        assert str(folder(tmp_path)) in second.err and "in use" in second.err
    assert first.is_alive()
    first.kill()
    assert ended(first).code == -signal.SIGKILL
    third = run(algorithm, words, (TRAINING_STEP, 10, send(signal.SIGTERM)))
    assert (third.code, third.err) == (143, "")


# FULL DISK

FAILURES = {
    "config.json": ("gymnasium.make", 1, disk_full(0)),
    "events": (TRAINING_STEP, 20, disk_full(0)),  # the next thing to log is the end of an episode
    "eval.csv": ("gymnasium.wrappers.TimeLimit.reset", None, disk_full(0, "1000001")),
    "checkpoint.pt": (TRAINING_STEP, 1, disk_full(50_000)),  # room for eval.csv and events
    "policy.pt": ("torch.save", None, disk_full(0, "policy.tmp")),
    "result.json": ("os.replace", None, disk_full(0, "policy.tmp")),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAILURES)
@one_script
def test_a_file_that_cannot_be_written_is_named_and_the_run_can_go_on(
    algorithm, name, alone, checkpoints, tmp_path
):
    words = options(algorithm, tmp_path)
    path = None
    if name in ("checkpoint.pt", "policy.pt", "result.json"):
        shutil.copytree(checkpoints(algorithm, EXPLORING)[0], tmp_path, dirs_exist_ok=True)
        path = folder(tmp_path) / "checkpoint.pt"
        before = path.read_bytes()
    result = run(algorithm, words, FAILURES[name])
    assert result.code == 1, result
    lines = result.err.splitlines()
    if name == "events":  # TensorBoard's writer, a thread, has its own say, also in this line
        lines = re.findall("error: .*", result.err)
    (line,) = lines
    assert line.startswith("error: cannot write ")
    assert str(folder(tmp_path)) in line and name in line
    assert not list(tmp_path.glob("*/*.tmp"))
    assert not list(tmp_path.glob("*/result.json"))
    if name == "checkpoint.pt":
        assert path.read_bytes() == before
    if path:
        assert torch.load(path, weights_only=True)["step"]
    assert run(algorithm, words).code == 0
    assert_finished(folder(tmp_path))
    assert not differing(outcome(folder(tmp_path)), alone(algorithm))


# FINISHED


@pytest.mark.slow
@one_script
def test_a_finished_run_says_so_and_changes_nothing(algorithm, alone, tmp_path):
    words = options(algorithm, tmp_path)
    result = run(algorithm, words, ("pathlib.Path.unlink", None, die_removing_checkpoint))
    assert result.code == -signal.SIGKILL
    path = folder(tmp_path)
    assert (path / "checkpoint.pt").exists() and (path / "result.json").exists()
    for _ in range(2):
        result = run(algorithm, words)
        assert (result.code, result.err) == (0, "") and "is finished" in result.out
        assert_finished(path)
        assert not differing(outcome(path), alone(algorithm))
        before = files(path)
    assert run(algorithm, words).code == 0
    assert files(path) == before


@one_script
def test_success_survives_an_interruption(algorithm, tmp_path):
    small = {"env_id": "toy_envs:Success-v0", "noise": NOISE[3:4], "rates": RATES[3:4]}
    found = []
    for name, stops in (("whole", []), ("stopped", [LATE])):
        words = options(algorithm, tmp_path / name, **small)
        for episodes in stops:
            assert not train(algorithm, words, episodes)
        assert train(algorithm, words)
        [path] = (tmp_path / name).iterdir()
        events = EventAccumulator(str(path)).Reload()
        curves = [events.Scalars(tag) for tag in ("charts/success_rate", "eval/success_rate")]
        curves = [[(event.step, event.value) for event in curve] for curve in curves]
        found.append((curves, (path / "eval.csv").read_text()))
    assert found[0] == found[1]
    assert len(found[0][0][0]) > LATE


@pytest.mark.slow
@one_script
def test_another_precision_is_said_and_recorded(algorithm, tmp_path, monkeypatch, capsys):
    words, said = options(algorithm, tmp_path), []
    for precision, episodes in (("medium", EARLY), ("highest", EARLY), ("highest", math.inf)):
        use = functools.partial(lambda effective, *_: effective, precision)
        monkeypatch.setattr(script(algorithm), "use_matmul_precision", use)
        train(algorithm, words, episodes)
        told = "matmul_precision is highest now; this run had medium so far\n"
        said.append(told in capsys.readouterr().out)
    assert said == [False, True, False]
    assert_finished(folder(tmp_path))
    monkeypatch.setattr(script(algorithm), "use_matmul_precision", lambda *_: "high")
    train(algorithm, words)  # finished: it does not multiply any more
    assert "now" not in capsys.readouterr().out
    config = json.loads((folder(tmp_path) / "config.json").read_text())
    assert config["matmul_precision"] == "medium, highest"
    del config["matmul_precision"]
    (folder(tmp_path) / "config.json").write_text(json.dumps(config))
    train(algorithm, words)
    assert "is finished" in capsys.readouterr().out


@pytest.mark.slow
@one_script
def test_other_code_and_versions_are_said_and_recorded(
    algorithm, tmp_path, tmp_path_factory, monkeypatch, capsys
):
    words = options(algorithm, tmp_path)
    train(algorithm, words, EARLY)
    config = json.loads((folder(tmp_path) / "config.json").read_text())
    capsys.readouterr()
    monkeypatch.setattr(script(algorithm).gym, "__version__", "99.0")
    git = tmp_path_factory.mktemp("bin") / "git"
    git.write_text("#!/bin/sh\necho another-commit\n")
    git.chmod(0o755)
    monkeypatch.setenv("PATH", f"{git.parent}:{os.environ['PATH']}")
    train(algorithm, words)
    commit, version = config["git_commit"], config["versions"]["gymnasium"]
    told = capsys.readouterr().out
    assert f"gymnasium is 99.0 now; this run had {version} so far\n" in told
    assert f"git_commit is another-commit now; this run had {commit} so far\n" in told
    config["git_commit"] = f"{commit}, another-commit"
    config["versions"]["gymnasium"] = f"{version}, 99.0"
    assert json.loads((folder(tmp_path) / "config.json").read_text()) == config


@pytest.mark.slow
@one_script
def test_a_run_needs_no_git(algorithm, tmp_path):
    moments = ("gymnasium.make", 1, uninstall_git), (TRAINING_STEP, 1, send(signal.SIGTERM))
    result = run(algorithm, options(algorithm, tmp_path), *moments)
    assert (result.code, result.err) == (143, "")
    assert json.loads((folder(tmp_path) / "config.json").read_text())["git_commit"] is None


# WHY AT THE END OF AN EPISODE

MUJOCO = ["HalfCheetah-v5", "Hopper-v5", "Humanoid-v5", "Pusher-v5", "Walker2d-v5"]


@pytest.mark.parametrize("env_id", [*MUJOCO, "Ant-v5", "Pendulum-v1"])
def test_between_episodes_an_environment_is_its_random_generator(env_id):
    used, fresh = gym.make(env_id), gym.make(env_id)
    for env in (used, fresh):
        env.reset(seed=1)
    used.action_space.seed(1)
    for _ in range(2):
        over = False
        while not over:
            _, _, terminated, truncated, _ = used.step(used.action_space.sample())
            over = terminated or truncated
        before = used.unwrapped.np_random.bit_generator.state
        first, _ = used.reset()
    fresh.unwrapped.np_random.bit_generator.state = before
    assert np.array_equal(first, fresh.reset()[0])
    steps = 0
    while steps < 300:
        action = used.action_space.sample()
        (o1, r1, *end1, _), (o2, r2, *end2, _) = used.step(action), fresh.step(action)
        assert o1.tobytes() == o2.tobytes() and r1 == r2 and end1 == end2
        steps += 1
        if any(end1):
            assert np.array_equal(used.reset()[0], fresh.reset()[0])
