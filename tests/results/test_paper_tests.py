"""How the paper tested PPO: the program plays six ways beside training."""

import multiprocessing
import os
import signal
import sys
import time

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch

import ppo_continuous_noisy as ppo
from noisy_wrappers import make_noisy
from results.experiments import paper_tests

SMALL = {"total_timesteps": 60, "num_steps": 12, "num_minibatches": 3, "update_epochs": 2}
SMALL |= {"env_id": "toy_envs:Tiny-v0", "eval_frequency": 20, "eval_episodes": 3, "compile": False}


def small_args(runs_dir, **kwargs):
    return ppo.Args(runs_dir=str(runs_dir), **SMALL | kwargs)


@pytest.fixture
def tested(tmp_path):
    """Return the folder of a small run of the program, and its tests.csv."""
    args = small_args(tmp_path / "tested")
    paper_tests.train(args)
    folder = paper_tests.folder_of(args)
    return folder, pd.read_csv(folder / "tests.csv")


@pytest.mark.slow
def test_training_does_not_notice_the_tests(tested, tmp_path):
    folder, _ = tested
    noise = {"noise": ("RandomNormalNoisyReward(0.5)",), "noise_rate": (0.5,)}
    for name, options in (("plain", {}), ("noisy", noise)):
        alone, together = (small_args(tmp_path / f"{name}{i}", **options) for i in range(2))
        assert ppo.train(alone)
        paper_tests.train(together)
        folders = [paper_tests.folder_of(args) for args in (alone, together)]
        for file in ("eval.csv", "policy.pt"):
            first, second = ((folder / file).read_bytes() for folder in folders)
            assert first == second, file
    assert ppo.evaluate is paper_tests.evaluate and ppo.make_policy is paper_tests.make_policy


def test_the_table_has_every_episode_and_the_scripts_own_tests(tested):
    folder, table = tested
    assert list(table) == ["way", "step", "episode", "episodic_return"]
    assert len(table) == 6 * 3 * 3 and set(table["way"]) == set(paper_tests.WAYS)
    own = table[table["way"] == "training-mean"].drop(columns="way").reset_index(drop=True)
    evaluations = pd.read_csv(folder / "eval.csv").drop(columns="episodic_length")
    pd.testing.assert_frame_equal(own, evaluations)


def test_the_ways_differ_as_they_say(tested):
    """Accumulated and new statistics agree in the first test only; sampled actions differ."""
    _, table = tested
    returns = {
        way: group.sort_values(["step", "episode"])["episodic_return"].to_numpy().reshape(3, 3)
        for way, group in table.groupby("way")
    }
    own, per_test = returns["own-mean"], returns["own_per_test-mean"]
    assert (own[0] == per_test[0]).all() and (own[1:] != per_test[1:]).all()
    assert (returns["training-mean"] != own).all()
    for statistics in paper_tests.STATISTICS:
        assert (returns[f"{statistics}-mean"] != returns[f"{statistics}-sampled"]).all()


def test_a_test_with_statistics_of_its_own_by_hand():
    """An untrained policy, two tests: the statistics take every observation, also the last ones."""
    args = small_args("unused", max_episode_steps=20)
    torch.manual_seed(0)
    env = make_noisy(ppo.make_env(args.env_id, max_episode_steps=20), (), ())
    agent = ppo.Agent(env).requires_grad_(False)
    agent.actor_mean[-1].weight.normal_(0, 0.1)
    six = paper_tests.SixWays(args)
    six.make_policy(agent, ppo.Normalizer((3,)), env)
    played = [six.play("own", "mean", 2)[:, 0] for _ in range(2)]
    observations, expected = [], []
    for episode in (0, 1, 0, 1):
        observation, _ = env.reset(seed=ppo.TEST_SEED + episode)
        observations.append(observation)
        done, total = False, 0.0
        while not done:
            seen = np.array(observations)
            # they begin with mean 0 and variance 1, which weigh as 1e-4 of an observation
            mean = seen.sum(0) / (len(seen) + 1e-4)
            var = 1e-4 * (1 + mean**2) + np.square(seen - mean).sum(0)
            z = (observation - mean) / np.sqrt(var / (len(seen) + 1e-4) + 1e-8)
            action = ppo.in_numpy(agent.actor_mean)(z.clip(-10, 10).astype(np.float32))
            action = action.clip(env.action_space.low, env.action_space.high)
            observation, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            observations.append(observation)
            total += reward
        expected.append(total)
    assert np.concatenate(played) == pytest.approx(expected, rel=1e-4)


def test_finished_runs_are_skipped_and_others_begin_anew(tested, monkeypatch, capsys, tmp_path):
    folder, _ = tested
    args = small_args(folder.parent)
    assert paper_tests.is_finished(args)
    text = (folder / "tests.csv").read_text()
    (folder / "tests.csv").unlink()  # killed after result.json and before tests.csv
    assert not paper_tests.is_finished(args)
    args.overwrite = True
    assert paper_tests.try_to_train(args)
    assert (folder / "tests.csv").read_text() == text
    everything = tmp_path / "all"
    for env_id, noise, rate, seed in paper_tests.planned_runs():
        run = ppo.Args(env_id, seed, noise=noise, noise_rate=rate, runs_dir=str(everything))
        paper_tests.folder_of(run).mkdir(parents=True)
        (paper_tests.folder_of(run) / "tests.csv").touch()
    monkeypatch.setattr(sys, "argv", ["paper_tests", "--runs-dir", str(everything)])
    before = signal.getsignal(signal.SIGTERM)
    assert paper_tests.main() == 0
    signal.signal(signal.SIGTERM, before)
    assert "50 of 50 runs are finished" in capsys.readouterr().out


def test_bad_input(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["paper_tests", "--jobs", "0"])
    assert paper_tests.main() == 2
    assert capsys.readouterr().err == "error: --jobs must be at least 1, not 0\n"


def start_program(runs_dir):
    os.setsid()
    sys.argv = ["paper_tests", "--runs-dir", str(runs_dir)]
    sys.exit(paper_tests.main())


@pytest.mark.slow
def test_sigterm_ends_the_program_and_its_runs(tmp_path):
    process = multiprocessing.get_context("fork").Process(target=start_program, args=(tmp_path,))
    process.start()
    deadline = time.time() + 200
    while not list(tmp_path.glob("*/eval.csv")) and time.time() < deadline:
        time.sleep(0.2)
    assert list(tmp_path.glob("*/eval.csv"))
    process.terminate()
    process.join(60)
    assert process.exitcode == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):  # nothing of its process group is left
        for _ in range(100):
            os.killpg(process.pid, 0)
            time.sleep(0.1)
    assert not list(tmp_path.glob("*/tests.csv"))


def test_the_plan():
    runs = paper_tests.planned_runs()
    assert len(runs) == len(set(runs)) == 2 * 2 * 10 + 2 * 5
    assert [seed for *_, seed in runs] == sorted(seed for *_, seed in runs)
    noises = {(env_id, *noise, *rate) for env_id, noise, rate, _ in runs if noise}
    assert noises == {
        ("Hopper-v5", "RandomNormalNoisyReward(1.0)", 1.0),
        ("Walker2d-v5", "RandomUniformScaleReward(0.8, 1.2)", 0.05),
    }
    for env_id, noise, rate, _ in runs:
        if noise:
            make_noisy(gym.make(env_id), noise, rate)
