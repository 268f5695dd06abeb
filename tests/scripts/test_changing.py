"""docs/changing.md is true: its changes are applied to copies of the scripts, and trained.

With CHANGES=all in the environment (`make changes`), all ten go through everything, and not two.
"""

import importlib.util
import os
import re
import sys
from types import SimpleNamespace

import check_script
import commands
import numpy as np
import pytest
import torch
import watched_run
from small_runs import ROOT, slow
from sweeps import write_run

PAGE = (ROOT / "docs" / "changing.md").read_text()
SECTIONS = {
    int(number): text
    for number, text in re.findall(r"^## (\d+)\. (.*?)(?=^## )", PAGE, re.MULTILINE | re.DOTALL)
}
BASED_ON = {10: 6}  # a change that begins with another one
# options with which a change is tried, where its defaults are not enough, or slow
OPTIONS = {2: ["--hidden", "64"], 10: ["--updates-per-step", "2"]}
WHOLE = list(SECTIONS) if os.environ.get("CHANGES") == "all" else [1, 2]
SMALL = ["--max-episode-steps", "20", "--eval-episodes", "2", "--no-compile"]


def hunks(section):
    """Return the (old, new) texts of the diff in a section."""
    [diff] = re.findall(r"^```diff\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    found = []
    for hunk in re.split(r"^@@ .*\n", diff, flags=re.MULTILINE)[1:]:
        lines = [(line[:1] or " ", line[1:] + "\n") for line in hunk.splitlines()]
        old = "".join(code for mark, code in lines if mark != "+")
        new = "".join(code for mark, code in lines if mark != "-")
        found.append((old, new))
    return found


def changed(number):
    """Return the algorithm of a change's script, and the script's text after the change."""
    section = SECTIONS[number]
    algorithm = re.search(r"`([a-z0-9]+)_continuous_noisy.py`", section)[1]
    if number in BASED_ON:
        _, text = changed(BASED_ON[number])
    else:
        text = (ROOT / f"{algorithm}_continuous_noisy.py").read_text()
    for old, new in hunks(section):
        assert text.count(old) == 1, f"change {number}: not once in the script:\n{old}"
        text = text.replace(old, new)
    return algorithm, text


def write(number, folder):
    """Write a changed copy of a script, by a name that no script of the project has."""
    algorithm, text = changed(number)
    name = algorithm if number in BASED_ON else f"{algorithm}{number}"
    path = folder / f"{name}_continuous_noisy.py"
    path.write_text(text)
    return path


def imported(number, folder):
    path = write(number, folder)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    sys.modules[path.stem] = script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


EVERYDAY = (1, 9)  # two that are quick, of the network and of the loop; `make test` trains all
# the promises of the others are checked whole, below
OTHERS = [slow(number) for number in range(1, 11) if number not in (*EVERYDAY, *WHOLE)]


@pytest.mark.parametrize("number", [*EVERYDAY, *OTHERS])
def test_a_change_trains(number, tmp_path):
    path = write(number, tmp_path)
    run = watched_run.train(path, OPTIONS.get(number, []), tmp_path / "runs")
    assert run.finished and (run.folder / "result.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", WHOLE)
def test_a_changed_script_keeps_its_promises(number, tmp_path, capsys):
    status = check_script.main(write(number, tmp_path), *OPTIONS.get(number, []))
    assert status == 0, capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("number", WHOLE)
def test_a_changed_script_is_swept(number, tmp_path):
    path = write(number, tmp_path)
    algorithm = path.name.removesuffix("_continuous_noisy.py")
    if algorithm.startswith("ppo"):
        small = [*SMALL, "--num-steps", "50", "--num-minibatches", "2"]
    else:
        small = [*SMALL, "--learning-starts", "40", "--batch-size", "16"]
    sweep = ["custom", "--algos", algorithm, "--envs", "Pendulum-v1", "--seeds", "1-2"]
    sweep += ["--total-timesteps", "100", "--runs-dir", "runs", "--jobs", "2", "--"]
    trial = check_script.Trial(path, [], tmp_path)
    trial.command(ROOT / "benchmark.sh", *sweep, *small, *OPTIONS.get(number, []))
    analysed = commands.run(ROOT / "analyze.py", ["--runs-dir", "runs"], cwd=tmp_path)
    assert f"{algorithm.upper()}: 2 runs of 100 steps, seeds: 2" in analysed.out, analysed.err


def test_n_step_returns_are_those_of_the_episodes(tmp_path):
    script, n, gamma = imported(7, tmp_path), 3, 0.9
    space = script.gym.spaces.Box(-1, 1, (1,))
    env = SimpleNamespace(observation_space=space, action_space=space)
    buffer, rng, expected = script.ReplayBuffer(12, env), np.random.default_rng(0), {}
    lengths = [4, 1, 6, 2, 5]  # more than the buffer holds; the last episode has not ended
    for episode, length in enumerate(lengths):
        rewards, first = rng.normal(size=length), 10 * episode
        ends = "terminated" if episode % 2 else "truncated"
        for t, reward in enumerate(rewards):
            over = t == length - 1 and episode < len(lengths) - 1
            terminated, truncated = over and ends == "terminated", over and ends == "truncated"
            buffer.add(first + t, 0, reward, first + t + 1, terminated, truncated)
            k = min(n, length - t)
            value = sum(gamma**i * rewards[t + i] for i in range(k))
            is_last = t + k == length and episode < len(lengths) - 1 and ends == "terminated"
            expected[first + t] = value, first + t + k, float(is_last), gamma**k
    observations, _, *others = buffer.sample(500, rng, n, gamma)
    for observation, *drawn in zip(observations, *others, strict=True):
        wanted = torch.tensor(expected[int(observation)], dtype=torch.float32)
        torch.testing.assert_close(torch.stack([x.reshape(()) for x in drawn]), wanted)
    assert len(observations.unique()) > 5


@pytest.mark.slow
@torch.no_grad()
def test_observations_are_normalized_also_in_a_compiled_loss(tmp_path):
    script = imported(8, tmp_path)
    space = script.gym.spaces.Box(-1, 1, (2,))
    env = SimpleNamespace(observation_space=space, action_space=space)
    normalizer = script.Normalizer(env)
    observations = 3 + 2 * np.random.default_rng(0).normal(size=(5000, 2))
    for observation in observations:
        normalizer.update(observation)
    normalized = normalizer(torch.tensor(observations))
    torch.testing.assert_close(normalized.mean(0), torch.zeros(2).double(), atol=0.01, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(2).double(), atol=0.01, rtol=0)
    # a loss reads the statistics as they are at each update
    normalizer = script.Normalizer(env)
    actor = script.Actor(env, normalizer)
    args = SimpleNamespace(compile=True, matmul_precision="highest")

    def loss(actor, observations):
        actions, _, _ = actor(observations, 0.0)
        return actions.sum(), {"actions": actions}

    update = script.updater(loss, actor, torch.optim.SGD(actor.parameters(), lr=0.0), args)
    observations, before = torch.randn(4, 2), None
    for _ in range(3):
        compiled, (_, eager) = update(observations), loss(actor, observations)
        torch.testing.assert_close(compiled["actions"], eager["actions"])
        assert before is None or not torch.allclose(compiled["actions"], before)
        before = compiled["actions"].clone()
        normalizer.update(np.array([5.0, -3.0]))


def test_two_scripts_are_compared(tmp_path, capsys, monkeypatch):
    """The program at the end of the page, on runs whose difference is known."""
    [program] = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    for name, change in {"my": 10, "td3": 0}.items():
        for seed in range(1, 7):
            final = [100 + change + seed]
            write_run(tmp_path / "runs", final, name.upper(), "Hopper-v5", seed=seed)
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    out = capsys.readouterr().out
    assert re.fullmatch(r"Hopper-v5: \+10 % \[\d+, \d+\], p = 0\.00\d+, 6 \+ 6 seeds\n", out), out
