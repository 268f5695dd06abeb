"""The choice of a noise, with training replaced by returns that are known."""

import contextlib
import csv
import io
import math
import re
from statistics import fmean

import numpy as np
import pytest
import simulate_choose
import stub_run
from views import ROOT, batches, view

from analysis.choice import read_choice
from analysis.comparisons import as_chosen, compare_all
from analysis.formatting import rounded
from analysis.runs import read_runs
from analysis.statistics import compare, contrast
from analysis.studies import make_studies
from noisy_wrappers import BASELINE, Configuration
from sweep import choose, halving, telling
from sweep.environment import Environment, remember
from sweep.halving import FIRST_CONFIRMATION_SEED, State, Verdict, advance, judge
from sweep.looks import Plan, bounds, futility_limits, looks_after, nominal_levels
from sweep.options import parse_args

SEARCH_SEEDS, CONFIRM = 50, 10  # columns of a table of returns
A = "RandomNormalNoisyReward(1.0)"
ONE_LOOK = Plan((CONFIRM,), 0.05)
FIVE_LOOKS = Plan((5, 10, 15, 20, 25), 0.05)


def named(count):
    return [Configuration.parse("noise", i) for i in range(count)]


def play(noises, budget, table, plan=ONE_LOOK):
    """Run a choice to its end; table (noises, and the baseline last; seeds) holds the returns."""
    place = {noise: i for i, noise in enumerate([*noises, BASELINE])}
    returns = {}
    state = advance(noises, budget, plan, returns)
    while state.due:
        for noise, seed in state.due:
            column = seed - 1
            if seed >= FIRST_CONFIRMATION_SEED:
                column = SEARCH_SEEDS + seed - FIRST_CONFIRMATION_SEED
            returns[noise, seed] = table[place[noise], column]
        state = advance(noises, budget, plan, returns)
    return state, returns


# THE SEARCH


def test_schedule():
    rounds = halving.sizes_of_rounds
    assert rounds(1, 3) == [] and rounds(2, 6) == [(2, 3)]
    # The shares of two rounds are 12 * 2 / (2 + 1.41) = 7.03 runs and 4.97: 1.8 and 2.5 a noise.
    assert rounds(4, 12) == [(4, 2), (2, 2)]
    assert rounds(5, 15) == [(5, 1), (3, 2), (2, 2)]
    assert rounds(90, 270) == [(90, 1), (45, 1), (23, 2), (12, 3), (6, 4), (3, 5), (2, 6)]
    assert rounds(16, 16) == [(16, 1), (8, 1), (4, 1), (2, 1)]  # never less than one seed
    assert len(rounds(64, 640)) == 6 and len(rounds(65, 640)) == 7


def test_advance_by_hand():
    a, b, c = noises = [Configuration.parse(name, 1.0) for name in "abc"]
    returns = {}

    def due():
        return advance(noises, 7, Plan((4,), 0.05), returns).due

    # Rounds: 3 noises, 1 seed; 2 noises, 2 more
    assert due() == [(noise, 1) for noise in noises]
    returns |= {(a, 1): 0.0, (b, 1): 5.0}
    assert due() == [(c, 1)]
    returns[c, 1] = 4.0
    assert due() == [(b, 2), (c, 2), (b, 3), (c, 3)]
    returns |= {(b, 2): 1.0, (b, 3): 3.0, (c, 2): 2.0, (c, 3): 2.0}
    # Of seeds 2 and 3 alone, both means are 2; of all seeds, b has 3 and c has 2.67.
    state = advance(noises, 7, Plan((4,), 0.05), returns)
    assert state.candidates == [b]
    assert [done.survivors for done in state.rounds] == [[b, c], [b]]
    assert state.rounds[1].scores == {b: 3.0, c: pytest.approx(8 / 3)}
    assert state.seeds == range(1001, 1005)
    assert state.due == [(noise, seed) for seed in range(1001, 1005) for noise in (b, BASELINE)]
    del returns[a, 1]  # a run folder is gone: its run comes first
    assert due() == [(a, 1)]


def test_equal_scores_are_decided_by_the_order_given():
    noises = named(5)
    state, _ = play(noises, 15, np.ones((6, SEARCH_SEEDS + CONFIRM)))
    assert [done.survivors for done in state.rounds] == [noises[:3], noises[:2], noises[:1]]
    # The third is best in round 1, all are equal over rounds 1 and 2.
    table = np.ones((6, SEARCH_SEEDS + CONFIRM))
    table[2, :2] = 2, 0
    assert play(noises, 15, table)[0].rounds[1].survivors == noises[:2]


@pytest.mark.slow
def test_the_choice_is_as_good_as_a_grid_of_ten_seeds():
    """As docs/sweeps.md says: returns have a deviation of 0.3 over seeds, effects one of 0.1."""
    rng, chosen, grid = np.random.default_rng(0), [], []
    for _ in range(150):
        effects = rng.normal(0, 0.1, 90)
        means = np.append(effects, 0)[:, None]  # the baseline's is 0
        table = means + rng.normal(0, 0.3, (91, SEARCH_SEEDS + CONFIRM))
        [winner] = play(named(90), 270, table)[0].candidates
        chosen.append(effects[named(90).index(winner)])
        grid.append(effects[table[:90, :10].mean(axis=1).argmax()])
    assert np.mean(chosen) >= np.mean(grid) - 0.01


# THE CONFIRMATION


def test_bounds_of_obrien_and_fleming():
    """Five equal looks, two-sided 0.05, Lan and DeMets' error spending.

    The figures are those of ldbounds and of R's gsDesign (sfLDOF), as in Jennison and Turnbull
    (2000), "Group Sequential Methods", section 7.2; one look is the usual 1.96.
    """
    assert bounds(*FIVE_LOOKS) == pytest.approx([4.877, 3.357, 2.680, 2.290, 2.031], abs=5e-4)
    assert bounds((25,), 0.05) == pytest.approx([1.95996], abs=1e-5)
    assert bounds((25,), 0.0125) == pytest.approx([2.49771], abs=1e-5)
    assert nominal_levels(FIVE_LOOKS)[-1] == pytest.approx(0.0423, abs=1e-4)
    assert looks_after(25) == FIVE_LOOKS.looks and looks_after(50, 3) == (17, 34, 50)
    words = "--algos | ppo | --envs | Hopper-v5 | --looks | 5"
    args = arguments(words, "/nowhere")  # of four seeds, two looks would be one
    assert choose.plan_for(args, "ppo", "Hopper-v5", 1).looks == FIVE_LOOKS.looks
    assert bounds((20, 40), 0.05) == pytest.approx([2.963, 1.969], abs=1e-3)


def test_futility_by_hand():
    """Hoped for is a gain that all seeds show in 9 of 10 cases: at the end z has the mean 3.24.

    After 15 of 25 seeds the rest adds 0.4 * 3.24 on average, with deviation sqrt(0.4).
    """
    limit = futility_limits(*FIVE_LOOKS)[2]
    ahead = 2.031 - limit * math.sqrt(0.6) - 0.4 * (1.95996 + 1.28155)
    assert ahead / math.sqrt(0.4) == pytest.approx(0.5244, abs=2e-3)  # 30 % of a normal lie above


def confirmation(noisy, baseline, plan=FIVE_LOOKS):
    """Confirm one noise with these returns; return the state and the verdict at its end."""
    table = np.zeros((2, SEARCH_SEEDS + len(noisy)))
    table[:, SEARCH_SEEDS:] = noisy, baseline
    state, returns = play(named(1), 3, table, plan)
    assert set(returns) == {(n, s) for n in (*named(1), BASELINE) for s in state.seeds}
    return state, judge(state, plan, returns)


def test_a_confirmation_stops_at_a_look():
    rng = np.random.default_rng(1)
    base = rng.normal(0, 1, 25)
    for gain, seeds, helped in ((3.0, 10, True), (-3.0, 5, False), (0.0, 10, False)):
        state, verdict = confirmation(rng.normal(gain, 1, 25), base)
        assert (len(state.seeds), verdict.helps, state.due) == (seeds, helped, [])
        assert state.look == FIVE_LOOKS.looks.index(seeds) + 1
    # the first look, at five seeds, can show no gain: 2 of 252 ways are not few enough
    far = confirmation(100 + base, base)
    assert len(far[0].seeds) == 10 and far[1].helps
    assert len(confirmation(100 + base, base, Plan((25,), 0.05))[0].seeds) == 25


def test_the_interval_is_that_of_the_look():
    rng = np.random.default_rng(3)
    noisy, base = rng.normal(2.5, 1, 25), rng.normal(0, 1, 25)
    state, verdict = confirmation(noisy, base)
    n = len(state.seeds)
    needed = nominal_levels(FIVE_LOOKS)[state.look - 1]
    _, _, low, high = contrast([noisy[:n], base[:n]], [1, -1], needed)
    found = verdict.comparison
    assert (found.difference_low, found.difference_high) == pytest.approx((low, high))
    assert verdict.needed == needed < 0.05 and n < 25


def test_advance_gives_the_same_whenever_it_is_asked():
    """At any moment, whatever runs are there: it is a function of the returns."""
    rng = np.random.default_rng(5)
    table = rng.normal([[0.4], [0.0], [0.2], [0.0]], 1, (4, SEARCH_SEEDS + 25))
    state, returns = play(named(3), 9, table, FIVE_LOOKS)
    for _ in range(30):
        known = {run: value for run, value in returns.items() if rng.random() < rng.random()}
        while (now := advance(named(3), 9, FIVE_LOOKS, known)).due:
            known |= {run: returns[run] for run in now.due[: rng.integers(1, 4)]}
        assert now == state


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "share", "runs"), [(0, (0.005, 0.05), (27, 35)), (1, (0.88, 0.97), (31, 39))]
)
def test_the_simulation_of_a_confirmation(gain, share, runs):
    """A small one of tools/simulate_choose.py, whose tables are in docs/statistics.md."""
    _, _, claims, used = simulate_choose.simulate(1, simulate_choose.FIVE, gain, trials=300)
    assert share[0] <= claims <= share[1] and runs[0] <= used <= runs[1]


# THE VERDICT

GOOD = compare(np.arange(10.0) + 10, np.arange(10.0))._replace(p=0.011, t=2.7)
GOOD = GOOD._replace(difference=11.8, difference_low=8.4, difference_high=15.3)
GOOD = GOOD._replace(difference_percent=21.0, percent_low=15.0, percent_high=28.0)


def test_verdicts_in_words():
    noise = Configuration.parse("RandomEarlyTermination(50)", 1.0)
    state = State([], [noise], range(1001, 1011), [], 1)
    choice = choose.Choice(("PPO", "Pusher-v5"), 90, ONE_LOOK, [], state, {}, {}, None)

    def said(comparison, noises=90, level=0.05, planned=10, needed=0.05):
        verdict = Verdict(comparison, 10, planned, needed)
        of = choice._replace(number=noises, plan=Plan((planned,), level))
        return telling.sentence(of, verdict)

    good = "beats no noise: 10 fresh seeds, +11.8 [8.4, 15.3] (+21 % [15, 28]), p = 0.011."
    assert said(GOOD) == f"PPO on Pusher-v5: {noise} {good}"
    early = said(GOOD, planned=25, needed=0.0126, level=0.05 / 3)
    assert ": stopped after 10 of 25 planned" in early and "level shared by 3 verdicts" in early
    unclear = GOOD._replace(p=0.07, difference_low=-1.0, percent_low=-2.0)
    assert "none of 90 configurations could be shown to help; the best" in said(unclear)
    assert "excluded: a gain of more than 28 %, a loss of more than 2.0 %." in said(unclear)
    assert "Borderline: the interval includes zero" in said(unclear._replace(p=0.03))
    bad = GOOD._replace(t=-2.7, difference=-11.8, difference_low=-15.3, difference_high=-8.4)
    assert "is worse than no noise: 10 fresh seeds, -11.8" in said(bad, noises=1)
    assert "Borderline" not in said(unclear._replace(p=0.03), planned=25, needed=0.0126)
    returns = {(one, seed): 1.0 for one in (noise, BASELINE) for seed in state.seeds}
    kind = "PPO", "Pusher-v5", "ppo_continuous_noisy", ""
    cases = (GOOD, 0.05, "yes"), (bad, 0.05, "worse"), (GOOD, 0.01, "no")
    for comparison, needed, survives in cases:
        *_, last = halving.records(kind, state, returns, Verdict(comparison, 10, 10, needed))
        assert last == (*kind, "confirmation", "", *noise.columns, 10, 1.0, survives)


# THE RUN FOLDERS


def arguments(text, tmp_path):
    words = ["--total-timesteps", "4000", *text.split(" | "), "--runs-dir", str(tmp_path)]
    return parse_args("status", "/", ["choose", *words])


def conclude(args):
    """What `report` does with a choice: write choice.csv, and say the verdicts, line by line."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        telling.report(choose.choices(args), args)
    return out.getvalue().splitlines()


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
    sentences = conclude(args)
    assert len({sentence.partition(":")[0] for sentence in sentences}) == 4
    assert all("(level shared by 4 verdicts)" in sentence for sentence in sentences)
    lines = read(tmp_path / "choice.csv")
    assert len(lines) == 4 * (3 + 2 + 2)
    survivors = [line["survives"] for line in lines[:5]]  # of three noises two, of these one
    assert (survivors[:3].count("yes"), survivors[3:].count("yes")) == (2, 1)
    assert [line["seeds"] for line in lines[:7]] == ["1", "1", "1", "2", "2", "5", "5"]
    assert {line["noise_rate"] for line in lines} == {"0.0", "1.0", "0.3 + 1.0:0.0"}
    for line in lines:  # a run counts with its last two tests of ten
        noise = Configuration.parse(line["noise"], line["noise_rate"])
        run = line["algorithm"].lower(), line["environment"], *noise.texts
        seeds = range(1, int(line["seeds"]) + 1) if line["round"] else range(1001, 1006)
        wanted = [fmean(stub_run.tests_of(*run, seed)[-2:]) for seed in seeds]
        assert float(line["score"]) == pytest.approx(fmean(wanted))


THREE = "RandomMixupObservation(0.5) | RandomDropoutObservation(0.9)"
THREE = f"--noise-rates | 1 | --confirm | 5 | --noises | {A} | {THREE}"


def test_a_noise_is_chosen_by_the_rate_of_success(tmp_path):
    env_id = "toy_envs:Success-v0"
    text = f"--algos | ppo | --envs | {env_id} | --metric | success_rate | {THREE}"
    args = arguments(text, tmp_path)
    batches(args)
    [verdict] = conclude(args)
    rates = {}
    for line in read(tmp_path / "choice_by_success.csv")[-2:]:
        noise = Configuration.parse(line["noise"], line["noise_rate"])
        runs = [stub_run.episodes_of("ppo", env_id, *noise.texts, 1001 + i) for i in range(5)]
        rates[noise] = 100 * np.mean(np.array(runs)[:, -2:] > 100)
        assert float(line["score"]) == pytest.approx(rates[noise])
    gain = rates.pop(noise) - rates.pop(BASELINE)
    pattern = r"5 fresh seeds, ([-+][\d.]+) \[.*\] percentage points of success, p"
    assert float(re.search(pattern, verdict)[1]) == pytest.approx(gain, abs=0.5) and abs(gain) > 5
    assert "(80 %" in verdict or " %" not in verdict  # never percent of a rate
    returns = arguments(f"--algos | ppo | --envs | {env_id} | {THREE}", tmp_path)
    assert "percentage points" not in conclude(returns)[0]


def test_choose_by_success_needs_an_environment_that_tells_it(tmp_path, capsys):
    """Where another one does, that goes on, and a run that tells no success had none."""
    text = "--algos | ppo | --envs | Pendulum-v1 | toy_envs:Success-v0 | --metric | success_rate"
    args = arguments(f"{text} | {THREE}", tmp_path)
    batches(args)
    [choice] = choose.choices(args)
    assert choice.kind[1] == "toy_envs:Success-v0" and not choice.state.due
    told = "PPO on Pendulum-v1: it tells no `is_success` or `success`, as --metric success_rate"
    assert f"warning: {told}" in capsys.readouterr().err
    silent = max(choice.returns, key=choice.returns.get)
    path = choice.runs[silent].folder / "eval.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line.rpartition(",")[0] for line in lines) + "\n")
    [again] = choose.choices(args)
    assert again.returns[silent] == 0 < choice.returns[silent]
    alone = text.replace(" | toy_envs:Success-v0", "")
    with pytest.raises(SystemExit):
        choose.choices(arguments(f"{alone} | {THREE}", tmp_path))
    assert f"error: {told}" in capsys.readouterr().err


def test_choose_stops_where_all_tests_are_equal(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stub_run, "episodes_of", lambda *run: [[-50.0] * 10] * 10)
    with pytest.raises(SystemExit) as exit_:
        batches(arguments(f"--algos | ppo | --envs | Pendulum-v1 | {THREE}", tmp_path))
    told = "PPO on Pendulum-v1: all tests of all runs return -50.00 in 4,000 steps"
    assert exit_.value.code == 1 and f"error: {told} (runs: 6), so" in capsys.readouterr().err
    assert len(list(tmp_path.glob("*/*__*"))) == 6  # after the first round: two seeds of three


def test_the_readme_says_what_it_takes_by_default(tmp_path):
    text = " ".join((ROOT / "README.md").read_text().split())
    pattern = r"at most (\d+) runs of a .*\((\d+) core-hours with PPO in a .*, (\d+) with SAC\)"
    runs, *hours = map(int, re.search(pattern, text).groups())
    for algorithm, announced in zip(("ppo", "sac"), hours, strict=True):
        words = ["choose", "--algos", algorithm, "--envs", "Hopper", "--runs-dir", str(tmp_path)]
        args = parse_args("status", "/", words)
        known = Environment(0.05e-3, 1000, 11, True, {})
        remember(args, "Hopper-v5", known)
        choices = choose.choices(args)
        assert telling.total(choices).startswith(f"at most {runs} runs, ")
        assert runs * choices[0].run_seconds / 3600 == pytest.approx(announced, rel=0.1)


def test_the_default_noises_and_those_of_the_paper(tmp_path):
    def tried(*more):
        words = ["choose", "--algos", "ppo", "--envs", "Pendulum-v1", "--runs-dir", str(tmp_path)]
        return choose.choices(parse_args("status", "/", [*words, *more]))[0].state.candidates

    assert len(tried()) == 22 and {noise.noise_rate for noise in tried()} == {"0.05", "1.00"}
    additive = [n.noise for n in tried() if re.match("RandomNormal|RandomUniformNoisy", n.noise)]
    assert len(additive) == 10 and all("relative=True" in noise for noise in additive)
    assert len(tried("--noises", "paper")) == 90
    assert len(tried("--noises", "paper", "--noise-rates", "0.2")) == 15


def test_a_failing_run_stops_its_choice_and_no_other(tmp_path, monkeypatch):
    """The verdict comes once the noise that fails is excluded."""
    text = f"--algos | ppo | sac | --envs | Pendulum-v1 | {THREE}"
    args = arguments(text, tmp_path)
    out = "\n".join(conclude(args))  # where nothing finishes, it is not the noise
    assert "leave PPO on Pendulum-v1 out: see --algos and --envs" in out and "--exclude" not in out
    with monkeypatch.context() as patch:
        patch.setenv("STUB_FAILS", "*Dropout*ppo*")
        batches(args)
    ppo, advice, sac = conclude(args)
    assert "round 1 of 2: 3 of 3 configurations" in ppo and "runs to do: 2. These did not" in ppo
    assert advice.endswith('leave it out: --exclude "RandomDropoutObservation(0.9)@1.0"')
    assert sac == "SAC on Pendulum-v1: all runs are done; the verdict comes with the others"
    without = arguments(f"{text} | --exclude | RandomDropoutObservation(0.90)@1", tmp_path)
    batches(without)
    assert len(conclude(without)) == 2
    rows = [row for row in read(tmp_path / "choice.csv") if row["algorithm"] == "PPO"]
    assert rows and not [row for row in rows if "Dropout" in row["noise"]]


@pytest.mark.slow
def test_what_was_fixed_beforehand_is_kept(tmp_path, capsys):
    """The looks and the level, before the first run of the confirmation, whatever comes later."""
    one = f"--algos | ppo | --envs | Pendulum-v1 | --noises | {A}@1"

    def listed(text):
        args = arguments(text, tmp_path)
        args.view = "list"
        found = choose.choices(args)
        choose.begin(args, found)
        return found

    [choice] = listed(f"{one} | --confirm | 10")
    assert choice.plan == Plan((5, 10), 0.05)
    for other in ("--confirm | 20", "--looks | 1 | --confirm | 10"):
        with pytest.raises(SystemExit):
            listed(f"{one} | {other}")
        assert "its confirmation has begun, with 10 seeds and 2 looks" in capsys.readouterr().err
    two = one.replace("Pendulum-v1", "Pendulum-v1 | MountainCarContinuous-v0")
    first, second = listed(two)  # an environment is added
    assert first.plan == choice.plan and second.plan == Plan((5, 10, 15, 20, 25), 0.025)
    assert "of 0.9 standard deviations" in telling.detectable_gain(second.plan)
    assert listed(one)[0].plan == choice.plan
    for damage in ("{", '{"plans": {"a": {"looks": [5]}}}', '{"commands": 4}'):
        (tmp_path / "choice.json").write_text(damage)
        with pytest.raises(SystemExit):  # it must not be decided anew
            listed(one)
        assert "which keeps the plan of a choice" in capsys.readouterr().err


def test_fresh_seeds_that_ran_otherwise_are_refused_at_once(tmp_path, capsys):
    words = f"--algos | ppo | --envs | Pendulum-v1 | --noises | {A}@1 | --confirm | 4"
    batches(arguments(words, tmp_path))
    other = words.replace(A, "RandomMixupObservation(0.5)") + " | --total-timesteps | 8000"
    args = arguments(other, tmp_path)
    args.view = "list"
    with pytest.raises(SystemExit):  # not after its search
        choose.choices(args)
    assert "4 runs were made" in (said := capsys.readouterr().err)
    assert "--total-timesteps 4000, not 8000" in said


def test_a_status_finds_the_options_of_the_choice(tmp_path):
    words = ["--algos", "ppo", "sac", "--envs", "Pendulum", "--noises", f"{A}@1", "--confirm", "6"]
    words += ["--runs-dir", tmp_path]
    assert view("list", "choose", *words, "--", "--gamma", "0.9").code == 0
    assert not (tmp_path / "choice.json").exists()  # nothing has begun
    assert view("begin", "choose", *words, "--", "--gamma", "0.9").code == 0
    asked = ("--algos ppo --envs Pendulum-v1", "--algos sac --envs Pendulum", "--algos sac", "")
    shown = [view("status", "choose", *text.split(), "--runs-dir", tmp_path) for text in asked]
    assert all(one.code == 0 and "24 runs in all" in one.out for one in shown)
    assert len({one.out for one in shown}) == 1
    assert "--algos and --envs" in view("status", "choose", "--algos", "td3", *words[-2:]).err
    other = view("status", "choose", *words[:5], *words[-4:])  # whoever says more means it
    assert "24 runs in all" not in other.out


def test_another_choice_keeps_the_lines_of_the_first(tmp_path):
    path = tmp_path / "choice.csv"
    first, second = (("PPO", "Hopper-v5", name, *8 * "x") for name in ("one", "other"))
    telling.write_choice(path, [first, first])
    for _ in range(2):
        telling.write_choice(path, [second])
        assert [tuple(row.values()) for row in read(path)] == [first, first, second]


def test_status_says_who_survives(tmp_path):
    noises = [A, "RandomMixupObservation(0.5)", "RandomDropoutObservation(0.9)"]

    def score(noise):
        return fmean(stub_run.tests_of("ppo", "Pendulum-v1", [noise], [1.0], 1)[-2:])

    noises.sort(key=score)  # the best is given last, and named first
    text = "--algos | ppo | --envs | Pendulum-v1 | --noise-rates | 1 | --confirm | 4 | --budget | 7"
    args = arguments(f"{text} | --noises | {' | '.join(noises)}", tmp_path)
    [choice] = choose.choices(args)
    for run in choice.state.due:
        stub_run.train(choice.runs[run].command)
    where, _, *survivors, left = telling.standing(choose.choices(args), args)
    assert "round 2 of 2: 2 of 3 configurations, seeds 1 to 3; runs to do: 4" in where
    best = [f"{rounded(score(noise))}  {noise} at 1.0" for noise in reversed(noises[1:])]
    assert [line.strip() for line in survivors] == best
    # twelve runs are left; each of the three has taken 36 seconds
    assert re.fullmatch("15 runs .*; 3 done, about 7 min of processor time left", left)
    batches(args)
    [verdict] = telling.standing(choose.choices(args), args)
    assert verdict.startswith("PPO on Pendulum-v1: ") and "4 fresh seeds" in verdict
    assert not (tmp_path / "choice.csv").exists()  # the status only looks
    assert [verdict] == conclude(args)
    studies, _ = make_studies(read_runs(tmp_path))
    analysed = as_chosen(compare_all(studies), read_choice(tmp_path)).noises["verdict"].tolist()
    [word] = analysed
    assert (word == "better") == ("beats no noise" in verdict)
    assert (word == "worse") == ("is worse than" in verdict)
