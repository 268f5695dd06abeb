"""The choice of a noise, with training replaced by returns that are known."""

import contextlib
import csv
import io
import math
import multiprocessing
import os
import re
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
import simulate_choose
import stub_run

from analysis.runs import CHOICE_COLUMNS
from analysis.statistics import Comparison, holm
from noisy_wrappers import BASELINE, Configuration, rounded
from sweep import choose
from sweep.environment import Environment, remember
from sweep.halving import (
    FIRST_CONFIRMATION_SEED,
    advance,
    compare,
    fewest_seeds,
    helps,
    records,
    schedule,
    score,
    sentence,
)
from sweep.options import parse_args

SEARCH_SEEDS, CONFIRM = 50, 10  # columns of a table of returns
A = "RandomNormalNoisyReward(1.0)"


def named(count):
    return [Configuration.parse("noise", i) for i in range(count)]


def play(noises, budget, table, confirm=CONFIRM):
    """Run a choice to its end; table (noises, and the baseline last; seeds) holds the returns."""
    place = {noise: i for i, noise in enumerate([*noises, BASELINE])}
    returns = {}
    state = advance(noises, budget, confirm, returns)
    while state.due:
        for noise, seed in state.due:
            column = seed - 1
            if seed >= FIRST_CONFIRMATION_SEED:
                column = SEARCH_SEEDS + seed - FIRST_CONFIRMATION_SEED
            returns[noise, seed] = table[place[noise], column]
        state = advance(noises, budget, confirm, returns)
    return state, returns


def draw(rng, effects):
    """Draw returns around the effects (noises), with seeds of sd 0.3 and a baseline at 0."""
    return np.append(effects, 0)[:, None] + rng.normal(
        0, 0.3, (len(effects) + 1, SEARCH_SEEDS + CONFIRM)
    )


# THE SEARCH


def test_schedule():
    assert schedule(1, 3) == []
    assert schedule(2, 6) == [(2, 3)]
    # The shares of two rounds are 12 * 2 / (2 + 1.41) = 7.03 runs and 4.97: 1.8 and 2.5 a noise.
    assert schedule(4, 12) == [(4, 2), (2, 2)]
    assert schedule(5, 15) == [(5, 1), (3, 2), (2, 2)]
    assert schedule(90, 270) == [(90, 1), (45, 1), (23, 2), (12, 3), (6, 4), (3, 5), (2, 6)]
    assert schedule(16, 16) == [(16, 1), (8, 1), (4, 1), (2, 1)]  # never less than one seed
    assert len(schedule(64, 640)) == 6 and len(schedule(65, 640)) == 7


def test_advance_by_hand():
    a, b, c = noises = [Configuration.parse(name, 1.0) for name in "abc"]
    returns = {}

    def due():
        return advance(noises, 7, 4, returns).due

    # Rounds: 3 noises, 1 seed; 2 noises, 2 more
    assert due() == [(noise, 1) for noise in noises]
    returns |= {(a, 1): 0.0, (b, 1): 5.0}
    assert due() == [(c, 1)]
    returns[c, 1] = 4.0
    assert due() == [(b, 2), (c, 2), (b, 3), (c, 3)]
    returns |= {(b, 2): 1.0, (b, 3): 3.0, (c, 2): 2.0, (c, 3): 2.0}
    # Of seeds 2 and 3 alone, both means are 2; of all seeds, b has 3 and c has 2.67.
    state = advance(noises, 7, 4, returns)
    assert state.noises == [b]
    assert [done.survivors for done in state.rounds] == [[b, c], [b]]
    assert state.rounds[1].scores == {b: 3.0, c: pytest.approx(8 / 3)}
    assert state.seeds == range(1001, 1005)
    assert state.due == [(noise, seed) for seed in range(1001, 1005) for noise in (b, BASELINE)]
    del returns[a, 1]  # a run folder is gone: its run comes first
    assert due() == [(a, 1)]


def test_equal_scores_are_decided_by_the_order_given():
    noises = named(5)
    state, _ = play(noises, 15, np.ones((6, SEARCH_SEEDS + CONFIRM)))
    assert [len(done.survivors) for done in state.rounds] == [3, 2, 1]
    assert [done.survivors for done in state.rounds] == [noises[:3], noises[:2], noises[:1]]
    # The third is best in round 1, all are equal over rounds 1 and 2.
    table = np.ones((6, SEARCH_SEEDS + CONFIRM))
    table[2, :2] = 2, 0
    assert play(noises, 15, table)[0].rounds[1].survivors == noises[:2]


@pytest.mark.parametrize("count", [1, 2, 3, 90])
def test_every_choice_takes_the_announced_number_of_runs(count):
    rng = np.random.default_rng(count)
    state, returns = play(named(count), 3 * count, draw(rng, rng.normal(0, 0.1, count)))
    search = sum(noises * seeds for noises, seeds in schedule(count, 3 * count))
    assert len(returns) == search + 2 * CONFIRM
    assert len(state.noises) == 1 and len(state.rounds) == math.ceil(math.log2(count))


def test_a_planted_noise_is_found_and_confirmed():
    rng = np.random.default_rng(0)
    for _ in range(10):
        effects = np.zeros(90)
        best = rng.integers(90)
        effects[best] = 1.5  # five standard deviations of a seed
        state, returns = play(named(90), 270, draw(rng, effects))
        assert state.noises == [named(90)[best]]
        comparison = compare(state.noises[0], state.seeds, returns)
        assert helps(comparison, comparison.p)


def test_the_choice_is_as_good_as_a_grid_of_ten_seeds():
    """By the simulation, which the next test compares with the search."""
    rng, choices = np.random.default_rng(0), 2000
    effects = rng.normal(0, 0.1, (choices, 90))
    returns = effects[..., None] + rng.normal(0, 0.3, (choices, 90, SEARCH_SEEDS))
    chosen = simulate_choose.search(returns, schedule(90, 270))
    grid = returns[..., :10].mean(axis=-1).argmax(axis=-1)
    numbers = np.arange(choices)
    assert effects[numbers, chosen].mean() >= effects[numbers, grid].mean()


@pytest.mark.parametrize("count", [1, 3, 90])
def test_the_simulation_searches_by_the_rule(count):
    rng = np.random.default_rng(count)
    tables = [draw(rng, rng.normal(0, 0.3, count)) for _ in range(40)]
    winners = [play(named(count), 3 * count, table)[0].noises for table in tables]
    searched = np.stack([table[:count, :SEARCH_SEEDS] for table in tables])
    found = simulate_choose.search(searched, schedule(count, 3 * count))
    assert [[named(count)[i]] for i in found] == winners


@pytest.mark.slow
def test_the_simulation_confirms_by_the_test():
    rng = np.random.default_rng(0)
    noisy, baseline = rng.normal(0.3, 0.3, (60, CONFIRM)), rng.normal(0, 0.3, (60, CONFIRM))
    verdicts = []
    for x, y in zip(noisy, baseline, strict=True):
        noise = Configuration.parse("A", 1)
        returns = {(noise, seed): value for seed, value in enumerate(x)}
        returns |= {(BASELINE, seed): value for seed, value in enumerate(y)}
        comparison = compare(noise, range(CONFIRM), returns)
        verdicts.append(helps(comparison, comparison.p))
    assert 0 < sum(verdicts) < 60
    found = simulate_choose.confirmed(noisy, baseline, rng)  # with fewer partitions
    assert np.mean(found != verdicts) <= 0.05


@pytest.mark.parametrize("noises", [20, 90])
def test_the_default_finds_and_confirms_what_docs_say(noises):
    sizes = schedule(noises, 3 * noises)
    found = [simulate_choose.simulate(noises, sizes, 25, gain, trials=4000) for gain in (1, 1.5)]
    assert [confirmed for _, confirmed, _ in found] == pytest.approx([0.63, 0.90], abs=0.025)


@pytest.mark.slow
@pytest.mark.parametrize(("draw", "spread"), [("normal", 1), ("high_peak", 0.5), ("failing", 2)])
def test_useless_noises_are_claimed_to_help_in_at_most_four_percent(draw, spread):
    """Also where they change the spread of the returns."""
    draw = getattr(simulate_choose, draw)
    _, _, claims = simulate_choose.simulate(1, [], 25, 0, draw, spread, trials=4000)
    assert 0.012 <= claims <= 0.042
    assert abs(draw(np.random.default_rng(0), 10**6).mean()) < 0.005


def test_few_noises_are_chosen_no_worse_than_with_equal_rounds_and_ten_fresh_seeds():
    now, before = schedule(4, 12), simulate_choose.equal_shares(4, 12)
    for gain in (1.0, 1.5, 2.0):
        _, old, _ = simulate_choose.simulate(4, before, 10, gain, trials=4000)
        assert simulate_choose.simulate(4, now, 25, gain, trials=4000)[1] > old


def test_a_run_scores_the_mean_of_its_tests_in_the_last_15_percent():
    steps = np.arange(50_000, 1_000_001, 50_000)  # PPO: the last three
    assert score(steps, np.arange(20)) == 18
    steps = np.arange(10_000, 1_000_001, 10_000)  # SAC and TD3: the last fifteen
    assert score(steps, np.arange(100)) == 92
    assert score([50_000, 100_000], [1.0, 5.0]) == 5  # the other one is half-trained


# THE VERDICT


def test_fewest_seeds():
    # 2 / C(2n, n): 0.029 for 4, 0.0079 for 5, 0.0022 for 6
    assert [fewest_seeds(verdicts) for verdicts in (1, 2, 6, 7)] == [4, 5, 5, 6]


GOOD = Comparison(
    environments=1,
    n=10,
    n_baseline=10,
    n_baseline_most=10,
    difference=11.8,
    difference_low=8.4,
    difference_high=15.3,
    difference_percent=21.0,
    effect_size=1.2,
    pooled_std=9.8,
    t=2.7,
    p=0.011,
    smallest_p=2e-5,
    detectable=12.9,
    seeds_needed=12,
)


def test_verdicts_in_words():
    noise = Configuration.parse("RandomEarlyTermination(50)", 1.0)
    name = "PPO on Pusher-v5"
    assert sentence(name, noise, 90, GOOD, 0.011, 1) == (
        "PPO on Pusher-v5: RandomEarlyTermination(50) at 1.0 beats no noise: 10 fresh seeds, "
        "+11.8 [8.4, 15.3] (+21 %), p = 0.011."
    )
    assert not helps(GOOD, 0.06)
    corrected = sentence(name, noise, 90, GOOD, 0.055, 5)
    assert "none of 90 noises could be shown to help; the best of them, Random" in corrected
    assert "p = 0.011, corrected for 5 verdicts 0.055; " in corrected
    seen = "; with 10 seeds a difference of 12.9 would have been seen (80 % power"
    assert corrected.endswith(f"{seen} before the correction).")
    unclear = GOOD._replace(p=0.07, difference_low=-1.0)
    assert sentence(name, noise, 90, unclear, 0.07, 1).endswith("(80 % power).")
    # An interval with zero in it beside a p below 0.05 would look like a mistake
    odd = " Borderline: the interval includes zero."
    assert sentence("", noise, 90, unclear._replace(p=0.03), 0.03, 1).endswith(f"p = 0.03.{odd}")
    odd = odd.replace("includes", "excludes")
    assert sentence("", noise, 90, GOOD._replace(p=0.07), 0.07, 1).endswith(f"power).{odd}")
    falling = Configuration.parse(A, "1.0:0.0")
    assert f"{A} at 1.0 to 0.0 beats" in sentence("", falling, 2, GOOD, 0.011, 1)
    assert sentence("PPO on X", noise, 1, unclear, 0.3, 1).startswith(
        "PPO on X: RandomEarlyTermination(50) at 1.0 could not be shown to help: 10 fresh seeds, "
    )
    bad = GOOD._replace(t=-2.7, difference=-11.8, difference_low=-15.3, difference_high=-8.4)
    assert not helps(bad, bad.p)
    assert "is worse than no noise: 10 fresh seeds, -11.8" in sentence("", noise, 9, bad, 0.01, 1)


@pytest.mark.parametrize(
    ("baseline", "expected"),
    [
        ([8.0, 9.0, 11.0, 12.0], "+3.5 (+35 %), p = 0.057 (smallest possible: 0.029); with 4"),
        ([-1e-6, 0.0, 1e-6, 0.0], "beats no noise: 4 fresh seeds, +13.50, p = 0.029 (smallest"),
        ([-12.0, -13.0, -14.0, -15.0], "+27.0 (+200 %), p = 0.029"),
    ],
)
def test_a_comparison_by_hand(baseline, expected):
    """The 12 is in both: with it exchanged, the difference is the same."""
    noise = Configuration.parse("A", 0.1)
    returns = {(noise, 1001 + i): value for i, value in enumerate([12.0, 13.0, 14.0, 15.0])}
    returns |= {(BASELINE, 1001 + i): value for i, value in enumerate(baseline)}
    found = compare(noise, range(1001, 1005), returns)
    assert found.difference == pytest.approx(13.5 - np.mean(baseline)) and found.n == 4
    assert expected in sentence("PPO on X", noise, 2, found, found.p, 1)


def test_a_single_noise_that_harms():
    noise = Configuration.parse("A", 0.1)
    returns = {(noise, 1001 + i): float(i) for i in range(4)}
    returns |= {(BASELINE, 1001 + i): 10.0 + i for i in range(4)}
    found = compare(noise, range(1001, 1005), returns)
    said = sentence("PPO on X", noise, 1, found, found.p, 1)
    assert said.startswith("PPO on X: A at 0.1 is worse than no noise: 4 fresh seeds, -10")


def test_records_of_choice_csv():
    table = np.arange(4.0)[:, None] + np.zeros(SEARCH_SEEDS + CONFIRM)
    state, returns = play(named(3), 3, table)
    lines = records("PPO", "X", state, returns, helped=False)
    search = "PPO X search"
    assert [" ".join(map(str, line)) for line in lines] == [
        f"{search} 1 noise 0.0 1 0.0 no",
        f"{search} 1 noise 1.0 1 1.0 yes",
        f"{search} 1 noise 2.0 1 2.0 yes",
        f"{search} 2 noise 1.0 2 1.0 no",
        f"{search} 2 noise 2.0 2 2.0 yes",
        "PPO X confirmation   0.0 10 3.0 ",
        "PPO X confirmation  noise 2.0 10 2.0 no",
    ]


# THE RUN FOLDERS


def arguments(text, tmp_path):
    words = ["--total-timesteps", "4000", *text.split(" | "), "--runs-dir", str(tmp_path)]
    args = parse_args("status", "/", ["choose", *words])
    return args


def conclude(args):
    """What `report` does with a choice: write choice.csv, and say the verdicts, line by line."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        choose.report(choose.choices(args), args)
    return out.getvalue().splitlines()


def batches(args):
    """Run a choice to its end in this process; returns the names of its folders, batch by batch."""
    found = []
    while True:
        choices = choose.choices(args)
        due = [choice.runs[run] for choice in choices for run in choice.state.due]
        if not due:
            return found
        found.append({run.folder.name for run in due})
        for run in due:
            stub_run.train(run.command)


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_two_algorithms_and_environments_at_once(tmp_path):
    spellings = "RandomNormalNoisyReward(.1) | RandomNormalNoisyReward(0.10)"
    both = "RandomEarlyTermination(9)@0.3+RandomNormalNoisyReward(1)@1:0"
    args = arguments(
        "--algos | ppo | sac | --envs | Pendulum | MountainCarContinuous-v0 | --noises | "
        f"{spellings} | RandomDropoutObservation(0.9) | {both} | --noise-rates | 0 | 1 | "
        "--confirm | 5 | --budget | 3",
        tmp_path,
    )
    # Three noises, one of them in two spellings: rounds of 3 and 2 runs, then 5 fresh seeds
    found = batches(args)
    assert [len(batch) for batch in found] == [4 * 3, 4 * 2, 4 * 10]
    assert set().union(*found) == {path.name for path in tmp_path.glob("*/*__*")}
    assert all("_s1_" in name for name in found[0])
    assert all("_s2_" in name for name in found[1])
    sentences = conclude(args)
    assert [sentence.partition(":")[0] for sentence in sentences] == [
        f"{algorithm} on {env}"
        for algorithm in ("PPO", "SAC")
        for env in ("Pendulum-v1", "MountainCarContinuous-v0")
    ]
    shown = [re.search(r"p = ([.\d]+), corrected for 4 verdicts ([.\d]+)", s) for s in sentences]
    p_values = [float(match[1]) for match in shown]
    assert [float(match[2].rstrip(".")) for match in shown] == pytest.approx(
        holm(p_values), rel=0.1
    )
    lines = read(tmp_path / "choice.csv")
    assert len(lines) == 4 * (3 + 2 + 2)
    assert {line["noise_rate"] for line in lines} == {"0.0", "1.0", "0.3 + 1.0:0.0"}
    for line in lines:  # a search counts a run's last two tests of ten, the confirmation the last
        noise = Configuration.parse(line["noise"], line["noise_rate"])
        run = line["algorithm"].lower(), line["environment"], *noise.texts
        if line["round"]:
            last = range(1, int(line["seeds"]) + 1)
            wanted = [fmean(stub_run.tests_of(*run, seed)[-2:]) for seed in last]
        else:
            wanted = [stub_run.tests_of(*run, seed)[-1] for seed in range(1001, 1006)]
        assert float(line["score"]) == pytest.approx(fmean(wanted))


THREE = "RandomMixupObservation(0.5) | RandomDropoutObservation(0.9)"
THREE = f"--noise-rates | 1 | --confirm | 5 | --noises | {A} | {THREE}"


@pytest.mark.parametrize("env_id", ["toy_envs:IsSuccess-v0", "toy_envs:Success-v0"])
def test_a_noise_is_chosen_by_the_rate_of_success(env_id, tmp_path):
    text = f"--algos | ppo | --envs | {env_id} | --metric | success_rate | {THREE}"
    args = arguments(text, tmp_path)
    batches(args)
    [verdict] = conclude(args)
    lines = read(tmp_path / "choice_by_success.csv")
    rates = {}
    for line in lines[-2:]:
        noise = Configuration.parse(line["noise"], line["noise_rate"])
        last = [
            stub_run.episodes_of("ppo", env_id, *noise.texts, seed)[-1]
            for seed in range(1001, 1006)
        ]
        rates[noise] = 100 * np.mean(np.array(last) > 100)
        assert float(line["score"]) == pytest.approx(rates[noise])
    gain = rates.pop(noise) - rates.pop(BASELINE)
    found = re.search(
        r"5 fresh seeds, ([-+][\d.]+) \[.*\] percentage points of success, p", verdict
    )
    assert float(found[1]) == pytest.approx(gain, abs=0.5) and abs(gain) > 5
    assert "(80 %" in verdict or " %" not in verdict  # never percent of a rate
    returns = arguments(f"--algos | ppo | --envs | {env_id} | {THREE}", tmp_path)
    assert "percentage points" not in conclude(returns)[0]


def test_choose_by_success_needs_an_environment_that_tells_it(tmp_path, capsys):
    text = f"--algos | ppo | --envs | Pendulum-v1 | --metric | success_rate | {THREE}"
    with pytest.raises(SystemExit) as exit_:
        batches(arguments(text, tmp_path))
    assert exit_.value.code == 2
    told = "PPO on Pendulum-v1: it tells no `is_success` or `success`, as --metric success_rate"
    assert capsys.readouterr().err == f"error: {told} needs\n"
    both = arguments(text.replace("Pendulum-v1", "Pendulum-v1 | toy_envs:Success-v0"), tmp_path)
    batches(both)  # the other goes on
    [choice] = choose.choices(both)
    assert choice.kind[1] == "toy_envs:Success-v0" and not choice.state.due
    assert f"warning: {told}" in capsys.readouterr().err


def test_a_run_that_tells_no_success_had_none(tmp_path):
    text = f"--algos | ppo | --envs | toy_envs:Success-v0 | --metric | success_rate | {THREE}"
    [choice] = choose.choices(arguments(text, tmp_path))
    silent, *others = choice.state.due
    stub_run.train(choice.runs[silent].command)
    path = choice.runs[silent].folder / "eval.csv"  # as where only a success is told
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line.rpartition(",")[0] for line in lines) + "\n")
    [choice] = choose.choices(arguments(text, tmp_path))  # interrupted: others may tell it
    for run in others:
        stub_run.train(choice.runs[run].command)
    [choice] = choose.choices(arguments(text, tmp_path))
    assert choice.returns[silent] == 0 < max(choice.returns.values())


def test_choose_stops_where_all_tests_are_equal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stub_run, "episodes_of", lambda *run: [[-50.0] * 10] * 10)
    args = arguments(f"--algos | ppo | --envs | Pendulum-v1 | {THREE}", tmp_path)
    with pytest.raises(SystemExit) as exit_:
        batches(args)
    assert exit_.value.code == 1
    assert len(list(tmp_path.glob("*/*__*"))) == 6  # after the first round: two seeds of three
    told = "PPO on Pendulum-v1: all tests of all runs return -50.00 in 4,000 steps (runs: 6), so"
    assert f"error: {told}" in capsys.readouterr().err


def test_an_environment_where_all_tests_are_equal_stops_no_other(tmp_path, monkeypatch, capsys):
    real = stub_run.episodes_of
    same = [[-50.0] * 10] * 10
    monkeypatch.setattr(
        stub_run, "episodes_of", lambda *run: same if "Car" in run[1] else real(*run)
    )
    envs = "Pendulum-v1 | MountainCarContinuous-v0"
    args = arguments(f"--algos | ppo | --envs | {envs} | {THREE}", tmp_path)
    batches(args)
    [verdict] = conclude(args)
    assert verdict.startswith("PPO on Pendulum-v1: ")
    told = "warning: PPO on MountainCarContinuous-v0: all tests of all runs return -50.00 in"
    assert told in capsys.readouterr().err
    assert len({line["environment"] for line in read(tmp_path / "choice.csv")}) == 1


def test_the_readme_says_what_it_takes_by_default(tmp_path):
    text = " ".join((Path(__file__).parents[2] / "README.md").read_text().split())
    pattern = r"takes (\d+) runs of a .*: about (\d+) core-hours with PPO and (\d+) with SAC in a"
    runs, *hours = map(int, re.search(pattern, text).groups())
    for algorithm, announced in zip(("ppo", "sac"), hours, strict=True):
        words = ["choose", "--algos", algorithm, "--envs", "Hopper", "--runs-dir", str(tmp_path)]
        args = parse_args("status", "/", words)
        known = Environment(0.05e-3, 200, 1000, 11, True, {})
        remember(args.runs_dir, "Hopper-v5", known)
        choices = choose.choices(args)
        assert choose.total(choices, args).startswith(f"{runs} runs in all")
        assert runs * choices[0].run_seconds / 3600 == pytest.approx(announced, rel=0.1)


def test_the_default_noises_and_those_of_the_paper(tmp_path):
    words = f"choose --algos ppo --envs Pendulum-v1 --runs-dir {tmp_path}"

    def tried(more=""):
        args = parse_args("status", "/", f"{words} {more}".split())
        [choice] = choose.choices(args)
        return choice.state.noises

    assert len(tried()) == 20 and {noise.noise_rate for noise in tried()} == {"0.05", "1.00"}
    assert len({noise.noise for noise in tried()}) == 10
    assert not any(noise.noise == "RandomNormalNoisyObservation(1.0)" for noise in tried())
    assert [str(noise) for noise in tried("--noise-rates 0.2")] == [
        f"{noise.noise} at 0.2" for noise in tried()[::2]
    ]
    paper = tried("--noises paper")
    assert len(paper) == 90 and len({noise.noise for noise in paper}) == 15
    assert len(tried("--noises paper --noise-rates 0.2")) == 15


def test_a_damaged_run_is_not_to_be_retried_or_excluded(tmp_path, capsys):
    args = arguments(f"--algos | ppo | --envs | Pendulum-v1 | {THREE}", tmp_path)
    [choice] = choose.choices(args)
    for run in choice.state.due:
        stub_run.train(choice.runs[run].command)
    path = choice.runs[choice.state.due[0]].folder / "eval.csv"
    path.write_text(path.read_text()[:-1])
    capsys.readouterr()
    choose.report(choose.choices(args), args)
    [line] = capsys.readouterr().out.splitlines()
    assert line.endswith("runs to do: 1.")


def test_where_nothing_finishes_no_noise_is_to_be_excluded(tmp_path, capsys):
    args = arguments(f"--algos | ppo | --envs | Pendulum-v1 | {THREE}", tmp_path)
    [choice] = choose.choices(args)
    capsys.readouterr()
    choose.report([choice], args)
    out = capsys.readouterr().out
    assert "leave PPO on Pendulum-v1 out: see --algos and --envs" in out and "--exclude" not in out
    stub_run.train(choice.runs[choice.state.due[0]].command)
    choose.report(choose.choices(args), args)
    assert capsys.readouterr().out.count("--exclude") == 3


def test_an_excluded_noise_is_no_other_choice(tmp_path):
    words = "--algos | ppo | --envs | Pendulum-v1"
    [choice] = choose.choices(arguments(words, tmp_path))
    for run in choice.state.due:
        stub_run.train(choice.runs[run].command)
    excluded = f"{words} | --exclude | RandomEarlyTermination(50)@1"
    [choice] = choose.choices(arguments(excluded, tmp_path))
    assert len(choice.returns) == 19
    # as `report` prints it, a line for each noise that fails
    excluded += f" | --exclude | {A}@1 | {A}@1.0"
    [choice] = choose.choices(arguments(excluded, tmp_path))
    assert len(choice.returns) == 18


def test_what_the_confirmation_can_show(tmp_path):
    words = f"--algos | ppo | --envs | Pendulum-v1 | --noises | {A}@1"

    def lines(words):
        args = arguments(words, tmp_path)
        plan = choose.plan(choose.choices(args), args)
        return [line for line in plan if "fresh seeds confirm" in line]

    unit = "standard deviations over seeds with 80 % power"
    assert lines(words) == [f"25 fresh seeds confirm a true gain of 0.8 {unit}"]
    [line] = lines(words.replace("ppo", "ppo | sac"))
    assert line.endswith(f" 0.9 {unit}, corrected for 2 verdicts")
    # Once there is a spread, in the return's own units
    two = f"{words} | RandomMixupObservation(0.5)@1 | --budget | 6 | --confirm | 5"
    [choice] = choose.choices(arguments(two, tmp_path))
    for run in map(choice.runs.get, choice.state.due):
        stub_run.train(run.command)
    tests = [
        [stub_run.tests_of("ppo", "Pendulum-v1", [noise], [1.0], seed)[-1] for seed in (1, 2, 3)]
        for noise in (A, "RandomMixupObservation(0.5)")
    ]
    spread = math.sqrt(fmean(np.var(tests, axis=1, ddof=1)))
    [line] = lines(two)
    gain, units = re.search(
        r"of about ([\d.]+) \(([\d.]+) standard deviations of the", line
    ).groups()
    assert line.startswith("PPO on Pendulum-v1: 5 fresh seeds confirm a true gain of about ")
    assert float(gain) == pytest.approx(spread * float(units), rel=0.06)
    [choice] = choose.choices(arguments(two, tmp_path))
    for run in map(choice.runs.get, choice.state.due[:4]):  # fresh seeds change nothing about it
        stub_run.train(run.command)
    assert lines(two) == [line]


def test_a_second_choice_takes_the_same_fresh_seeds(tmp_path, capsys):
    words = f"--algos | ppo | --envs | Pendulum-v1 | --noises | {A}@1 | --confirm | "
    assert [len(batch) for batch in batches(arguments(words + "4", tmp_path))] == [8]
    [more] = batches(arguments(words + "6", tmp_path))
    assert {re.search(r"_s(\d+)_", name)[1] for name in more} == {"1005", "1006"}
    other = words.replace(A, "RandomMixupObservation(0.5)") + "6"
    with pytest.raises(SystemExit):  # at once, not after its search
        choose.choices(arguments(f"{other} | --total-timesteps | 8000", tmp_path))
    assert "holds a finished run of 4000 steps" in capsys.readouterr().err


@pytest.mark.slow
def test_another_choice_keeps_the_lines_of_the_first(tmp_path):
    first = arguments(
        "--algos | ppo | --envs | Pendulum-v1 | --noise-rates | 1 | --noises | "
        f"{A} | RandomMixupObservation(0.5) | --confirm | 4",
        tmp_path,
    )
    batches(first)
    conclude(first)
    before = read(tmp_path / "choice.csv")
    second = arguments(
        f"--algos | sac | --envs | Pendulum-v1 | --noises | {A}@1 | --confirm | 4", tmp_path
    )
    assert [len(batch) for batch in batches(second)] == [8]  # one noise needs no search
    for _ in range(2):
        [sentence] = conclude(second)
        assert sentence.startswith(f"SAC on Pendulum-v1: {A} at 1.0 ")
        lines = read(tmp_path / "choice.csv")
        assert lines[:-2] == before
        assert [line["phase"] for line in lines[-2:]] == ["confirmation"] * 2


@pytest.mark.slow
def test_two_commands_that_end_side_by_side_keep_each_others_lines(tmp_path, monkeypatch):
    path = tmp_path / "choice.csv"
    line = ("x",) * len(CHOICE_COLUMNS)
    replace = os.replace
    fork = multiprocessing.get_context("fork")
    second = fork.Process(target=choose.write_choice, args=(path, [line]))

    def replace_late(temporary, path):
        monkeypatch.undo()
        second.start()
        second.join(timeout=1)  # the second has written by now, or waits for the first
        replace(temporary, path)

    monkeypatch.setattr(os, "replace", replace_late)
    choose.write_choice(path, [("first", *line[1:])])
    second.join()
    assert second.exitcode == 0
    assert [found["algorithm"] for found in read(path)] == ["first", "x"]


def test_status_says_who_survives(tmp_path, monkeypatch):
    monkeypatch.setenv("SWEEP_JOBS", "2")
    scores = {}
    for noise in (A, "RandomMixupObservation(0.5)", "RandomDropoutObservation(0.9)"):
        tests = stub_run.tests_of("ppo", "Pendulum-v1", [noise], [1.0], 1)
        scores[noise] = fmean(tests[-2:])
    noises = sorted(scores, key=scores.get)  # the best is given last, and named first
    _, second, best = noises
    args = arguments(
        "--algos | ppo | --envs | Pendulum-v1 | --noise-rates | 1 | --confirm | 4 | "
        f"--budget | 7 | --noises | {' | '.join(noises)}",
        tmp_path,
    )
    line, total = choose.standing(choose.choices(args), args)
    assert total == "15 runs in all, 7 to search and 8 to confirm; 0 are done"
    assert line == "PPO on Pendulum-v1, round 1 of 2: 3 of 3 noises, seed 1; runs to do: 3"
    for choice in choose.choices(args):
        for run in choice.state.due:
            stub_run.train(choice.runs[run].command)
    assert list(choose.standing(choose.choices(args), args)) == [
        "PPO on Pendulum-v1, round 2 of 2: 2 of 3 noises, seeds 1 to 3; runs to do: 4",
        "  mean return after round 1:",
        f"  {rounded(scores[best]):>10}  {best} at 1.0",
        f"  {rounded(scores[second]):>10}  {second} at 1.0",
        # Twelve runs are left; each of the three has taken 36 seconds
        "15 runs in all, 7 to search and 8 to confirm; 3 are done, about 0.1 core-hours are left, "
        "0.06 hours on the clock with 2 runs at a time",
    ]
    batches(args)
    finished = choose.choices(args)
    [verdict] = choose.standing(finished, args)
    assert verdict.startswith("PPO on Pendulum-v1: ") and "4 fresh seeds" in verdict
    assert not (tmp_path / "choice.csv").exists()  # the status only looks
    assert [verdict] == conclude(args)
