"""Write results/future_work.md from the runs in data/: python results/pages/future_work.py.

The three wishes at the end of the paper, tried with PPO on Pusher-v5: a noise that is chosen
(choice/), a rate that changes during training and two noises at once (schedules/, beside the runs
without noise and with a constant rate in runs/). future_work.md.jinja has the text, this file every
number in it.
"""

import json

import pandas as pd
from common import DATA, RESULTS, compare_rows, markdown, read_returns, render, uncorrected
from helpful import ENDING

from analysis.runs import FIRST_CONFIRMATION_SEED
from analysis.statistics import DETECTABLE, contrast, detectable_percent, holm
from noisy_wrappers import BASELINE, Configuration
from sweep import halving

SMALL = "RandomNormalNoisyObservation(0.001)"
BOTH = f"{ENDING} + {SMALL}"
NOTHING = ("", "0.00")
ALWAYS = (ENDING, "1.00")
FALLING = (ENDING, "1.00 to 0.00")
FALLING_SEEDS, TOGETHER_SEEDS = range(1, 21), range(1, 11)


def core_hours(*patterns):
    """Return the time of the runs whose folders match the patterns: they took one core each."""
    results = [path / "result.json" for pattern in patterns for path in DATA.glob(pattern)]
    seconds = sum(json.loads(path.read_text())["wall_time_seconds"] for path in results)
    return {"runs": len(results), "hours": seconds / 3600}


def all_returns(runs, config):
    """Return the test returns of a (noise, noise_rate), indexed by seed."""
    noise, noise_rate = config
    found = runs[(runs["noise"] == noise) & (runs["noise_rate"] == noise_rate)]
    return found.set_index("seed")["test"]


def final_returns(runs, config, seeds):
    """Return the test returns (n,) of a (noise, noise_rate), each of whose seeds must be there."""
    return all_returns(runs, config).loc[list(seeds)].to_numpy()


def comparisons(cases):
    """Compare pairs of samples, {name: (x, y)}; p is corrected with Holm's method for all pairs."""
    rows, p = [], []
    for name, (x, y) in cases.items():
        row, numbers = compare_rows(name, x, y)
        p.append(numbers["p"])
        rows.append({**row, "80 % power at": f"{detectable_percent(x, y):.0f} %"})
    corrected = holm(p)
    table = pd.DataFrame(rows).rename(columns={"p": "p (exact)"})
    table["Holm"] = [f"{value:.2g}" for value in corrected]
    return {"table": markdown(table), "holm": list(corrected)}


def against_all(x, runs, config):
    """Compare x with the runs of a (noise, noise_rate) of all seeds, not of those of x alone."""
    y = all_returns(runs, config)
    return compare_rows("", x, y)[1] | {"n": len(y)}


# ------------------------------------------------------------------------------- a noise is chosen


def rounds(search):
    """Return a table of the search: each noise's score after every round that it was in."""
    search = search.astype({"round": int, "seeds": int, "score": float})
    scores = search.pivot(index=["noise", "noise_rate"], columns="round", values="score")
    seeds = search.groupby("round")["seeds"].first()
    scores = scores.sort_values(list(scores)[::-1], ascending=False)
    columns = {"": [f"`{noise}`" for noise, _ in scores.index]}
    for number in scores:
        texts = ["" if pd.isna(score) else f"{score:.1f}" for score in scores[number]]
        columns[f"round {number}: {seeds[number]} seed{'s' if seeds[number] > 1 else ''}"] = texts
    return markdown(columns)


def choice():
    """Return the search, and the winner against no noise on fresh seeds."""
    table = pd.read_csv(DATA / "choice/choice.csv", dtype=str, keep_default_na=False)
    search = table[table["phase"] == "search"]
    last = search.iloc[-1]["round"]
    [winner] = search[(search["round"] == last) & (search["survives"] == "yes")].itertuples()
    runs = read_returns(DATA / "choice")
    fresh = runs[runs["seed"] >= FIRST_CONFIRMATION_SEED]
    named = Configuration.parse(winner.noise, winner.noise_rate)
    returns = {(named if run.noise else BASELINE, run.seed): run.test for run in fresh.itertuples()}
    noises, seeds = search["noise"].nunique(), sorted(fresh["seed"].unique())
    comparison = halving.compare(named, seeds, returns)
    verdict = halving.verdict("PPO on Pusher-v5", noises, comparison, comparison.p, 1)
    x, y = ([returns[config, seed] for seed in seeds] for config in (named, BASELINE))
    row, _ = compare_rows("the winner, none", x, y)
    return {
        "rounds": rounds(search),
        "noises": noises,
        "grid": 10 * (noises + 1),
        "winner": winner.noise,
        "verdict": verdict,
        "table": uncorrected([row]),
        "p": comparison.p,
        "finds": comparison.detectable,
        "search": core_hours("choice/*__?", "choice/*__??"),
        "confirmation": core_hours("choice/*__1???"),
    }


# ------------------------------------------------------------ a rate that changes, two noises


def falling(runs):
    """Return early termination whose rate falls from 1 to 0 against the constant rate, and none."""
    falls, always, nothing = (
        final_returns(runs, config, FALLING_SEEDS) for config in (FALLING, ALWAYS, NOTHING)
    )
    pairs = {"falling, always 1": (falls, always), "falling, no noise": (falls, nothing)}
    return comparisons(pairs) | {
        "finds": detectable_percent(falls, always),
        "all": against_all(falls, runs, ALWAYS),
        "cost": core_hours("schedules/*1.0to0.0__*"),
    }


def together(runs):
    """Return what two noises do together, and apart."""
    both, ending, small, nothing = cells = [
        final_returns(runs, config, TOGETHER_SEEDS)
        for config in ((BOTH, "1.00 + 1.00"), ALWAYS, (SMALL, "1.00"), NOTHING)
    ]
    interaction, error, low, high = contrast(cells, [1, -1, -1, 1])
    pairs = {
        "small observation noise, none": (small, nothing),
        "both, none": (both, nothing),
        "both, early termination alone": (both, ending),
    }
    return comparisons(pairs) | {
        "interaction": interaction,
        "low": low,
        "high": high,
        "detectable": DETECTABLE * error,
        "gain": against_all(all_returns(runs, ALWAYS), runs, NOTHING)["difference"],
        "all": against_all(both, runs, NOTHING),
        "cost": core_hours("schedules/*NoisyObservation_0.001*"),
    }


def numbers():
    """Compute all that the page says."""
    runs = pd.concat([read_returns(DATA / "runs"), read_returns(DATA / "schedules")])
    runs = runs.query("environment == 'Pusher'")
    ppo = runs[runs["algorithm"] == "PPO"]
    return {
        "ending": ENDING,
        "small": SMALL,
        "choice": choice(),
        "falling": falling(ppo),
        "together": together(ppo),
    }


def page():
    """Return the text of future_work.md."""
    return render("future_work.md.jinja", numbers())


if __name__ == "__main__":
    (RESULTS / "future_work.md").write_text(page())
    print(f"Wrote {RESULTS / 'future_work.md'}")
