"""The scripts with an environment that is somebody else's (hostile_envs.py)."""

import functools
import itertools
import json
import multiprocessing
import os
import pty
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import commands
import gymnasium as gym
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_scripts import (
    SCRIPTS,
    arguments,
    assert_one_line,
    evaluations,
    flags,
    policy,
    real_command,
    run,
)

import evaluate
import ppo_continuous_noisy as ppo
from noisy_wrappers import NotFiniteError, SpaceError, make_noisy

ROOT = Path(__file__).parents[2]
HOSTILE = {"env_id": "hostile_envs:Hostile-v0", "noise": (), "noise_rate": ()}
ALONE = {"env_id": "hostile_envs:HostileAlone-v0"}
STEP = "hostile_envs.Hostile.ask"  # of the training and the test environment

each_script = pytest.mark.parametrize("algorithm", SCRIPTS)
one_script = pytest.mark.parametrize("algorithm", ["PPO"])


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
    assert not any(map(is_alive, workers))
    return workers


# EVERY WAY OUT


@each_script
def test_a_run_to_its_end_and_again(algorithm, tmp_path, log):
    runs_dir = tmp_path / "runs"
    run_dir = run(algorithm, runs_dir, **HOSTILE)
    assert len(assert_closed(log())) == 4
    assert {row[3] for row in evaluations(run_dir)} == {8}
    run(algorithm, runs_dir, **HOSTILE)  # it is finished
    assert_closed(log(), number=4)


@pytest.mark.parametrize(
    "wrong", [{"env_id": "hostile_envs:Refused-v0"}, {"gamma": 0.5}, {"noise": ("No(1)",)}]
)
@one_script
def test_what_is_refused_is_closed(algorithm, wrong, tmp_path, log, capsys):
    if "gamma" in wrong:
        run(algorithm, tmp_path / "runs", **HOSTILE)
    if "noise" in wrong:
        wrong = {"noise": ("RandomNormalNoisyObservation((1, 2, 3))",), "noise_rate": (1.0,)}
    before = len([line for line in log() if line.startswith("closed")])
    with pytest.raises(SystemExit) as stopped:
        run(algorithm, tmp_path / "runs", **HOSTILE | wrong)
    assert stopped.value.code == 2
    assert_closed(log(), before + (1 if "env_id" in wrong else 2))


@one_script
def test_what_breaks_is_closed(algorithm, tmp_path, log):
    with pytest.raises(KeyError, match="broken"):
        run(algorithm, tmp_path / "runs", env_id="hostile_envs:Broken-v0")
    assert_closed(log())


# SIGNALS


def on_its_own(log, terminal=None, ignored=()):
    """Be a process that may have children, with a process group and perhaps a terminal."""
    multiprocessing.current_process()._config["daemon"] = False
    os.environ["HOSTILE_LOG"] = log
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whatever these tests are started below
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)
    os.setsid()
    if terminal:
        number = os.open(terminal, os.O_RDWR)  # the first that a session opens controls it
        for stream in (0, 1, 2):
            os.dup2(number, stream)


def start(algorithm, runs_dir, *moments, terminal=None, ignored=(), **kwargs):
    args = arguments(algorithm, runs_dir, **HOSTILE | {"total_timesteps": 100_000} | kwargs)
    before = functools.partial(on_its_own, os.environ["HOSTILE_LOG"], terminal, ignored)
    return commands.start(SCRIPTS[algorithm].__file__, flags(args), *moments, before=before)


def send(number, to_group):
    return functools.partial(send_now, number, to_group)


def send_now(number, to_group, *args):
    os.kill(0 if to_group else os.getpid(), number)


def assert_resumes(algorithm, runs_dir, capsys, **kwargs):
    """The stopped run, finished, ends like one that was not stopped."""
    kwargs = HOSTILE | kwargs
    stopped = run(algorithm, runs_dir, **kwargs)
    assert "resumed at step" in capsys.readouterr().out
    alone = run(algorithm, runs_dir.with_name("alone"), **kwargs)
    assert (stopped / "eval.csv").read_bytes() == (alone / "eval.csv").read_bytes()
    torch.testing.assert_close(policy(stopped), policy(alone), rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@one_script
def test_a_signal_to_the_script_ends_the_episode_and_then_all_processes(
    algorithm, number, code, tmp_path, log, capsys
):
    runs_dir, short = tmp_path / "runs", {"total_timesteps": 120}
    process = start(algorithm, runs_dir, (STEP, 50, send(number, False)), **short)
    result = commands.ended(process)
    assert (result.code, result.err) == (code, "")
    assert result.out.count("stopping at the end of this episode") == 1  # not of the workers, too
    assert_closed(log())
    assert_resumes(algorithm, runs_dir, capsys, **short)


@pytest.mark.slow
@one_script
def test_a_signal_that_the_environment_took_over_stops_the_run(algorithm, tmp_path):
    moment = ("hostile_envs.Hostile.ask", 50, send(signal.SIGTERM, False))
    process = start(algorithm, tmp_path, moment, env_id="hostile_envs:OwnSignals-v0")
    result = commands.ended(process)
    assert (result.code, result.err) == (143, "")
    assert list(tmp_path.glob("*/checkpoint.pt"))


@pytest.mark.slow
@one_script
def test_a_signal_to_the_group_ends_all_processes_without_a_traceback(
    algorithm, tmp_path, log, capsys
):
    short = {"total_timesteps": 200, "checkpoint_frequency": 10}
    process = start(algorithm, tmp_path / "runs", (STEP, 90, send(signal.SIGTERM, True)), **short)
    result = commands.ended(process)
    assert (result.code, result.err) == (143, "")
    assert result.out.endswith("stopped; run the same command again to resume\n")
    assert_closed(log())
    assert_resumes(algorithm, tmp_path / "runs", capsys, **short)


@pytest.mark.slow
@one_script
def test_ctrl_c_on_a_terminal_leaves_the_workers_at_work_until_the_checkpoint(
    algorithm, tmp_path, log
):
    master, slave = pty.openpty()
    process = start(algorithm, tmp_path / "runs", terminal=os.ttyname(slave), eval_frequency=0)
    while not list(tmp_path.glob("runs/*/eval.csv")) or len(log()) < 4:
        assert process.is_alive()
        time.sleep(0.01)
    time.sleep(0.3)
    os.write(master, b"\x03")
    shown = b""
    while b"again to resume" not in shown:
        shown += os.read(master, 1000)
    result = commands.ended(process)
    assert result.code == 130, shown
    assert b"Traceback" not in shown
    assert shown.count(b"stopping at the end of this episode") == 1  # not of the workers, too
    assert list(tmp_path.glob("runs/*/checkpoint.pt"))
    assert_closed(log())
    os.close(master)
    os.close(slave)


@pytest.mark.slow
@one_script
def test_a_hangup_that_was_ignored_stays_ignored_and_one_of_a_terminal_stops(
    algorithm, tmp_path, log
):
    hangup = (STEP, 50, send(signal.SIGHUP, False))
    kwargs = {"total_timesteps": 60, "ignored": (signal.SIGHUP,)}
    result = commands.ended(start(algorithm, tmp_path / "ignored", hangup, **kwargs))
    assert (result.code, result.err) == (0, "")
    master, slave = pty.openpty()
    process = start(algorithm, tmp_path / "runs", terminal=os.ttyname(slave), eval_frequency=0)
    os.close(slave)
    while not list(tmp_path.glob("runs/*/eval.csv")):
        assert process.is_alive()
        time.sleep(0.01)
    time.sleep(0.3)
    os.close(master)  # the terminal's window is closed
    assert commands.ended(process).code == 129
    assert list(tmp_path.glob("runs/*/checkpoint.pt"))
    assert_closed(log(), number=4)


# SEEDS


def forget_seeds():
    random.seed()
    np.random.seed()
    torch.seed()


@each_script
def test_a_seed_seeds_all_that_is_random(algorithm, tmp_path):
    runs = {}
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        forget_seeds()
        runs[name] = run(algorithm, tmp_path / name, seed=seed, **ALONE)
    rows = {name: (run_dir / "eval.csv").read_bytes() for name, run_dir in runs.items()}
    assert rows["one"] == rows["same"] != rows["other"]
    torch.testing.assert_close(policy(runs["one"]), policy(runs["same"]), rtol=0, atol=0)


@each_script
def test_a_seed_reaches_the_action_space_of_training(algorithm, tmp_path, monkeypatch):
    """An environment may draw from it; that of tests may be the same object."""
    seeds, seed_of_box = [], gym.spaces.Box.seed
    monkeypatch.setattr(
        gym.spaces.Box, "seed", lambda box, seed: seeds.append(seed) or seed_of_box(box, seed)
    )
    run(algorithm, tmp_path, seed=7, **ALONE)
    assert seeds == [7]


@each_script
def test_tests_neither_notice_training_nor_are_noticed(algorithm, tmp_path):
    seldom, often = (run(algorithm, tmp_path / str(n), eval_frequency=n, **ALONE) for n in (0, 14))
    torch.testing.assert_close(policy(seldom), policy(often), rtol=0, atol=0)
    script, results = SCRIPTS[algorithm], []
    for _ in range(2):
        forget_seeds()
        with script.make_env(ALONE["env_id"]) as env:
            env.unwrapped.offset = 0.0
            results.append(script.evaluate(script.load_policy(often, env), env, 3))
    np.testing.assert_array_equal(*results)


@each_script
def test_it_resumes_exactly(algorithm, tmp_path, capsys):
    stops = iter([False] * 4 + [True])
    args = arguments(algorithm, tmp_path / "runs", **ALONE, eval_frequency=0)
    assert not SCRIPTS[algorithm].train(args, stop=lambda: next(stops))
    assert_resumes(algorithm, tmp_path / "runs", capsys, **ALONE, eval_frequency=0)


def half(observation):
    return np.float32([0.5])


@one_script
def test_evaluate_plays_the_same_again_and_closes(algorithm, tmp_path, log, capsys):
    run_dir = run(algorithm, tmp_path / "runs", **HOSTILE)
    rows = []
    for _ in range(2):
        forget_seeds()
        evaluate.main(evaluate.Args(runs=(run_dir,), episodes=2))
        rows.append((run_dir / "robustness.csv").read_bytes())
        (run_dir / "robustness.csv").unlink()
    assert rows[0] == rows[1]
    assert_closed(log(), number=2 + 2 * 2)
    with make_noisy(ppo.make_env(ALONE["env_id"]), [], []) as env:
        *_, second = evaluate.play_episodes(env, half, 2, seed=5)
        assert evaluate.play_episodes(env, half, 1, seed=6) == [second]
    (run_dir / "policy.pt").write_bytes(b"damaged")
    assert evaluate.main(evaluate.Args(runs=(run_dir,), episodes=2)) == 2
    assert_closed(log(), number=8)


# WHAT THE ENVIRONMENT RETURNS, AND WHAT IT IS GIVEN


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
                action = ppo.make_policy(agent, ppo.Normalizer((2,)), env)(observation)
            else:
                actor = script.Actor(env).requires_grad_(False)
                action = actor.policy(observation, np.float32([sign * 1000]))
            assert env.action_space.contains(action), action
            before = action.copy()
            env.step(action)
            np.testing.assert_array_equal(action, before)  # what a buffer stores


@pytest.mark.parametrize("name", ["HostileHalf", "HostileDouble"])
@each_script
def test_a_run_with_other_floats_has_networks_of_float32(algorithm, name, tmp_path):
    saved = policy(run(algorithm, tmp_path, env_id=f"hostile_envs:{name}-v0"))
    networks = {name: tensor for name, tensor in saved.items() if "stats" not in name}
    assert {tensor.dtype for tensor in networks.values()} == {torch.float32}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("OfOldAPI", "step 1 of an episode: the environment's step() must return (observation, "),
        ("ResetOfOldAPI", "step 0 of an episode: the environment's reset(seed=..., options=...) m"),
        ("ResetOfNothing", "step 0 of an episode: the environment's reset(seed=..., options=...) "),
        ("OtherShape", "step 1 of an episode: the environment returned an observation of shape ("),
    ],
)
@one_script
def test_what_is_not_the_api_is_one_line(algorithm, name, message, tmp_path, log):
    with pytest.raises(SpaceError, match=f"^{re.escape(message)}") as error:
        run(algorithm, tmp_path / "runs", env_id=f"hostile_envs:{name}-v0")
    assert re.search(r"expected |\(2, 1\), and its obs|argument 'seed'", str(error.value))
    assert_closed(log())


@pytest.mark.slow
@one_script
def test_what_is_not_the_api_is_no_traceback(algorithm, tmp_path, log):
    result = commands.ended(start(algorithm, tmp_path, env_id="hostile_envs:OtherShape-v0"))
    assert result.code == 1
    assert_one_line(result.err, "training stopped: step 1 of an episode: the environment returned")
    run_dir = run(algorithm, tmp_path / "runs", **ALONE)
    words = [run_dir, "--env-id", "hostile_envs:OtherShape-v0"]
    before = functools.partial(on_its_own, os.environ["HOSTILE_LOG"])
    result = commands.run(ROOT / "evaluate.py", words, before=before)
    assert result.code == 1
    assert_one_line(result.err, "step 1 of an episode: the environment returned an observation of")


@pytest.mark.parametrize(
    ("env_id", "reward"),
    [
        ("hostile_envs:NoReward-v0", "None"),
        ("hostile_envs:TwoRewards-v0", "[1.0, 1.0]"),
        ("toy_envs:TextReward-v0", "'1.0'"),
    ],
)
@one_script
def test_what_is_no_reward_is_one_line(algorithm, env_id, reward, tmp_path):
    message = f"step 1 of an episode: the environment returned the reward {reward}"
    with pytest.raises(NotFiniteError, match=f"^{re.escape(message)}$"):
        run(algorithm, tmp_path, env_id=env_id)


@one_script
def test_an_exit_of_the_environment_is_an_error_with_its_place(algorithm, tmp_path):
    with pytest.raises(RuntimeError, match="^step 1 of an episode: .* sys.exit") as error:
        run(algorithm, tmp_path, env_id="hostile_envs:Exits-v0")
    assert Path(error.traceback[-1].path).name == "hostile_envs.py"


@one_script
def test_an_exit_of_the_constructor_is_a_line(algorithm, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        run(algorithm, tmp_path, env_id="hostile_envs:ExitsAtOnce-v0")
    assert stopped.value.code == 2
    assert_one_line(capsys.readouterr().err, "ExitsAtOnce-v0: the environment called sys.exit(0)")


@one_script
def test_the_words_of_an_exit_are_told(algorithm, capsys):
    with pytest.raises(SystemExit), SCRIPTS[algorithm].fail_on(SystemExit, "--env-id Mine-v0"):
        try:
            raise FileNotFoundError("no data")
        except OSError:
            sys.exit("run ./download.sh first")
    assert_one_line(capsys.readouterr().err, "called sys.exit('run ./download.sh first')")


@one_script
def test_an_info_may_be_none(algorithm, tmp_path):
    run(algorithm, tmp_path, env_id="hostile_envs:NoInfo-v0")


@one_script
def test_what_cannot_be_closed_has_been_trained_in(algorithm, tmp_path):
    with pytest.warns(UserWarning, match=r"closing the environment failed: OSError\('no window'\)"):
        run_dir = run(algorithm, tmp_path, env_id="hostile_envs:BadClose-v0")
    assert (run_dir / "result.json").exists()


@pytest.mark.slow
@one_script
def test_what_the_environment_compiles_is_no_reason_to_start_again(algorithm, tmp_path):
    result = commands.ended(start(algorithm, tmp_path, env_id="hostile_envs:OwnCompiler-v0"))
    assert result.code == 1 and "Unsupported: a graph of its own" in result.err
    assert "starting again" not in result.out


# ACTIONS


def test_bounds_that_ppo_does_not_reach(tmp_path, capsys):
    run("PPO", tmp_path / "ppo", env_id="toy_envs:Heater-v0")
    assert capsys.readouterr().out.count("which reaches little of these bounds; wrap it") == 1
    run("TD3", tmp_path / "td3", env_id="toy_envs:Heater-v0")
    assert "reaches little" not in capsys.readouterr().out


# NO TIME LIMIT


@each_script
def test_what_never_ends_is_cut(algorithm, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(SCRIPTS[algorithm], "STEP_LIMIT", 11)
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:Endless-v0")
    assert {row[3] for row in evaluations(run_dir)} == {11}
    said = "toy_envs:Endless-v0 declares no time limit, so --max-episode-steps is 11\n"
    assert capsys.readouterr().out.count(said) == 1
    assert json.loads((run_dir / "config.json").read_text())["args"]["max_episode_steps"] is None
    evaluate.main(evaluate.Args(runs=(run_dir,), episodes=2))
    assert ",11\n" in (run_dir / "robustness.csv").read_text()


def test_the_cut_is_at_ten_thousand_steps():
    for script in SCRIPTS.values():
        assert script.make_env("toy_envs:Endless-v0").spec.max_episode_steps == 10_000
        assert script.make_env("Pendulum-v1").spec.max_episode_steps == 200


# WITHOUT MUJOCO


@pytest.mark.slow
@one_script
def test_a_renderer_that_is_missing_matters_to_mujoco_alone(algorithm, tmp_path):
    words = flags(arguments(algorithm, tmp_path / "runs", **ALONE))
    result = real_command(algorithm, *words, MUJOCO_GL="missing")
    assert (result.code, result.err) == (0, "")
    words[words.index(ALONE["env_id"])] = "Hopper-v5"
    result = real_command(algorithm, *words, MUJOCO_GL="missing")
    assert result.code == 2
    assert_one_line(result.err, "Hopper-v5 imports MuJoCo, which fails with MUJOCO_GL=missing (")


# THE FOLDER


@pytest.fixture
def run_dir(tmp_path):
    """The folder of a finished run."""
    return run("PPO", tmp_path / "runs", **ALONE)


def test_a_folder_that_is_a_link_is_refused(run_dir, tmp_path, capsys):
    other = run_dir.rename(tmp_path / "other")
    run_dir.symlink_to(other)
    before = {path.name: path.read_bytes() for path in other.iterdir()}
    for overwrite in (True, False):
        with pytest.raises(SystemExit) as stopped:
            run("PPO", tmp_path / "runs", overwrite=overwrite, **ALONE)
        assert stopped.value.code == 2
        assert_one_line(capsys.readouterr().err, f"{run_dir} is a link: remove it, or choose")
    assert {path.name: path.read_bytes() for path in other.iterdir()} == before
    run_dir.unlink()
    (tmp_path / "link").symlink_to(tmp_path / "runs")  # --runs-dir may be one
    run("PPO", tmp_path / "link", **ALONE)
    assert (run_dir / "result.json").exists()


def test_overwrite_deletes_our_files_and_no_others(run_dir, tmp_path, monkeypatch):
    mine = ["notes.txt", "notes.json", "notes.tmp", "events.md", "robustness.csv.bak"]
    for name in [*mine, "robustness.csv", "checkpoint.tmp"]:
        (run_dir / name).write_text("mine")
    [old] = run_dir.glob("events.out.tfevents.*")
    monkeypatch.chdir(tmp_path)  # a relative --runs-dir, as in most commands
    args = arguments("PPO", "runs", overwrite=True, **ALONE)
    assert ppo.train(args)
    assert [(run_dir / name).read_text() for name in mine] == ["mine"] * len(mine)
    assert not any(path.exists() for path in (old, run_dir / "robustness.csv"))
    assert not (run_dir / "checkpoint.tmp").exists()
    (run_dir / "config.json").unlink()  # notes.json is no reason to refuse the folder
    for name in ("result.json", "eval.csv", "policy.pt"):
        (run_dir / name).unlink()
    assert ppo.train(arguments("PPO", "runs", **ALONE))


def test_links_in_the_folder_are_not_followed(run_dir, tmp_path, capsys):
    target = tmp_path / "target"
    for name in (".lock", "eval.csv", "eval.tmp", "policy.pt"):
        target.write_text("mine")
        (run_dir / name).unlink(missing_ok=True)
        (run_dir / name).symlink_to(target)
        if name == ".lock":
            with pytest.raises(SystemExit):
                run("PPO", tmp_path / "runs", overwrite=True, **ALONE)
            assert ".lock" in capsys.readouterr().err
            (run_dir / name).unlink()
            os.link(target, run_dir / name)
            run("PPO", tmp_path / "runs", overwrite=True, **ALONE)
        else:
            run("PPO", tmp_path / "runs", overwrite=True, **ALONE)
            assert not (run_dir / name).is_symlink()
        assert target.read_text() == "mine"


# CLOCKS AND PROGRESS


@pytest.mark.parametrize("clock", ["set back", "frozen"])
@one_script
def test_a_clock_may_be_set_back_or_stand_still(algorithm, clock, tmp_path, monkeypatch):
    wall = iter(range(10**9, 0, -1000))
    monkeypatch.setattr(time, "time", lambda: float(next(wall)))
    if clock == "frozen":
        monkeypatch.setattr(time, "monotonic", lambda: 12345.678)
    run_dir = run(algorithm, tmp_path, **ALONE)
    result = json.loads((run_dir / "result.json").read_text())
    assert result["steps_per_second"] > 0 and result["wall_time_seconds"] > 0
    events = EventAccumulator(str(run_dir)).Reload()
    assert min(event.value for event in events.Scalars("charts/SPS")) > 0


@each_script
def test_progress_goes_forward(algorithm, tmp_path, monkeypatch, capsys):
    clock = itertools.count(step=11)  # a line of progress may be printed every 10 seconds
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))
    run_dir = run(algorithm, tmp_path, eval_frequency=7, **ALONE)
    steps = [int(step) for step in re.findall(r"^step=(\d+)/", capsys.readouterr().out, re.M)]
    assert steps == sorted(steps) and steps[-1] == 60 and len(steps) > 3
    events = EventAccumulator(str(run_dir)).Reload()
    for tag in events.Tags()["scalars"]:
        steps = [event.step for event in events.Scalars(tag)]
        assert steps == sorted(set(steps)), tag


# THE COMPILER'S CACHE


COMPILED = """
import torch
import noisy_wrappers as noisy

noisy.clean_compiler_cache()
try:
    update = torch.compile(lambda x: (x.sin().exp() * x).sum())
    print("result", update(torch.linspace(-1, 1, 1001)).item().hex())
except Exception as error:
    noisy.start_again_if_not_compiled(error)
    raise
"""


def compiled(words, cache, **environment):
    """Run Python with a cache for its compiler -> what it prints."""
    environment |= {"TORCHINDUCTOR_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    return subprocess.check_output(
        [sys.executable, *words], env=os.environ | environment, text=True
    )


def empty(paths, seconds):
    """Leave what a compiler leaves that was killed some seconds ago."""
    paths = list(paths)
    assert paths
    for path in paths:
        path.write_bytes(b"")
        os.utime(path, (time.time() - seconds, time.time() - seconds))


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
def test_what_a_killed_compiler_leaves_changes_nothing(tmp_path):
    program, cache = tmp_path / "program.py", tmp_path / "cache"
    program.write_text(COMPILED)
    # what the compiler tries first: which vector instructions this processor has
    ask = "from torch._inductor.cpu_vec_isa import pick_vec_isa; pick_vec_isa()"
    compiled(["-c", ask], cache, TORCHINDUCTOR_VEC_ISA_OK="")
    empty(cache.rglob("*.so"), seconds=100)
    first = compiled([program], cache, TORCHINDUCTOR_VEC_ISA_OK="")
    assert first.startswith("result")
    # now a kernel, too young to be removed: a compiler may be at work
    empty(cache.rglob("*.main.so"), seconds=0)
    said, again = compiled([program], cache, TMPDIR=str(tmp_path)).split("\n", 1)
    assert said.startswith("not compiled, starting again: ") and "file too short" in said
    assert again == first


@pytest.mark.slow
def test_without_a_compiler_it_starts_again_and_trains_eagerly(tmp_path):
    short = ALONE | {"total_timesteps": 24, "eval_frequency": 0, "matmul_precision": "highest"}
    words = flags(arguments("PPO", tmp_path / "runs", compile=True, **short))
    caches = {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"), "TMPDIR": str(tmp_path)}
    no_compiler = {"CXX": str(tmp_path / "no-compiler"), "TORCHINDUCTOR_VEC_ISA_OK": ""}
    result = real_command("PPO", *words, **caches, **no_compiler)
    assert (result.code, result.err) == (0, "")
    assert result.out.count("not compiled, starting again: No working C++ compiler found") == 1
    [run_dir] = (tmp_path / "runs").iterdir()
    plain = policy(run("PPO", tmp_path / "plain", **short))
    torch.testing.assert_close(policy(run_dir), plain, rtol=0, atol=0)
