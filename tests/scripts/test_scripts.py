"""The three scripts as a user meets them: runs, run folders, TensorBoard, errors, learning."""

import ast
import csv
import inspect
import json
import math
import os
import re
import signal
import subprocess
import sys
import urllib.parse
import urllib.request
from dataclasses import asdict, fields, replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import commands
import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
import toy_envs
import tqdm
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ppo_continuous_noisy as ppo
import sac_continuous_noisy as sac
import td3_continuous_noisy as td3
from noisy_wrappers import NoiseWrapper, NotFiniteError, signatures

ROOT = Path(__file__).parents[2]
SCRIPTS = {"SAC": sac, "TD3": td3, "PPO": ppo}
OFF_POLICY = {"total_timesteps": 60, "learning_starts": 20, "batch_size": 8, "buffer_size": 50}
ON_POLICY = {"total_timesteps": 60, "num_steps": 12, "num_minibatches": 3, "update_epochs": 2}
SMALL = {"SAC": OFF_POLICY, "TD3": OFF_POLICY, "PPO": ON_POLICY}
NOISES = ("RandomNormalNoisyReward(0.5)", "RandomEarlyTermination(2, 4)")
RATES = (0.5, 0.25)

each_script = pytest.mark.parametrize("algorithm", SCRIPTS)
# What is in THE RUN or another part that a test finds to be the same text in the three scripts
# cannot break in one of them alone.
one_script = pytest.mark.parametrize("algorithm", ["PPO"])


def arguments(algorithm, runs_dir, **kwargs):
    """Return the arguments of a run of a second or less."""
    common = {"env_id": "toy_envs:Tiny-v0", "eval_frequency": 20, "eval_episodes": 3}
    common |= {"compile": False, "runs_dir": str(runs_dir)}
    return SCRIPTS[algorithm].Args(**common | SMALL[algorithm] | kwargs)


def run(algorithm, runs_dir, **kwargs):
    """Train in this process; return the run's folder."""
    assert SCRIPTS[algorithm].train(arguments(algorithm, runs_dir, **kwargs))
    [run_dir] = Path(runs_dir).iterdir()
    return run_dir


def command(algorithm, *options, cwd=ROOT):
    """Run a script as a user does, but for the imports (commands.py)."""
    return commands.run(SCRIPTS[algorithm].__file__, options, cwd=cwd)


def real_command(algorithm, *options, cwd=None, **environment):
    """Run a script as a user does."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    line = [sys.executable, SCRIPTS[algorithm].__file__, *map(str, options)]
    env = os.environ | {"PYTHONPATH": path} | environment
    result = subprocess.run(line, capture_output=True, text=True, cwd=cwd, env=env, timeout=240)
    return SimpleNamespace(code=result.returncode, out=result.stdout, err=result.stderr)


def flags(args):
    """Return the command line of arguments."""
    line = []
    for name, value in asdict(args).items():
        flag = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            line.append(flag if value else "--no-" + flag[2:])
        elif value is not None:
            line += [flag, *(value if isinstance(value, tuple) else (value,))]
    return [str(word) for word in line if word not in ("--noise", "--noise-rate") or args.noise]


def evaluations(run_dir):
    """Return eval.csv as [(step, episode, return, length)]."""
    with open(run_dir / "eval.csv") as file:
        header, *rows = csv.reader(file)
    assert header == ["step", "episode", "episodic_return", "episodic_length"]
    return [(int(step), int(i), float(value), int(length)) for step, i, value, length in rows]


def policy(run_dir):
    """Return the tensors of policy.pt."""
    saved = torch.load(run_dir / "policy.pt", weights_only=True)
    tensors = saved if torch.is_tensor(next(iter(saved.values()))) else {}
    for part in () if tensors else saved:
        tensors |= {f"{part}.{name}": tensor for name, tensor in saved[part].items()}
    return tensors


# THE RUN


@pytest.mark.parametrize("algorithm", ["SAC", "TD3"])
def test_a_buffer_takes_no_more_memory_than_the_run_fills(algorithm, tmp_path):
    enough, huge = (run(algorithm, tmp_path / str(n), buffer_size=n) for n in (60, 10**15))
    assert (enough / "eval.csv").read_bytes() == (huge / "eval.csv").read_bytes()
    torch.testing.assert_close(policy(enough), policy(huge), rtol=0, atol=0)


@each_script
def test_the_test_environment_is_clean(algorithm, tmp_path):
    script = SCRIPTS[algorithm]
    noises = (
        "RandomEarlyTermination(2)",
        "RandomNormalNoisyReward(1.0, loc=100)",
        "RandomUniformNoisyObservation(50, 60)",
    )
    with (
        mock.patch.object(script, "evaluate", wraps=script.evaluate) as evaluate,
        mock.patch.object(script.noisy, "make_noisy", wraps=script.noisy.make_noisy) as make_noisy,
    ):
        run_dir = run(algorithm, tmp_path, noise=noises, noise_rate=(1.0,))
    assert evaluate.call_count == 3
    for call in evaluate.call_args_list:
        env = call.args[1]
        assert env.unwrapped is not make_noisy.call_args.args[0].unwrapped
        while isinstance(env, gym.Wrapper):
            assert not isinstance(env, NoiseWrapper)
            env = env.env

    # the last evaluation, played again: mean actions, raw rewards, initial states of its own
    clean = gym.make("toy_envs:Tiny-v0")
    act = script.load_policy(run_dir, clean)
    for step, episode, episodic_return, length in evaluations(run_dir)[-3:]:
        observation, _ = clean.reset(seed=1_000_000 + episode)
        total = steps = 0
        done = False
        while not done:
            observation, reward, terminated, truncated, _ = clean.step(act(observation))
            total, steps, done = total + reward, steps + 1, terminated or truncated
        assert (step, length) == (60, steps)
        assert episodic_return == pytest.approx(total)


@one_script
def test_success_is_an_outcome(algorithm, tmp_path, capsys):
    env_id = "toy_envs:IsSuccess-v0"
    run_dir = run(algorithm, tmp_path, env_id=env_id)
    env, solved = SCRIPTS[algorithm].make_env(env_id), []
    for episode in range(3):
        env.reset(seed=1_000_000 + episode)
        solved.append(env.unwrapped.solved)
    assert 0 < sum(solved) < 3
    header, *lines = (run_dir / "eval.csv").read_text().splitlines()
    assert header == "step,episode,episodic_return,episodic_length,success"
    assert lines == [f"{s},{i},8.0,8,{solved[i]:d}" for s in (20, 40, 60) for i in range(3)]
    rate = sum(solved) / 3
    assert json.loads((run_dir / "result.json").read_text())["final_success_rate"] == rate
    out = capsys.readouterr().out
    assert f" eval_return=8.000 success_rate={rate:.2f} eta=" in out
    assert f"is finished: mean test return 8.000, success rate {rate:.2f}\n" in out
    events = EventAccumulator(str(run_dir)).Reload()
    curve = [event.value for event in events.Scalars("eval/success_rate")]
    assert curve == pytest.approx([rate] * 3)
    training = [event.value for event in events.Scalars("charts/success_rate")]
    totals = [value * n for n, value in enumerate(training, start=1)]  # solved until then
    assert set(np.diff([0, *totals]).round(6)) == {0, 1}
    assert SCRIPTS[algorithm].train(arguments(algorithm, tmp_path, env_id=env_id))
    assert f", success rate {rate:.2f}\n" in capsys.readouterr().out


@one_script
def test_an_environment_may_tell_success_alone(algorithm, tmp_path):
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:SuccessOnly-v0")
    table = [line.split(",") for line in (run_dir / "eval.csv").read_text().splitlines()]
    assert [row[4] for row in table] == ["success", *"000", *"011", *"000"]
    events = EventAccumulator(str(run_dir)).Reload()
    curve = [event.value for event in events.Scalars("eval/success_rate")]
    assert curve == pytest.approx([2 / 3, 0])


@one_script
def test_returns_are_recorded_before_reward_noise(algorithm, tmp_path):
    noises = ("RandomUniformScaleReward(100, 100)", "RandomEarlyTermination(3)")
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:Count-v0", noise=noises, noise_rate=(1.0,))
    result = json.loads((run_dir / "result.json").read_text())
    assert result["train_return_mean_last_100"] == 3  # of 3 steps, as early termination has it
    assert {row[2:] for row in evaluations(run_dir)} == {(8.0, 8)}


@one_script
def test_run_folder(algorithm, tmp_path, capsys):
    noise = {"noise": (*NOISES, "RandomMixupObservation(.1)"), "noise_rate": (0.5, 0.25, 0.0)}
    run_dir = run(algorithm, tmp_path, exp_name="an experiment", seed=7, **noise)
    slug = "p0.25+0.5_s7_EarlyTermination_2_4+NormalNoisyReward_0.5"
    assert run_dir.name == f"{slug}__toy_envs--Tiny-v0__an--experiment"
    files = {re.sub(r"tfevents.*", "tfevents", path.name) for path in run_dir.iterdir()}
    expected = {"config.json", "eval.csv", "events.out.tfevents", "policy.pt", "result.json"}
    assert files - {".lock"} == expected

    config = json.loads((run_dir / "config.json").read_text())
    args = arguments(algorithm, tmp_path, exp_name="an experiment", seed=7)
    args.noise = ["RandomEarlyTermination(2, 4)", "RandomNormalNoisyReward(0.5)"]
    args.noise_rate = [0.25, 0.5]
    assert config["args"] == asdict(args)
    assert config["algorithm"] == algorithm
    assert config["matmul_precision"] in ("highest", "medium")
    assert config["versions"] == {
        "python": ".".join(map(str, sys.version_info[:3])),
        "torch": torch.__version__,
        "gymnasium": gym.__version__,
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
    }
    commit, changes = (
        subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True).stdout.strip()
        for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
    )
    assert config["git_commit"] == (commit + "-dirty" * bool(changes) or None)

    rows = evaluations(run_dir)
    assert [row[:2] for row in rows] == [(s, i) for s in (20, 40, 60) for i in range(3)]
    last = np.array([row[2] for row in rows[-3:]])
    result = json.loads((run_dir / "result.json").read_text())
    assert result["final_return_mean"] == pytest.approx(last.mean())
    assert result["final_return_std"] == pytest.approx(last.std(ddof=1))
    assert result["final_return_n"] == 3
    assert result["total_timesteps"] == result["trained_timesteps"] == 60
    assert result["steps_per_second"] == pytest.approx(60 / result["wall_time_seconds"])
    assert math.isfinite(result["train_return_mean_last_100"])
    applied, counts = result["noise_applied_fraction"], result["noise_applied"]
    names = ["RandomEarlyTermination", "RandomNormalNoisyReward"]
    assert list(applied) == list(counts) == names
    assert counts["RandomNormalNoisyReward"][1] == 60  # steps; of the other, episodes
    assert 60 / 8 <= counts["RandomEarlyTermination"][1] <= 60
    for name, rate in zip(names, (0.25, 0.5), strict=True):
        assert applied[name] == counts[name][0] / counts[name][1]
        assert applied[name] == pytest.approx(rate, abs=0.3)
    assert set(result) == {
        "final_return_mean",
        "final_return_std",
        "final_return_n",
        "train_return_mean_last_100",
        "noise_applied_fraction",
        "noise_applied",
        "steps_per_second",
        "wall_time_seconds",
        "total_timesteps",
        "trained_timesteps",
    }

    # the same again, in another spelling: finished, and nothing is written
    mean = result["final_return_mean"]
    before = {path: path.stat().st_mtime_ns for path in run_dir.iterdir()}
    capsys.readouterr()
    noise = {"noise": ("RandomEarlyTermination(2,4)", "RandomNormalNoisyReward(.50)")}
    run(algorithm, tmp_path, exp_name="an experiment", seed=7, noise_rate=(0.25, 0.5), **noise)
    finished = f"{run_dir} is finished: mean test return {mean:.1f}\n"
    assert (
        capsys.readouterr().out
        == f"{finished}See its curves with: tensorboard --logdir {tmp_path}\n"
    )
    lock = run_dir / ".lock"
    after = {path: path.stat().st_mtime_ns for path in run_dir.iterdir()}
    assert after.keys() == before.keys()
    assert all(after[path] == before[path] for path in before.keys() - {lock})


@each_script
def test_ten_tests_at_least_and_a_run_keeps_its_frequency(algorithm, tmp_path):
    script, short = SCRIPTS[algorithm], {"eval_frequency": None, "eval_episodes": 1}
    assert script.Args.eval_frequency is None
    assert (50_000 if algorithm == "PPO" else 10_000) == script.EVAL_FREQUENCY  # at most
    folder = run(algorithm, tmp_path / "short", **short)
    made_with = json.loads((folder / "config.json").read_text())["args"]["eval_frequency"]
    assert made_with == 6  # a tenth of 60 steps; PPO tests once in 12 steps, a rollout
    steps = sorted({row[0] for row in evaluations(folder)})
    assert steps == list(range(12, 61, 12) if algorithm == "PPO" else range(6, 61, 6))
    # not given: as the run that goes on had it, whether it is finished or not
    folder = run(algorithm, tmp_path / "other", eval_frequency=14, eval_episodes=1)
    run(algorithm, tmp_path / "other", **short)
    args = arguments(algorithm, tmp_path / "stopped", eval_frequency=14, eval_episodes=1)
    stops = iter([False] * 3 + [True] * 100)
    assert not script.train(args, stop=lambda: next(stops))
    again = run(algorithm, tmp_path / "stopped", **short)
    assert (again / "eval.csv").read_bytes() == (folder / "eval.csv").read_bytes()


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"final_return_mean": 1'])
@one_script
def test_a_result_that_cannot_be_read_is_no_result(algorithm, content, tmp_path, capsys):
    short = {"total_timesteps": 12, "eval_frequency": 0, "learning_starts": 5}
    short = {name: short[name] for name in short.keys() & asdict(SCRIPTS[algorithm].Args()).keys()}
    result = run(algorithm, tmp_path, **short) / "result.json"
    whole = result.read_text()
    result.write_text(content)
    with pytest.raises(SystemExit) as stopped:
        run(algorithm, tmp_path, **short)
    assert stopped.value.code == 2
    assert_one_line(capsys.readouterr().err, f"cannot read {result} (if damaged, --overwrite ")
    assert result.read_text() == content
    run(algorithm, tmp_path, overwrite=True, **short)
    assert json.loads(result.read_text()).keys() == json.loads(whole).keys()


@each_script
def test_overwrite_of_nothing_and_a_short_run(algorithm, tmp_path):
    short = {"total_timesteps": 5, "eval_frequency": 3, "eval_episodes": 1}
    short |= {"num_steps": 5, "num_minibatches": 1} if algorithm == "PPO" else {}
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:Count-v0", overwrite=True, **short)
    steps = [row[:2] for row in evaluations(run_dir)]
    assert steps == ([(5, 0)] if algorithm == "PPO" else [(3, 0), (5, 0)])
    result = json.loads((run_dir / "result.json").read_text())
    assert result["train_return_mean_last_100"] is None  # no episode ended
    assert result["final_return_std"] == 0
    assert result["noise_applied"] == {}


def test_ppo_evaluates_at_the_end_of_rollouts_under_the_nominal_step(tmp_path):
    rollouts = {"num_steps": 16, "num_minibatches": 2, "eval_episodes": 1}
    run_dir = run("PPO", tmp_path, total_timesteps=100, eval_frequency=20, **rollouts)
    result = json.loads((run_dir / "result.json").read_text())
    assert (result["total_timesteps"], result["trained_timesteps"]) == (100, 96)
    events = EventAccumulator(str(run_dir)).Reload()
    steps = [event.step for event in events.Scalars("eval/episodic_return_mean")]
    assert steps == [20, 40, 60, 80, 100]
    # rollouts end at 16, 32, ..., 96; 100 is what was asked for
    assert [row[0] for row in evaluations(run_dir)] == [20, 40, 60, 80, 100]
    run_dir = run("PPO", tmp_path / "often", total_timesteps=48, eval_frequency=5, **rollouts)
    assert [row[0] for row in evaluations(run_dir)] == [15, 30, 48]
    run_dir = run("PPO", tmp_path / "seldom", total_timesteps=64, eval_frequency=32, **rollouts)
    assert [row[0] for row in evaluations(run_dir)] == [32, 64]


@each_script
def test_observations_of_any_box_and_module_names(algorithm, tmp_path):
    run_dir = run(
        algorithm,
        tmp_path,
        env_id="toy_envs:Square-v0",
        noise=("RandomDropoutObservation(0.5)",),
        noise_rate=(0.5,),
    )
    env = SCRIPTS[algorithm].make_env("toy_envs:Square-v0")
    assert env.observation_space.shape == (4,)
    act = SCRIPTS[algorithm].load_policy(run_dir, env)
    assert env.action_space.contains(act(env.reset()[0]))


# THE THREE FILES


def definitions(script):
    """Return {name: source} of the functions and classes at the top level of a file."""
    source = Path(script.__file__).read_text()
    nodes = [node for node in ast.parse(source).body if hasattr(node, "name")]
    return {node.name: inspect.getsource(getattr(script, node.name)) for node in nodes}


def run_block(script):
    """Return the file from the comment on: helpers and main block."""
    return Path(script.__file__).read_text().partition("\n# THE RUN: ")[2]


def test_repeated_helpers_are_word_for_word_identical():
    everywhere = "make_env fail fail_on say read_args train evaluate "
    everywhere += "use_matmul_precision Run"
    off_policy = "mlp in_numpy TwinLinear Critic ReplayBuffer updater"
    by_design = {"Args", "Actor", "load_policy", "critic_loss", "actor_loss", "learn"}
    found = [definitions(script) for script in (sac, td3, ppo)]
    for name in everywhere.split():
        assert len({source[name] for source in found}) == 1, name
    for name in off_policy.split():
        assert found[0][name] == found[1][name], name
    # whatever else two files define is the same, or one of those that differ by design
    for one, other in ((0, 1), (0, 2), (1, 2)):
        common = found[one].keys() & found[other].keys()
        differ = {name for name in common if found[one][name] != found[other][name]}
        assert (
            differ <= by_design | {"mlp", "in_numpy", "updater"}
            if other == 2
            else differ <= by_design
        )
    assert run_block(sac) == run_block(td3) == run_block(ppo) != ""
    assert sac.TEST_SEED == td3.TEST_SEED == ppo.TEST_SEED


def test_arguments_that_scripts_share_have_one_meaning():
    """Defaults and help differ only where CleanRL's defaults do."""
    pattern = re.compile(r"((?:^    # .+\n)*)^    (\w+): (.+?) = (.+?)(?:  # (.+))?$", re.M)
    per_algorithm = {"eval_frequency", "learning_starts", "matmul_precision", "policy_frequency"}
    per_algorithm.add("total_timesteps")
    meanings = {}
    for script in SCRIPTS.values():
        documented = pattern.findall(inspect.getsource(script.Args))
        assert [name for _, name, *_ in documented] == [f.name for f in fields(script.Args)]
        for above, name, kind, default, behind in documented:
            assert above or behind, name
            above = "" if behind else above  # tyro takes what stands behind, if anything does
            meanings.setdefault(name, set()).add((kind, default, above, behind))
    differ = {name for name, values in meanings.items() if len(values) > 1}
    assert differ - {"learning_rate"} <= per_algorithm


@pytest.mark.parametrize(
    ("algorithm", "defaults"),
    [
        (
            "SAC",
            "total_timesteps=1000000 buffer_size=1000000 gamma=0.99 tau=0.005 batch_size=256 "
            "learning_starts=5000 policy_lr=0.0003 q_lr=0.001 policy_frequency=2 "
            "target_network_frequency=1 alpha=0.2 autotune=True",
        ),
        (
            "TD3",
            "total_timesteps=1000000 learning_rate=0.0003 buffer_size=1000000 gamma=0.99 "
            "tau=0.005 batch_size=256 policy_noise=0.2 exploration_noise=0.1 "
            "learning_starts=25000 policy_frequency=2 noise_clip=0.5",
        ),
        (
            "PPO",
            "total_timesteps=1000000 learning_rate=0.0003 num_steps=2048 anneal_lr=True "
            "gamma=0.99 gae_lambda=0.95 num_minibatches=32 update_epochs=10 norm_adv=True "
            "clip_coef=0.2 clip_vloss=True ent_coef=0.0 vf_coef=0.5 max_grad_norm=0.5 "
            "target_kl=None",
        ),
    ],
)
def test_defaults_are_cleanrls(algorithm, defaults):
    actual = asdict(SCRIPTS[algorithm].Args())
    assert [
        f"{name}={actual[name]}" for name in re.findall(r"(\w+)=", defaults)
    ] == defaults.split()


# COMPILATION


@pytest.mark.slow
@each_script
def test_compiled_and_plain_updates_agree(algorithm, tmp_path, capsys, monkeypatch):
    # SAC and PPO are compiled to C++; for TD3, whose graphs are much like SAC's, tracing is enough
    backend = "aot_eager" if algorithm == "TD3" else "inductor"
    graphs, real = [], torch.compile

    def spy(function, **kwargs):
        graphs.append(function.__name__)
        return real(function, backend=backend, **kwargs)

    monkeypatch.setattr(torch, "compile", spy)
    short = {} if algorithm == "PPO" else {"total_timesteps": 30}
    plain = run(algorithm, tmp_path / "plain", matmul_precision="highest", **short)
    assert graphs == []
    compiled = run(
        algorithm, tmp_path / "compiled", matmul_precision="highest", compile=True, **short
    )
    losses = {
        "SAC": {"critic_loss", "actor_loss", "temperature_loss"},
        "TD3": {"critic_loss", "actor_loss"},
        "PPO": {"clipped_gradient"},
    }
    assert set(graphs) == losses[algorithm]
    torch.testing.assert_close(policy(compiled), policy(plain), rtol=1e-4, atol=1e-5)

    if algorithm == "PPO":
        return  # too small for bfloat16 to be an option
    bf16 = {"matmul_precision": "bf16", "compile": algorithm == "TD3"}
    rough = run(algorithm, tmp_path / "bf16", **bf16, **short)
    assert json.loads((rough / "config.json").read_text())["matmul_precision"] == "bf16"
    exact, rough = (torch.cat([x.flatten() for x in policy(r).values()]) for r in (plain, rough))
    assert 1e-5 < (rough - exact).abs().max() < 0.05


# ENVIRONMENTS THAT ARE UNUSUAL


@one_script
def test_dict_observations_are_flattened(algorithm, tmp_path, capsys):
    noise = {"noise": ("RandomDropoutObservation(0.5)",), "noise_rate": (0.5,)}
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:DictObservation-v0", **noise)
    assert capsys.readouterr().out.count("observations are flattened") == 1
    env = SCRIPTS[algorithm].make_env("toy_envs:DictObservation-v0")
    assert env.reset()[0].tolist() == [0, 0, 0]
    assert env.step(env.action_space.sample())[0].tolist() == [1, 1, -1]
    assert env.action_space.contains(SCRIPTS[algorithm].load_policy(run_dir, env)(env.reset()[0]))


@one_script
def test_noise_on_the_numbers_beside_a_category(algorithm, tmp_path):
    noise = {"noise": ("RandomNormalNoisyObservation(0.5)",), "noise_rate": (0.5,)}
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:OneHotObservation-v0", **noise)
    result = json.loads((run_dir / "result.json").read_text())
    assert 0.3 < result["noise_applied_fraction"]["RandomNormalNoisyObservation"] < 0.7


@pytest.mark.parametrize("algorithm", ["TD3", "PPO"])  # SAC has TD3's buffer
def test_rewards_of_shape_1_are_numbers(algorithm, tmp_path):
    array = run(algorithm, tmp_path / "array", env_id="toy_envs:ArrayReward-v0")
    plain = run(algorithm, tmp_path / "plain", env_id="toy_envs:Count-v0")
    assert (array / "eval.csv").read_bytes() == (plain / "eval.csv").read_bytes()
    torch.testing.assert_close(policy(array), policy(plain), rtol=0, atol=0)


@one_script
def test_a_time_limit_of_ones_own(algorithm, tmp_path, capsys):
    limit = {"env_id": "toy_envs:Endless-v0", "max_episode_steps": 5}
    run_dir = run(
        algorithm, tmp_path, **limit, noise=("RandomEarlyTermination(6)",), noise_rate=(1,)
    )
    assert {row[2:] for row in evaluations(run_dir)} == {(5.0, 5)}
    said = capsys.readouterr()
    note = "RandomEarlyTermination(6) never acts: episodes have at most 5 steps"
    assert said.out.splitlines()[0] == note and "time limit" not in said.out and not said.err
    assert json.loads((run_dir / "config.json").read_text())["args"]["max_episode_steps"] == 5


@one_script
def test_a_test_without_a_time_limit_can_be_stopped(algorithm):
    script, asked = SCRIPTS[algorithm], []

    def stop():
        asked.append(True)
        return len(asked) == 30

    def act(observation):
        return np.zeros(1, np.float32)

    assert script.evaluate(act, script.make_env("toy_envs:Endless-v0"), 2, stop) is None
    assert len(asked) == 30
    assert (
        script.evaluate(act, script.make_env("toy_envs:Count-v0"), 2, stop)[:, :2].tolist()
        == [[8, 8]] * 2
    )
    assert len(asked) == 30  # it has a time limit: it was not asked again


@each_script
def test_a_test_that_was_stopped_is_not_written(algorithm, tmp_path):
    ends = {"env_id": "toy_envs:NoLimit-v0"}
    stops = iter([False] * 25 + [True])
    args = arguments(algorithm, tmp_path, **ends)
    assert not SCRIPTS[algorithm].train(args, stop=lambda: next(stops))
    whole = run(algorithm, tmp_path, **ends)
    alone = run(algorithm, tmp_path / "alone", **ends)
    assert (whole / "eval.csv").read_bytes() == (alone / "eval.csv").read_bytes()
    torch.testing.assert_close(policy(whole), policy(alone), rtol=0, atol=0)


@one_script
def test_what_a_constructor_draws_is_the_same_in_the_tests_of_all_runs(
    algorithm, tmp_path, monkeypatch
):
    class Goal(toy_envs.Count):
        def __init__(self):
            super().__init__()
            self.goal = np.random.normal()

    gym.register("Goal-v0", Goal, max_episode_steps=8)
    goals = []

    def learn(args, env, test_env, stop):
        goals.append((env.unwrapped.goal, test_env.unwrapped.goal))

    monkeypatch.setattr(SCRIPTS[algorithm], "learn", learn)
    for seed in (1, 2, 1):
        SCRIPTS[algorithm].train(arguments(algorithm, tmp_path, env_id="Goal-v0", seed=seed))
    (first, test), (second, same), again = goals
    assert test == same and again == (first, test)
    assert len({first, second, test}) == 3


@one_script
def test_a_name_without_version_is_recorded_with_it(algorithm, tmp_path):
    run_dir = run(algorithm, tmp_path, env_id="toy_envs:Tiny")
    assert "__toy_envs--Tiny-v0__" in run_dir.name
    assert json.loads((run_dir / "config.json").read_text())["args"]["env_id"] == "toy_envs:Tiny-v0"


@each_script
def test_a_rate_that_changes_follows_the_steps(algorithm, tmp_path):
    script, rates = SCRIPTS[algorithm], []
    noise = {"noise": ("RandomNormalNoisyReward(0.5)",), "noise_rate": ("1:0",)}
    with mock.patch.object(script.noisy, "set_progress", wraps=script.noisy.set_progress) as spy:
        run_dir = run(algorithm, tmp_path, env_id="toy_envs:Count-v0", **noise)
    rates = [call.args[1] for call in spy.call_args_list]
    assert rates == [step / 60 for step in range(8, 60, 8)]  # episodes of 8 steps
    assert run_dir.name.startswith("p1.0to0.0_s1_NormalNoisyReward_0.5__")
    assert json.loads((run_dir / "config.json").read_text())["args"]["noise_rate"] == ["1.0:0.0"]
    applied, of = json.loads((run_dir / "result.json").read_text())["noise_applied"][
        "RandomNormalNoisyReward"
    ]
    steps = np.arange(60)
    p = 1 - steps // 8 * 8 / 60
    assert of == 60
    assert abs(applied - p.sum()) < 4 * np.sqrt((p * (1 - p)).sum())


# BAD INPUT

BAD = [  # arguments, what the message names
    ({"env_id": "NoSuchEnv-v0"}, "NoSuchEnv"),
    ({"env_id": "no_such_module:Env-v0"}, "no_such_module"),
    ({"env_id": "Hopper-v2"}, "moved to the gymnasium-robotics project"),
    ({"env_id": "Pusher-v4"}, "only supported on `mujoco<3`"),
    ({"env_id": "CartPole-v1"}, "needs Box actions of floats in one dimension; CartPole-v1 has"),
    ({"exp_name": ".."}, "--exp-name must be a name, not '..'"),
    ({"noise": ("RandomNoise(1)",), "noise_rate": (0.1,)}, "RandomMixupObservation"),
    ({"noise": NOISES, "noise_rate": (0.1, 1.1)}, "1.1"),
    ({"noise": NOISES}, "noise without a noise rate"),
    (
        {
            "env_id": "toy_envs:OneHotObservation-v0",
            "noise": ("RandomDropoutObservation(0.5, keys='phase')",),
            "noise_rate": (0.1,),
        },
        "RandomDropoutObservation cannot perturb categories",
    ),
    ({"max_episode_steps": 0}, "--max-episode-steps must be at least 1, not 0"),
    ({"torch_threads": 100_000}, "--torch-threads must be at most"),
    ({"seed": -1}, "--seed must be at least 0, not -1\n"),
    ({"seed": 2**64}, "--seed must be at most 9223372036854775807"),
    ({"total_timesteps": 0}, "--total-timesteps must be at least 1, not 0\n"),
    ({"eval_frequency": -1}, "--eval-frequency must be at least 0"),
    ({"gamma": 1.1}, "--gamma must be at most 1, not 1.1\n"),
    ({"gamma": math.nan}, "--gamma must be at least 0, not nan\n"),
    ({"gae_lambda": 1.1}, "--gae-lambda must be at most 1"),
    ({"clip_coef": -0.1}, "--clip-coef must be at least 0"),
    ({"target_kl": math.nan}, "--target-kl must be at least 0, not nan"),
    ({"num_steps": 61}, "--num-steps must be from 2 * --num-minibatches (6) to"),
    ({"num_minibatches": 13}, "--num-minibatches"),
]
BAD_OF_OTHERS = [
    ({"env_id": "toy_envs:Unbounded-v0"}, "SAC needs bounded actions", "SAC"),
    ({"env_id": "toy_envs:Unbounded-v0"}, "TD3 needs bounded actions", "TD3"),
    ({"learning_starts": -1}, "--learning-starts must be at least 0", "SAC"),
    ({"tau": 1.5}, "--tau must be at most 1", "TD3"),
]
BAD_CASES = [*((*case, "PPO") for case in BAD), *BAD_OF_OTHERS]


def assert_one_line(stderr, word):
    """Check an error that says what to do, in one line; a bad noise lists the wrappers below it."""
    lines = stderr.split("\n")
    assert stderr.startswith("error: ") and lines.pop() == ""
    if "bad noise" in lines[0]:
        assert lines[1:] == [f"  {signature}" for signature in signatures()]
    else:
        assert len(lines) == 1
    assert word in stderr


@pytest.mark.parametrize(("bad", "word", "algorithm"), BAD_CASES)
def test_bad_input(bad, word, algorithm, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    args = replace(arguments(algorithm, "runs"), **bad)
    with pytest.raises(SystemExit) as stopped:
        SCRIPTS[algorithm].train(args)
    assert stopped.value.code == 2
    output = capsys.readouterr()
    assert_one_line(output.err, word)
    assert output.out == ""
    assert list(tmp_path.iterdir()) == []


@one_script
def test_runs_dir_that_cannot_be_written(algorithm, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for runs_dir in (tmp_path / "file", tmp_path / "file" / "runs", "/proc/runs"):
        with pytest.raises(SystemExit) as stopped:
            SCRIPTS[algorithm].train(arguments(algorithm, runs_dir))
        assert stopped.value.code == 2
        assert_one_line(capsys.readouterr().err, "--runs-dir")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
@one_script
def test_cuda_without_a_gpu(algorithm, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        SCRIPTS[algorithm].train(arguments(algorithm, tmp_path / "runs", cuda=True))
    assert stopped.value.code == 2
    assert_one_line(capsys.readouterr().err, "--cuda")
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "options", "word"),
    [
        ("PPO", ["--noise", "RandomUniformScaleReward(0.5)", "--noise-rate", "0.1"], "high"),
        ("SAC", ["--runs-dir", __file__], "--runs-dir"),
    ],
)
def test_bad_command(algorithm, options, word, tmp_path):
    """As test_bad_input, in a process of its own."""
    result = command(algorithm, *options, cwd=tmp_path)
    assert result.code == 2
    assert_one_line(result.err, word)
    assert result.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_module_beside_the_caller_and_steps_as_1e2(tmp_path):
    (tmp_path / "my_envs.py").write_text(
        "from toy_envs import Tiny, register\n\n\n"
        "class Mine(Tiny):\n"
        "    def reset(self, **kwargs):\n"
        "        import my_physics  # only now\n\n"
        "        return super().reset(**kwargs)\n\n\n"
        "register('Mine', Mine, 8)\n"
    )
    (tmp_path / "my_physics.py").touch()
    options = ["--env-id", "my_envs:Mine-v0", "--total-timesteps", "1.2E2", "--no-compile"]
    options += ["--learning-starts=5e1", "--eval-frequency", "0", "--eval-episodes", "1"]
    options += ["--exp-name", "lr=1e3", "--runs-dir=2e1"]  # these are names
    result = real_command("SAC", *options, cwd=tmp_path)
    assert (result.code, result.err) == (0, "")
    [run_dir] = (tmp_path / "2e1").iterdir()
    assert run_dir.name.endswith("__lr=1e3")
    args = json.loads((run_dir / "config.json").read_text())["args"]
    assert (args["total_timesteps"], args["learning_starts"]) == (120, 50)
    assert args["env_id"] == "my_envs:Mine-v0"


@pytest.mark.slow
def test_a_module_of_the_callers_wins_over_one_of_ours(tmp_path):
    (tmp_path / "analyze.py").write_text("from toy_envs import *\n")
    options = ["--total-timesteps", "20", "--eval-episodes", "1", "--no-compile"]
    options += ["--runs-dir", tmp_path / "runs"]
    result = command("SAC", "--env-id", "analyze:Tiny-v0", *options, cwd=tmp_path)
    assert (result.code, result.err) == (0, "")
    (tmp_path / "tqdm.py").write_text("from toy_envs import *\n")
    result = command("SAC", "--env-id", "tqdm:Tiny-v0", *options, cwd=tmp_path)
    assert result.code == 2
    assert_one_line(result.err, f"a module 'tqdm' is loaded already, from {tqdm.__file__}")


@pytest.mark.slow
def test_training_goes_on_when_its_reader_has_left(tmp_path):
    options = ["--env-id", "toy_envs:Tiny-v0", "--total-timesteps", "60", "--eval-frequency", "10"]
    options += ["--no-compile", "--learning-starts", "20", "--eval-episodes", "1"]
    alone = command("SAC", *options, "--runs-dir", tmp_path / "alone")
    assert alone.out.count("\n") > 6
    process = commands.start(sac.__file__, [*options, "--runs-dir", tmp_path / "runs"])
    os.read(process.out.fileno(), 1)
    process.out.close()
    result = commands.ended(process)
    assert (result.code, result.err) == (0, "")
    one, other = (next((tmp_path / name).iterdir()) / "eval.csv" for name in ("alone", "runs"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.slow
def test_ctrl_c_during_the_imports_is_no_traceback(tmp_path):
    (tmp_path / "gymnasium.py").write_text("import time; print('now', flush=True); time.sleep(60)")
    line = [sys.executable, sac.__file__]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env
    ) as process:
        assert process.stdout.readline() == "now\n"
        process.send_signal(signal.SIGINT)
        assert (process.wait(60), process.stderr.read()) == (-signal.SIGINT, "")


@pytest.mark.slow
@each_script
def test_help_has_examples_and_noises(algorithm):
    result = command(algorithm, "--help")
    assert result.code == 0
    text = result.out
    assert f"python {algorithm.lower()}_continuous_noisy.py --env-id HalfCheetah-v5" in text
    assert "module:Name-v0" in text
    for signature in signatures():
        assert f"  {signature}\n" in text
    groups = ["RUN", "NOISE", "TESTS", "SPEED", "ALGORITHM"]  # each begins with its name
    assert re.findall(r"\b([A-Z]+): ", text.partition(" options ")[2]) == groups


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "options", "word"),
    [("TD3", ["--total-timesteps", "many"], "many"), ("SAC", ["--no-such-option"], "no-such")],
)
def test_bad_command_of_tyros(algorithm, options, word, tmp_path):
    result = command(algorithm, *options, cwd=tmp_path)
    assert result.code == 2
    assert word in result.err + result.out
    assert "Traceback" not in result.err + result.out
    assert list(tmp_path.iterdir()) == []


# BUGS OF AN ENVIRONMENT, whose author needs the traceback


@pytest.mark.parametrize(
    ("env_id", "error", "note"),
    [
        ("toy_envs:BuggyConstructor-v0", KeyError, "(--env-id toy_envs:BuggyConstructor-v0)"),
        ("toy_envs:BadValue-v0", ValueError, "(--env-id toy_envs:BadValue-v0)"),
        ("toy_envs:BuggyReset-v0", KeyError, None),
        ("toy_envs:BuggyStep-v0", KeyError, None),
        ("toy_envs:Overflow-v0", FloatingPointError, None),
    ],
)
@one_script
def test_a_bug_of_an_environment_is_shown(algorithm, env_id, error, note, tmp_path):
    with pytest.raises(error) as raised:
        run(algorithm, tmp_path, env_id=env_id)
    assert raised.traceback[-1].path.name == "toy_envs.py"
    assert getattr(raised.value, "__notes__", [None]) == [note]


@pytest.mark.slow
def test_a_bug_of_an_environments_module_is_shown(tmp_path):
    (tmp_path / "buggy_module.py").write_text("undefined_name")
    result = command("PPO", "--env-id", "buggy_module:Env-v0", cwd=tmp_path)
    *traceback, error, note = result.err.splitlines()
    assert result.code == 1 and traceback[0] == "Traceback (most recent call last):"
    assert error.startswith("NameError: ") and note == "(training stopped)"
    assert any("buggy_module.py" in line for line in traceback)


# DIVERGENCE


@one_script
@pytest.mark.parametrize("what", ["Reward", "Observation"])
def test_nan_stops_the_run(algorithm, what, tmp_path):
    nan = {"env_id": f"toy_envs:Nan{what}-v0"}  # from step 70 on; episodes have 8 steps
    message = f"step 6 of an episode: the environment returned the {what.lower()} "
    with pytest.raises(NotFiniteError, match=message):
        run(algorithm, tmp_path, eval_frequency=0, total_timesteps=200, **nan)
    [run_dir] = tmp_path.iterdir()
    assert not (run_dir / "result.json").exists()
    assert not (run_dir / "policy.pt").exists()


@one_script
def test_nan_at_the_end_is_no_result(algorithm, tmp_path):
    late = {"env_id": "toy_envs:NanLate-v0", "total_timesteps": 190}  # NaN from step 130 on
    with pytest.raises(NotFiniteError):
        run(algorithm, tmp_path, eval_frequency=0, **late)
    [run_dir] = tmp_path.iterdir()
    assert not (run_dir / "result.json").exists()


@each_script
def test_a_loss_that_is_not_finite_stops_the_run(algorithm, tmp_path):
    rate = {
        "SAC": {"q_lr": 1e18, "total_timesteps": 22},  # before an action is NaN
        "TD3": {"learning_rate": 1e18, "total_timesteps": 22},
        "PPO": {"learning_rate": 1e18},
    }[algorithm]
    with pytest.raises(NotFiniteError, match=r"^step \d+: training diverged.*losses/"):
        run(algorithm, tmp_path, **rate)
    [run_dir] = tmp_path.iterdir()
    assert not (run_dir / "result.json").exists()


# THE COMMAND LINE AND TENSORBOARD

CURVES = {
    "SAC": "qf1_values qf2_values qf1_loss qf2_loss qf_loss actor_loss alpha alpha_loss",
    "TD3": "qf1_values qf2_values qf1_loss qf2_loss qf_loss actor_loss",
    "PPO": "value_loss policy_loss entropy old_approx_kl approx_kl clipfrac explained_variance",
}
CHARTS = "charts/SPS charts/episodic_return charts/episodic_length eval/episodic_return_mean "
CHARTS += "eval/episodic_return_std eval/episodic_length_mean "
CHARTS += "noise/RandomNormalNoisyReward/applied_fraction noise/RandomNormalNoisyReward/rate "
CHARTS += "noise/RandomEarlyTermination/applied_fraction noise/RandomEarlyTermination/rate"


@pytest.fixture(scope="module")
def three_runs(tmp_path_factory):
    """Return a folder with a run of each script, made by commands, and their results."""
    runs_dir = tmp_path_factory.mktemp("commands")
    results = {}
    for algorithm in SCRIPTS:
        args = arguments(algorithm, runs_dir, noise=NOISES, noise_rate=RATES, total_timesteps=240)
        results[algorithm] = flags(args), command(algorithm, *flags(args))
    return runs_dir, results


@pytest.mark.slow
@each_script
def test_command_line(algorithm, three_runs):
    runs_dir, results = three_runs
    line, result = results[algorithm]
    assert (result.code, result.err) == (0, "")
    [run_dir] = runs_dir.glob(f"*__{algorithm.lower()}_continuous_noisy")
    lines = result.out.splitlines()
    noises = "RandomEarlyTermination(2, 4) at 0.25 + RandomNormalNoisyReward(0.5) at 0.5"
    begun = (
        f"{algorithm} on toy_envs:Tiny-v0 | noise: {noises} | seed 1 | 240 steps | cpu | {run_dir}"
    )
    assert lines[0] == begun
    last, finished, curves = lines[-3:]  # not a terminal: plain lines
    assert curves == f"See its curves with: tensorboard --logdir {runs_dir}"
    assert re.search(r"step=240/240 sps=\d+ .*eval_return=-?\d+\.\d", last)
    assert re.fullmatch(rf"{re.escape(str(run_dir))} is finished: mean test return .*", finished)
    assert json.loads((run_dir / "config.json").read_text())["args"]["seed"] == 1
    again = command(algorithm, *line)
    assert (again.code, again.err) == (0, "")
    assert again.out == f"{finished}\n{curves}\n"


@pytest.fixture(scope="module")
def tensorboard(three_runs):
    """Serve the runs and return a function from a path of the HTTP API to its JSON."""
    line = [sys.executable, "-m", "tensorboard.main", "--logdir", three_runs[0]]
    line += ["--host", "127.0.0.1", "--port", "0", "--load_fast", "false"]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        try:
            for text in process.stderr:
                if address := re.search(r"http://127\.0\.0\.1:\d+", text):
                    break

            def get(path, body=None):
                data = body and json.dumps(body).encode()
                headers = {"Content-Type": "application/json"}
                request = urllib.request.Request(address[0] + path, data, headers)
                return json.load(urllib.request.urlopen(request, timeout=30))

            yield get
        finally:
            process.terminate()
            process.stderr.close()


@pytest.fixture
def scalars(tensorboard, three_runs):
    """Return a function from an algorithm to the name of its run and {tag: {step: value}}."""

    def read(algorithm):
        [run_dir] = three_runs[0].glob(f"*__{algorithm.lower()}_continuous_noisy")
        tags = tensorboard("/data/plugin/scalars/tags")[run_dir.name]
        values = {}
        for tag in tags:
            query = urllib.parse.urlencode({"run": run_dir.name, "tag": tag})
            points = tensorboard(f"/data/plugin/scalars/scalars?{query}")
            values[tag] = {step: value for _, step, value in points}
        return run_dir, values

    return read


def test_alpha_has_a_curve_when_it_is_not_tuned(tmp_path):
    run_dir = run("SAC", tmp_path, autotune=False, alpha=0.3)
    events = EventAccumulator(str(run_dir)).Reload()
    values = [event.value for event in events.Scalars("losses/alpha")]
    assert values == pytest.approx([0.3] * len(values)) and len(values) > 0
    assert "losses/alpha_loss" not in events.Tags()["scalars"]


@pytest.mark.slow
@each_script
def test_tensorboard_shows_the_curves(algorithm, scalars):
    run_dir, values = scalars(algorithm)
    losses = {f"losses/{name}" for name in CURVES[algorithm].split()}
    rate = {"charts/learning_rate"} if algorithm == "PPO" else set()
    assert set(values) == losses | rate | set(CHARTS.split())
    rows = np.array(evaluations(run_dir)).reshape(-1, 3, 4)
    steps = rows[:, 0, 0].astype(int).tolist()
    for tag, expected in (
        ("eval/episodic_return_mean", rows[:, :, 2].mean(1)),
        ("eval/episodic_return_std", rows[:, :, 2].std(1, ddof=1)),
        ("eval/episodic_length_mean", rows[:, :, 3].mean(1)),
    ):
        assert list(values[tag]) == steps
        assert list(values[tag].values()) == pytest.approx(list(expected))
    result = json.loads((run_dir / "result.json").read_text())
    episodes = list(values["charts/episodic_return"].values())
    assert len(episodes) > 30
    assert np.mean(episodes[-100:]) == pytest.approx(result["train_return_mean_last_100"])
    lengths = values["charts/episodic_length"]
    assert list(np.cumsum(list(lengths.values()))) == list(lengths)
    assert max(lengths.values()) <= 8
    every = 12 if algorithm == "PPO" else 100
    for tag in losses:
        assert set(values[tag]) == {*range(every, 241, every), 240}
    for name, fraction in result["noise_applied_fraction"].items():
        curve = values[f"noise/{name}/applied_fraction"]
        assert 0 < curve[max(curve)] < 1
        if max(curve) == 240:
            assert curve[240] == pytest.approx(fraction)
    assert min(values["charts/SPS"].values()) > 0


@pytest.mark.slow
def test_tensorboard_knows_the_hyperparameters(tensorboard, three_runs):
    names = {path.name for path in three_runs[0].iterdir()}
    assert set(tensorboard("/data/runs")) == names  # no runs besides
    texts = tensorboard("/data/plugin/text/tags")
    assert all("hyperparameters/text_summary" in texts[name] for name in names)
    statuses = ["STATUS_UNKNOWN", "STATUS_SUCCESS", "STATUS_FAILURE", "STATUS_RUNNING"]
    body = {"experimentName": "", "allowedStatuses": statuses, "startIndex": 0, "sliceSize": 10}
    body["colParams"] = [{"metric": {"group": "", "tag": "eval/episodic_return_mean"}}]
    groups = tensorboard("/data/plugin/hparams/session_groups", body)["sessionGroups"]
    assert len(groups) == 3
    assert {group["name"] for group in groups} == names  # readable, and one for each run
    experiment = tensorboard("/data/plugin/hparams/experiment", {"experimentName": ""})
    columns = [info["name"] for info in experiment["hparamInfos"]]
    assert set(columns) == {"env_id", "exp_name", "noise", "noise_rate", "seed"}
    metrics = [info["name"]["tag"] for info in experiment["metricInfos"]]
    assert metrics == ["eval/episodic_return_mean", "charts/episodic_return", "eval/success_rate"]
    for group in groups:
        noise = "RandomEarlyTermination(2, 4) + RandomNormalNoisyReward(0.5)"
        assert group["hparams"]["noise"] == noise
        assert group["hparams"]["noise_rate"] == "0.25 + 0.5"
        [session] = group["sessions"]
        assert session["status"] == "STATUS_SUCCESS"
        assert group["hparams"]["env_id"] == "toy_envs:Tiny-v0"
        steps = {value["name"]["tag"]: value["trainingStep"] for value in group["metricValues"]}
        assert steps["eval/episodic_return_mean"] == 240


# LEARNING

MILD = {
    "noise": ("RandomNormalNoisyReward(0.001)", "RandomUniformScaleReward(0.8, 1.2)"),
    "noise_rate": (0.1, 0.2),
}
FAST = {"buffer_size": 1000, "learning_starts": 200, "batch_size": 64, "tau": 0.02}
FAST |= {"gamma": 0.9, "eval_frequency": 100, "eval_episodes": 10}
LEARNERS = {
    "SAC": FAST | {"total_timesteps": 700, "policy_lr": 1e-3, "q_lr": 2e-3},
    "TD3": FAST | {"total_timesteps": 900, "learning_rate": 1e-3, "exploration_noise": 0.3},
    "PPO": {"total_timesteps": 6000, "num_steps": 500, "num_minibatches": 10, "gamma": 0.9}
    | {"learning_rate": 2e-3, "update_epochs": 10, "eval_frequency": 500, "eval_episodes": 10},
}


@pytest.mark.slow
@each_script
def test_learning(algorithm, tmp_path):
    """The mean return of the last three tests shows that the task is solved, in spite of noise.

    With seeds 1 and 2 it is -1.4 to -2.4. It is -9 or less with gamma = 0, about -10 for an agent
    that never pushes and about -20 for one that has not learned yet.
    """
    run_dir = run(algorithm, tmp_path, **LEARNERS[algorithm] | MILD, env_id="toy_envs:Push-v0")
    assert np.mean([row[2] for row in evaluations(run_dir)[-30:]]) > -4
    result = json.loads((run_dir / "result.json").read_text())
    for name, rate in zip(result["noise_applied"], MILD["noise_rate"], strict=True):
        assert result["noise_applied_fraction"][name] == pytest.approx(rate, rel=0.3)
