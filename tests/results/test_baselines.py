"""The page of the baselines agrees with the committed runs."""

import json
import shutil

import baselines
import common
import headline
import numpy as np
import pandas as pd
import pytest
import side_by_side
import ways

from analysis.paper import read_paper
from analysis.runs import read_runs

pytestmark = pytest.mark.slow  # they read the committed runs again

RESULTS, DATA = common.RESULTS, common.DATA
PAPER = read_paper(RESULTS / "paper")


def cells(table):
    """Return {first cell of a row: its other cells} of a Markdown table."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    return {row[0]: row[1:] for row in rows}


def test_the_page_is_what_its_command_writes():
    assert (RESULTS / "baselines.md").read_text() == baselines.page()


@pytest.mark.parametrize(
    "name, pattern, seeds, length",
    [
        ("PPO on Hopper-v5", "runs/Hopper-v5__ppo_*__baseline__*", range(1, 11), "full"),
        ("PPO on Walker2d-v4", "v4/Walker2d-v4__ppo_*__baseline__*", range(1, 4), "full"),
        ("TD3 on Walker2d-v5", "long/Walker2d-v5__td3_*__baseline__*", range(1, 4), "full"),
        ("SAC on HalfCheetah-v5", "long/baseline_s*__HalfCheetah-v5__sac_*", range(1, 4), "full"),
        ("SAC on HalfCheetah-v5", "runs/HalfCheetah-v5__sac_*__baseline__*", range(1, 6), "short"),
    ],
)
def test_the_returns_are_those_of_the_runs(name, pattern, seeds, length):
    results = [
        json.loads((folder / "result.json").read_text())
        for folder in DATA.glob(pattern)
        if json.loads((folder / "config.json").read_text())["args"]["seed"] in seeds
    ]
    runs = baselines.read_baselines()
    total = {"full": 1_000_000, "short": 200_000}[length]
    row = cells(baselines.table(runs, PAPER, total)["table"])[name]
    assert row[0] == str(len(results)) == str(len(seeds))
    test = [result["final_return_mean"] for result in results]
    training = [result["train_return_mean_last_100"] for result in results]
    for returns, cell in ((test, row[1]), (training, row[4])):
        assert cell == f"{np.mean(returns):,.0f} ± {np.std(returns, ddof=1):,.0f}"
    assert {result["total_timesteps"] for result in results} == {total}


def test_what_is_published():
    paper, cleanrl, version = baselines.published(PAPER, "SAC", "Pusher", 1_000_000)
    assert paper.loc["Pusher"].tolist() == [-22.7, 1.8, 5] and version == "v4"
    assert cleanrl.loc["Pusher"].tolist() == pytest.approx([-22.45, 0.51 * 1.5**0.5, 3])
    assert baselines.published(PAPER, "SAC", "Hopper", 1_000_000)[2] == "v2"
    paper, cleanrl, _ = baselines.published(PAPER, "SAC", "HalfCheetah", 200_000)
    assert paper.loc["HalfCheetah"].tolist() == [7295, 899, 5] and cleanrl is None
    assert baselines.published(PAPER, "TD3", "HalfCheetah", 200_000) == (None, None, None)


def test_cleanrls_deviations_are_those_of_a_population(tmp_path):
    """Three seeds: their sample standard deviation is sqrt(3/2) times what CleanRL prints."""
    returns = np.array([1.0, 2, 6])
    path = tmp_path / "cleanrl.csv"
    path.write_text(f"mean,population_std\n{returns.mean()},{returns.std()}\n")
    [row] = baselines.read_cleanrl(path)[["mean", "std", "n"]].to_numpy()
    assert row == pytest.approx([3, returns.std(ddof=1), 3])


def test_the_newest_of_cleanrl():
    newest = baselines.newest_of_cleanrl()
    assert newest.loc[("PPO", "Hopper"), ["release", "mean"]].tolist() == ["v4, newer", 2382.86]
    assert newest.loc[("SAC", "Hopper"), ["version", "mean"]].tolist() == ["v2", 2310.46]


def test_the_committed_runs_of_sac_and_td3_are_the_planned_ones():
    """A run that is lost must not go unnoticed: three seeds of each at a million steps."""
    planned = [
        (algorithm, env_id, noise, seed, 1_000_000)
        for algorithm, env_id, noise in (
            ("SAC", "HalfCheetah-v5", ""),
            ("SAC", "HalfCheetah-v5", headline.NOISE),
            ("TD3", "HalfCheetah-v5", ""),
            ("TD3", "Walker2d-v5", ""),
        )
        for seed in (1, 2, 3)
    ]
    runs = read_runs(DATA / "long").query("status == 'finished'")
    names = ["algorithm", "environment", "noise", "seed", "total"]
    assert sorted(runs[names].itertuples(index=False, name=None)) == planned
    assert set(runs.loc[runs["noise"] != "", "noise_rate"]) == {"0.01"}


def test_far_from_both():
    far, near, one = {"se": -2.1}, {"se": 1.9}, {"a": {"paper": {"se": 9.0}}}
    numbers = {"b": {"paper": far, "cleanrl": {"se": 3.0}}, "c": {"paper": far, "cleanrl": near}}
    assert baselines.far_from_both(numbers | one) == ["b"]


def test_the_share_of_the_test_in_the_variance(tmp_path):
    """Episodes of 1, 2, 3: variance 1, of their mean 1/3; between seeds 2 and 4: variance 2."""
    lines = ["step,episode,episodic_return,episodic_length", "10,0,9,1", "10,1,0,1", "10,2,5,1"]
    lines += ["20,0,1,1", "20,1,2,1", "20,2,3,1"]
    (tmp_path / "eval.csv").write_text("\n".join(lines) + "\n")
    assert common.test_error(tmp_path) == pytest.approx(1 / 3)
    runs = pd.DataFrame({"environment": ["a", "a"], "test": [2.0, 4.0], "error": [1 / 3, 1 / 3]})
    assert common.variance_share(runs)["a"] == pytest.approx(100 / 3 / 2)


# ------------------------------------------------------------------------- how the paper tested PPO


def test_the_committed_runs_are_the_planned_ones():
    """tests.csv has every way, and the script's own way is that of eval.csv."""
    planned = [(env_id, *noise, *rate, seed) for env_id, noise, rate, seed in ways.planned_runs()]
    found = []
    for folder in (DATA / "paper_tests").iterdir():
        args = json.loads((folder / "config.json").read_text())["args"]
        found.append((args["env_id"], *args["noise"], *args["noise_rate"], args["seed"]))
        tests, own = (pd.read_csv(folder / name) for name in ("tests.csv", "eval.csv"))
        assert tests.groupby("way").size().to_dict() == dict.fromkeys(ways.WAYS, len(own))
        columns = ["step", "episode", "episodic_return"]
        scripts = tests.loc[tests["way"] == "training-mean", columns].reset_index(drop=True)
        pd.testing.assert_frame_equal(scripts, own[columns])
    assert len(found) == len(planned) and set(found) == set(planned)


def test_the_last_test_is_read(tmp_path):
    """Two tests of two episodes each: the mean of the last one counts."""
    folder = "Hopper-v5__ppo_continuous_noisy__baseline__3"
    shutil.copytree(DATA / "runs" / folder, tmp_path / folder)
    lines = ["way,step,episode,episodic_return"]
    for way in ways.WAYS:
        lines += [f"{way},9,0,9", f"{way},9,1,10", f"{way},99,0,99", f"{way},99,1,100"]
    (tmp_path / folder / "tests.csv").write_text("\n".join(lines))
    [row] = baselines.read_tests(tmp_path).to_dict("records")
    returns = dict.fromkeys(ways.WAYS, 99.5)
    assert row == {"environment": "Hopper", "noise": False, "seed": 3} | returns


def made_up(means, gain):
    """Ten seeds of every planned run, the same in all ways; `gain` in percent."""
    rows = []
    for env_id, noise, _, seed in ways.planned_runs():
        name = env_id.split("-")[0]
        spread = abs(means[name]) * 0.02 * (seed - 5.5)
        value = means[name] * (1 + gain / 100 * bool(noise)) + spread
        rows.append([name, bool(noise), seed] + [value] * 6)
    return pd.DataFrame(rows, columns=["environment", "noise", "seed", *ways.WAYS])


def test_ways_by_hand():
    """The paper's own means reproduce it; a way with another return or gain does not."""
    means = {"HalfCheetah": 1686, "Hopper": 1470, "Pusher": -57.6, "Walker2d": 1806}
    tests = made_up(means, 89.6)
    hopper = tests["environment"] == "Hopper"
    tests.loc[hopper, "own-mean"] *= 3
    walker = (tests["environment"] == "Walker2d") & tests["noise"]
    tests.loc[walker, "own-sampled"] /= 1.896
    found = baselines.judge_ways(tests, PAPER)
    wanted = dict.fromkeys(ways.WAYS, "reproduces")
    wanted |= {"own-mean": "excluded", "own-sampled": "excluded"}
    assert found["verdicts"] == wanted and found["gain"] == 89.6
    row = cells(found["table"])["training, mean"]
    assert row[:2] == ["1,470 (+0.0)", "1,806 (+0.0)"] and row[4] == "+90 %"


def test_side_by_side_sees_a_difference_where_there_is_one(tmp_path):
    folder = shutil.copytree(DATA / "side_by_side", tmp_path / "runs")
    found = side_by_side.side_by_side(folder)
    cleanrl = pd.read_csv(folder / "cleanrl.csv")
    assert set(cleanrl.groupby("seed").size()) == {100}
    assert found["n"] == cleanrl["seed"].nunique() == len(list(folder.glob("*/result.json")))
    spread = cleanrl.groupby("seed")["episodic_return"].mean().std()
    cleanrl["episodic_return"] -= 10 * max(spread, 100)
    cleanrl.to_csv(folder / "cleanrl.csv", index=False)
    shifted = side_by_side.side_by_side(folder)
    assert shifted["differs"] and shifted["difference"] > found["difference"]
