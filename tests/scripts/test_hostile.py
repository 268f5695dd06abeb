"""The scripts with an environment that is somebody else's (hostile_envs.py)."""

import functools
import multiprocessing
import os
import random
import signal
import time
from dataclasses import asdict
from pathlib import Path

import commands
import numpy as np
import pytest
import torch
from small_runs import (
    SCRIPTS,
    arguments,
    each_script,
    evaluations,
    flags,
    folder,
    one_line,
    policy,
    refused,
    run,
    slow,
    two_scripts,
)

import noisy_wrappers
import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac

HOSTILE = {"env_id": "hostile_envs:Hostile-v0"}
ALONE = {"env_id": "hostile_envs:HostileAlone-v0"}
STEP = "hostile_envs.Hostile.ask"  # of the training and the test environment


@pytest.fixture(autouse=True)
def log(tmp_path_factory, monkeypatch):
    """The file into which the environments write; return a function that reads it."""
    path = tmp_path_factory.mktemp("log") / "hostile.log"
    monkeypatch.setenv("HOSTILE_LOG", str(path))
    return lambda: path.read_text().splitlines() if path.exists() else []


def is_alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def assert_closed(lines, number=2):
    """Both environments were closed, and no worker process is left."""
    assert sum(line.startswith("closed") for line in lines) == number, lines
    workers = [int(line.split()[1]) for line in lines if line.startswith("worker")]
    assert len(workers) > 0 and not any(map(is_alive, workers))


# EVERY WAY OUT


def test_a_run_to_its_end_and_again(tmp_path, log, capsys):
    run_dir = run("PPO", tmp_path, **HOSTILE)
    assert_closed(log())
    assert {row[3] for row in evaluations(run_dir)} == {8}
    run("PPO", tmp_path, **HOSTILE)  # it is finished
    refused(capsys, run, "PPO", tmp_path, gamma=0.5, **HOSTILE)
    noise = {"noise": ("RandomNormalNoisyObservation((1, 2, 3))",), "noise_rate": (1.0,)}
    refused(capsys, run, "PPO", tmp_path, **noise, **HOSTILE)
    assert_closed(log(), number=8)


def test_what_breaks_is_closed(tmp_path, log):
    with pytest.raises(KeyError, match="broken"):
        run("PPO", tmp_path, env_id="hostile_envs:Broken-v0")
    assert_closed(log())


# SIGNALS


def on_its_own(log, ignored=()):
    """Be a process that may have children, in a group of its own."""
    multiprocessing.current_process()._config["daemon"] = False
    os.environ["HOSTILE_LOG"] = log
    for number in (signal.SIGINT, signal.SIGHUP):  # whatever these tests are started below
        signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)
    os.setsid()


def start(runs_dir, *moments, ignored=(), **kwargs):
    args = arguments("PPO", runs_dir, **HOSTILE | {"total_timesteps": 100_000} | kwargs)
    before = functools.partial(on_its_own, os.environ["HOSTILE_LOG"], ignored)
    return commands.start(ppo.__file__, flags(args), *moments, before=before)


def send(numbers, to_group, *args):
    for number in numbers:
        os.kill(0 if to_group else os.getpid(), number)
        time.sleep(0.2)  # or two are one for a worker that is not running


def sent(runs_dir, step, *numbers, to_group=False, **kwargs):
    """Send signals to a run at a step of its environments; return how it ended."""
    moment = STEP, step, functools.partial(send, numbers, to_group)
    return commands.ended(start(runs_dir, moment, **kwargs))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "to_group", "code"),
    [
        ([signal.SIGTERM, signal.SIGHUP], False, 143),  # of timeout, and of what it stops
        ([signal.SIGHUP], False, 129),  # the window of a terminal is closed
        ([signal.SIGINT], True, 130),  # Ctrl-C on a terminal: the workers work to the end
    ],
)
def test_a_signal_ends_the_episode_and_then_all_processes(numbers, to_group, code, tmp_path, log):
    result = sent(tmp_path, 50, *numbers, to_group=to_group)
    assert (result.code, result.err) == (code, "")
    said = result.out.count("stopping after this episode")
    assert said == len(numbers)  # not of the workers, too
    assert result.out.endswith("\nstopped; run the same command again to resume\n")
    assert (folder(tmp_path) / "checkpoint.pt").exists()
    assert_closed(log())


@pytest.mark.slow
def test_a_signal_to_the_group_ends_all_processes(tmp_path, log):
    """As a cluster sends it: the workers end at once, and the script with them or after them."""
    result = sent(tmp_path, 90, signal.SIGTERM, to_group=True)
    assert result.code in (143, 1)  # 1: it asked a worker that had ended
    assert_closed(log())


@pytest.mark.slow
def test_a_second_ctrl_c_ends_the_workers_too(tmp_path, log):
    twice = functools.partial(send, [signal.SIGINT] * 2, True)
    process = start(tmp_path, (STEP, 50, twice))
    process.join(commands.LIMIT)
    workers = [int(line.split()[1]) for line in log() if line.startswith("worker")]
    for _ in range(50):
        time.sleep(0.1 * any(map(is_alive, workers)))
    left = [pid for pid in workers if is_alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert (process.exitcode, len(workers), left) == (128 + signal.SIGINT, 4, [])
    assert not list(tmp_path.glob("*/checkpoint.pt"))  # it did not wait for the episode's end


@pytest.mark.slow
def test_a_hangup_that_was_ignored_stays_ignored(tmp_path):
    """As nohup does it."""
    result = sent(tmp_path, 50, signal.SIGHUP, ignored=[signal.SIGHUP], total_timesteps=60)
    assert (result.code, result.err) == (0, "")


@pytest.mark.slow
def test_what_is_not_the_api_is_no_traceback(tmp_path):
    result = commands.ended(start(tmp_path, env_id="toy_envs:NanReward-v0"))
    assert result.code == 1
    assert one_line(result.err).startswith("error: training stopped: step 6 of an episode: ")
    assert not list(tmp_path.glob("*/result.json"))


# SEEDS


def forget_seeds():
    random.seed()
    np.random.seed()
    torch.seed()


@pytest.mark.parametrize("algorithm", ["PPO", slow("SAC")])
def test_a_seed_seeds_all_that_is_random_also_after_a_stop(algorithm, tmp_path):
    runs = {}
    for name, seed in (("stopped", 1), ("other", 2), ("one", 1)):
        forget_seeds()
        if name == "stopped":
            run(algorithm, tmp_path / name, episodes=6, seed=seed, **ALONE)
        forget_seeds()
        runs[name] = run(algorithm, tmp_path / name, seed=seed, **ALONE)
    rows = {name: (run_dir / "eval.csv").read_bytes() for name, run_dir in runs.items()}
    assert rows["one"] == rows["stopped"] != rows["other"]
    torch.testing.assert_close(policy(runs["one"]), policy(runs["stopped"]), rtol=0, atol=0)


def test_what_a_constructor_draws_is_the_same_in_the_tests_of_all_runs(tmp_path, monkeypatch):
    drawn = []

    def learn(args, env, test_env, stop):
        drawn.append((env.unwrapped.offset, test_env.unwrapped.offset))

    monkeypatch.setattr(ppo, "learn", learn)
    for seed in (1, 2, 1):
        ppo.train(arguments("PPO", tmp_path, seed=seed, **ALONE))
    (first, test), (second, same), again = drawn
    assert test == same and again == (first, test) and len({first, second, test}) == 3


@pytest.mark.parametrize(
    ("asked", "processor", "used"),
    [("medium", {}, "medium"), ("medium", {"amx_tile": True}, "highest"), ("bf16", {}, None)]
    + [("bf16", {"avx512_bf16": True}, "highest"), ("highest", {}, "highest")],
)
def test_which_precision_is_used(asked, processor, used, tmp_path, monkeypatch, capsys):
    """And threads. Where "medium" would round, it is "highest"; bf16 is cast explicitly."""
    found = []

    def learn(*_):
        found.append((torch.get_float32_matmul_precision(), torch.get_num_threads()))

    monkeypatch.setattr(sac, "learn", learn)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: processor)
    args = arguments("SAC", tmp_path, matmul_precision=asked, torch_threads=2)
    try:
        if used is None:
            assert "this processor has no bfloat16" in refused(capsys, sac.train, args)
        else:
            sac.train(args)
        assert found == ([] if used is None else [(used, 2)])
    finally:
        torch.set_num_threads(1)
        torch.set_float32_matmul_precision("highest")


@two_scripts
def test_tests_neither_notice_training_nor_are_noticed(algorithm, tmp_path):
    half = {"env_id": "hostile_envs:HostileHalf-v0"}
    seldom, often = (run(algorithm, tmp_path / str(n), eval_frequency=n, **half) for n in (0, 14))
    assert len(evaluations(often)) > len(evaluations(seldom)) == 3
    torch.testing.assert_close(policy(seldom), policy(often), rtol=0, atol=0)
    script, results = SCRIPTS[algorithm], []
    for _ in range(2):
        forget_seeds()
        with script.noisy.make_noisy(script.make_env(half["env_id"]), [], []) as env:
            env.unwrapped.offset = 0.0
            results.append(script.noisy.play(env, script.load_policy(often), 3, 1))
    np.testing.assert_array_equal(*results)


# ACTIONS


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@each_script
def test_actions_at_the_bounds_are_inside_the_space(algorithm, dtype, tmp_path):
    script = SCRIPTS[algorithm]
    with script.make_env(ALONE["env_id"], dtype=dtype) as env:
        observation, _ = env.reset()
        for sign in (-1, 1):
            if algorithm == "PPO":
                agent = ppo.Agent(env).requires_grad_(False)
                agent.actor_mean[-1].bias += sign * 100
                action = ppo.make_policy(agent, ppo.Normalizer(0.0, 1.0), env)(observation)
            else:
                actor = script.Actor(env).requires_grad_(False)
                action = actor.policy(observation, torch.tensor([sign * 1000.0]))
            assert env.action_space.contains(action), action
            before = action.copy()
            env.step(action)
            np.testing.assert_array_equal(action, before)  # what a buffer stores


# THE FOLDER


def test_a_folder_that_is_a_link_is_refused(tmp_path, capsys):
    args = asdict(arguments("PPO", tmp_path / "runs", **ALONE))
    run_dir = tmp_path / "runs" / noisy_wrappers.run_name(args)
    run_dir.parent.mkdir()
    other = tmp_path / "other"
    other.mkdir()
    (other / "eval.csv").write_text("mine")
    run_dir.symlink_to(other)
    for overwrite in (True, False):
        more = {"overwrite": overwrite, **ALONE}
        line = refused(capsys, run, "PPO", tmp_path / "runs", code=1, **more)  # other seeds may run
        assert f"{run_dir} is a link: remove it, or use" in line
    assert [path.read_text() for path in other.iterdir()] == ["mine"]


def test_overwrite_deletes_our_files_and_no_others(tmp_path, monkeypatch):
    mine = ["notes.json", "notes.tmp", "events.md", "robustness.csv.bak", "my_policy.pt"]
    ours = ["robustness.csv", "robustness.csv.gz", "policy_7.pt", "policy_7.pt.tmp"]
    links = ["eval.csv", "eval.csv.tmp", "policy.pt", "policy_20.pt", "checkpoint.pt.tmp"]
    run_dir = run("PPO", tmp_path / "runs", keep_policies=True, **ALONE)
    target = tmp_path / "target"
    for path in [target, *(run_dir / name for name in mine + ours)]:
        path.write_text("mine")
    for name in links:
        (run_dir / name).unlink(missing_ok=True)
        (run_dir / name).symlink_to(target)
    [old] = run_dir.glob("events.out.tfevents.*")
    assert (run_dir / "policy_40.pt").exists()
    monkeypatch.chdir(tmp_path)  # a relative --runs-dir, as in most commands
    run("PPO", "runs", overwrite=True, **ALONE)
    assert {path.read_text() for path in [target, *(run_dir / name for name in mine)]} == {"mine"}
    for name in [*ours, "policy_40.pt", old.name]:
        assert not (run_dir / name).exists(), name
    assert not any(path.is_symlink() for path in run_dir.iterdir())
