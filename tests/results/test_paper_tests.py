"""How the paper tested PPO: the program plays six ways beside training; the verdicts by hand."""

import multiprocessing
import os
import signal
import sys
import time

import gymnasium as gym
import numpy as np
import pandas as pd
import paper_tests
import pytest
import torch
import ways
from scipy import stats

import ppo_continuous_noisy as ppo
from noisy_wrappers import make_noisy

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
    assert len(table) == 6 * 3 * 3 and set(table["way"]) == set(ways.WAYS)
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
    for statistics in ways.STATISTICS:
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
    for env_id, noise, rate, seed in ways.planned_runs():
        run = ppo.Args(env_id, seed, noise=noise, noise_rate=rate, runs_dir=str(everything))
        paper_tests.folder_of(run).mkdir(parents=True)
        (paper_tests.folder_of(run) / "tests.csv").touch()
    monkeypatch.setattr(sys, "argv", ["paper_tests.py", "--runs-dir", str(everything)])
    before = signal.getsignal(signal.SIGTERM)
    assert paper_tests.main() == 0
    signal.signal(signal.SIGTERM, before)
    assert "50 of 50 runs are finished" in capsys.readouterr().out


def test_bad_input(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["paper_tests.py", "--jobs", "0"])
    assert paper_tests.main() == 2
    assert capsys.readouterr().err == "error: --jobs must be at least 1, not 0\n"


def start_program(runs_dir):
    os.setsid()
    sys.argv = ["paper_tests.py", "--runs-dir", str(runs_dir)]
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


# ------------------------------------------------------------------------------------- the verdicts


def test_the_plan():
    runs = ways.planned_runs()
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


def test_the_difference_from_the_paper_is_welchs():
    returns, paper = np.array([1.0, 2, 3, 6]), np.array([4.0, 5, 7, 9, 10])
    found = ways.from_paper(returns, (paper.mean(), paper.std(ddof=1), 5))
    expected = stats.ttest_ind(returns, paper, equal_var=False)
    assert found == pytest.approx((expected.statistic, expected.pvalue))


def test_the_interval_of_a_gain():
    """At 50 % the means agree exactly; the interval is Fieller's for many runs."""
    rng = np.random.default_rng(0)
    noisy, baseline = rng.normal(150, 20, 4000), rng.normal(100, 20, 4000)
    noisy, baseline = noisy + 150 - noisy.mean(), baseline + 100 - baseline.mean()
    assert ways.p_of_gain(noisy, baseline, 50) == pytest.approx(1)
    error = 100 * np.sqrt(noisy.var() + 1.5**2 * baseline.var()) / 100 / np.sqrt(4000)
    assert ways.p_of_gain(noisy, baseline, 50 + 1.96 * error) == pytest.approx(0.05, abs=0.003)
    assert ways.p_of_gain(noisy, baseline, 50 - 1.96 * error) == pytest.approx(0.05, abs=0.003)


def test_verdicts_by_hand():
    level = 0.05 / 6
    good = {"baselines": [(1.9, 0.07), (-1, 0.3)], "controls": [(0, 1.0), (0.5, 0.6)]}
    good |= {"gain": 80.0, "p_no_gain": level / 2, "p_paper_gain": 0.5}
    cases = [
        ({}, "reproduces"),
        ({"baselines": [(2.1, 0.05), (-1, 0.3)]}, "not excluded"),
        ({"controls": [(0, 1.0), (-2.1, 0.05)]}, "not excluded"),
        ({"p_no_gain": 2 * level}, "not excluded"),
        ({"gain": -80.0}, "not excluded"),
        ({"p_paper_gain": 2 * level}, "reproduces"),
        ({"p_paper_gain": level / 2}, "excluded"),
        ({"baselines": [(2.9, level / 2), (-1, 0.3)]}, "excluded"),
        ({"controls": [(0, 1.0), (-2.9, level / 2)]}, "excluded"),
        ({"baselines": [(2.5, 2 * level), (-1, 0.3)]}, "not excluded"),
    ]
    for change, expected in cases:
        assert ways.verdict(**good | change) == expected, change
