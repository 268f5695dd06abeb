"""The table of the paper's claims on the first page: what our runs say about each."""

import csv

import numpy as np
import pandas as pd

from results.study import pooled
from results.study.compare import (
    LEVEL,
    TOGETHER,
    average_change,
    by_the_tool,
    compare,
    comparisons,
    holm,
    in_looks,
    judge_claim,
    mann_whitney_p,
)
from results.study.returns import ENVIRONMENTS, RESULTS, read_returns, select

FIXED, FRESH, FEW = range(1, 11), range(11, 31), range(1, 6)  # seeds
ENDING, ENDING_ANYWHERE = "RandomEarlyTermination(50)", "RandomEarlyTermination(1, 100)"
NORMAL = "RandomNormalNoisyObservation(1.0)"
MIXUP = "RandomMixupObservation(0.0, recursive=True)"


def published(name, **where):
    """Return the row of a table in tables/ or paper/ whose cells these are."""
    with (RESULTS / name).open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        [row] = [r for r in rows if all(r[key] == value for key, value in where.items())]
    return row


def row(claim, page, paper, ours, tests, runs, claimed=1, of=all, after=False):
    """Return a row of the table; page is the name of a link in README.md.

    paper: percent, or a text; ours: (change, low, high) in percent, or a text; tests, claimed and
    of: see compare.judge_claim. after: whether it was asked after the runs; a star says so.
    """
    inside = "–"
    if not isinstance(ours, str):
        change, low, high = ours
        interval = "" if np.isnan(low) else f" [{low:z.0f}, {high:z.0f}]"
        ours = f"{change:+z.0f} %".replace("+0 %", "0 %") + interval
        if interval and not isinstance(paper, str):
            inside = "yes" if low <= paper <= high else "no"
    if not isinstance(paper, str):
        paper = f"{paper:+.0f} %"
    return {
        "claim": claim + "*" * after,
        "the paper": paper,
        "ours [95 %]": ours,
        "covered": inside,
        "verdict": judge_claim(tests, claimed, of),
        "runs": f"[{runs}][{page}]",
    }


def percents(found):
    """Return (change, low, high) of a result of compare."""
    return tuple(found[f"{name}_percent"] for name in ("difference", "low", "high"))


def sizes(found):
    """Return "10 + 10" for a result of compare: runs with noise and without."""
    return f"{found['n']} + {found['n_without']}"


def best_noises_of_ppo(runs):
    """Return the rows of PPO's best noise in each environment."""
    paper = pd.read_csv(RESULTS / "paper/best.csv").query("algorithm == 'PPO'")
    fixed = runs[runs["seed"].isin(FIXED)]
    found, rows = {}, []
    for best in paper.itertuples():
        name = best.environment.split("-")[0]
        noisy = select(fixed, "PPO", name, best.noise, f"{best.noise_rate}")
        found[name] = compare(noisy, select(fixed, "PPO", name), mann_whitney_p)
    corrected = dict(zip(found, holm([f["p"] for f in found.values()]), strict=True))
    everything = pooled.best_noises().set_index("environment")
    both = pooled.with_fresh().set_index("environment")
    for name, f in found.items():
        gain, claim = everything.loc[name, "paper_percent"], f"Best noise helps PPO on {name}"
        if name == "Pusher":  # which had the smallest p: so it was run again
            fresh = runs[runs["seed"].isin(FRESH)]
            samples = select(fresh, "PPO", name, ENDING, "1.0"), select(fresh, "PPO", name)
            f = compare(*samples, mann_whitney_p)
            effect, claim = (f["difference"], f["p"]), "Episodes of 50 steps help PPO on Pusher"
            rows.append(row(claim, "pusher", gain, percents(f), [effect], f"runs: {sizes(f)}"))
            continue
        effect = f["difference"], corrected[name]
        rows.append(row(claim, "best", gain, percents(f), [effect], f"runs: {sizes(f)}"))
        f = everything.loc[name]
        effect, n = (f["difference"], f["holm"]), f"all: {sizes(f)}"
        rows.append(
            row(f"{claim}, earlier runs", "all", gain, percents(f), [effect], n, after=True)
        )
        if name == "Hopper":  # where earlier runs together suggest a harm: plans.md, set A
            fresh = comparisons(read_returns("ppo_hopper"))
            rows += fresh_seeds(name, "A", "ppo_hopper", gain, fresh.iloc[0])
        if name == "Walker2d":  # the paper's largest number: plans.md, set E
            fresh = in_looks(read_returns("ppo_walker2d"))
            rows += fresh_seeds(name, "E", "ppo_walker2d", gain, fresh.iloc[-1])
        if name in both.index:
            f = both.loc[name]
            effect, n = (f["difference"], f["p"]), f"all: {sizes(f)}"
            claim = f"{claim}, earlier and fresh"
            rows.append(row(claim, "all", gain, percents(f), [effect], n, after=True))
    return rows


def fresh_seeds(name, page, folder, gain, found):
    """Return the row of PPO's best noise on a set's fresh seeds, once its rule has ended it."""
    if found["verdict"] == "under way":
        return []
    effect = found["difference"], 0 if found["verdict"] in ("helps", "harms") else 1
    claim, n = f"Best noise helps PPO on {name}, fresh", f"{folder}: {sizes(found)}"
    return [row(claim, page, gain, percents(found), [effect], n)]


def harmful_noises(runs):
    """Return the rows of the noises that the paper finds worse everywhere."""
    rows, alone, page = [], [], "harmful"
    for noise, name in ((NORMAL, "Large observation noise"), (MIXUP, "A frozen observation")):
        noisy, base = runs[runs["seed"].isin(FEW)], runs[runs["seed"].isin(FIXED)]
        pairs = [
            (select(noisy, "PPO", e, noise, "1.0"), select(base, "PPO", e)) for e in ENVIRONMENTS
        ]
        *change, _ = average_change(pairs)
        p = float(published("tables/ppo_harmful.csv", noise=f"`{noise}`")["p"])
        alone += [(x.mean() - y.mean(), mann_whitney_p(x, y)) for x, y in pairs]
        where = {"algorithm": "PPO", "noise_as_run": noise, "noise_rate": "1.00"}
        theirs = published("paper/consistently_worse.csv", **where)
        paper = float(theirs["average_improvement_percent"])
        claim = f"{name} harms PPO, average"
        rows.append(row(claim, page, paper, change, [(change[0], p)], "runs: 25 + 50", claimed=-1))
    halves = alone[:5], alone[5:]
    worse = min(sum(p <= LEVEL and effect < 0 for effect, p in half) for half in halves)
    claim, ours = "Both harm PPO in every environment", f"{worse} of 5"
    rows.append(row(claim, page, "5 of 5", ours, alone, "runs: 25 + 50", claimed=-1))
    base = select(runs, "TD3", "HalfCheetah")
    for rate in ("0.01", "1.0"):
        f = compare(select(runs, "TD3", "HalfCheetah", NORMAL, rate), base, mann_whitney_p)
        where = {"algorithm": "TD3", "noise": NORMAL, "noise_rate": f"{float(rate):.2f}"}
        paper = published("paper/consistently_worse.csv", **where)["average_improvement_percent"]
        # of five environments after 1,000,000 steps: another quantity, so it is not "covered"
        paper = f"{float(paper):+.0f} %"
        claim = f"Large observation noise harms TD3, rate {float(rate):g}"
        effect = f["difference"], 2 * f["p"]  # Bonferroni's correction for two rates
        page, n = "TD3", f"runs: {sizes(f)}"
        rows.append(row(claim, page, paper, percents(f), [effect], n, claimed=-1))
        if rate == "0.01":  # three other environments, tested together: plans.md, set C
            f = comparisons(read_returns("td3_200k")).set_index("environment").loc["together"]
            effect, claim = (f["difference_percent"], f["p"]), "The same, Hopper, Walker2d, Pusher"
            n = "td3_200k: 12 + 12"
            rows.append(row(claim, "C", paper, percents(f), [effect], n, claimed=-1))
            rows += fresh_seeds_of_td3(paper)
    return rows


def fresh_seeds_of_td3(paper):
    """Return the row of strong observation noise on set F's fresh seeds, once all are there."""
    folder = "td3_fresh"
    found = by_the_tool(folder, *TOGETHER[folder]).set_index("environment").loc["together"]
    if found["verdict"] == "under way":
        return []
    effect = found["difference_percent"], found["holm"]
    change = found["difference_percent"], np.nan, np.nan
    claim, n = "The same three, fresh seeds", f"{folder}: 24 + 24"
    return [row(claim, "F", paper, change, [effect], n, claimed=-1)]


def robustness():
    """Return the rows of training with noise and testing under other noise."""
    rows = []
    for noise, strength in (("observation noise", "0.1"), ("action noise", "0.3")):
        found = published("tables/unseen_noise.csv", **{"trained with": noise})
        text = found["difference [95 %]"].replace(" [", " points [")
        effect = float(text.split()[0]), float(found["Holm"])
        claim = f"PPO robust by {noise}, {strength}"
        rows.append(row(claim, "robust", "conjecture", text, [effect], "robustness: 30 + 30"))
    return rows


def consistent_noises():
    """Return the rows of the noises that the paper calls consistent."""
    names = {"Scale": "PPO, rewards scaled by 0.8 to 1.2", "Noisy": "PPO, small observation noise"}
    page, rows = "rows", []
    for found in pooled.consistent_rows().to_dict("records"):
        name = next(text for key, text in names.items() if key in found["noise"])
        change = [found[f"{key}_percent"] for key in ("average", "low", "high")]
        effect, paper = (change[0], found["p"]), found["paper_percent"]
        claim, n = f"{name}: consistent", "ablation: 15 + 15"
        rows.append(row(claim, page, paper, change, [effect], n, after=True))
    claim = "The other consistent noises"
    return [*rows, row(claim, page, "27 rows", "–", [], "none")]


def scaled_rewards(runs):
    """Return the rows of RandomUniformScaleReward(0.5, 1.5)."""
    rows, page = [], "SAC"
    paper = pd.read_csv(RESULTS / "paper/early_performance_sac.csv").query("steps_millions == 0.2")
    paper = paper.pivot(index="environment", columns="noise_rate", values="mean")
    gains = 100 * paper.sub(paper[0], axis=0).div(paper[0].abs(), axis=0)  # percent
    base = select(runs, "SAC", "HalfCheetah")
    cheetah = gains.loc["HalfCheetah-v2"]
    for rate in ("0.01", "0.05"):
        f = compare(select(runs, "SAC", "HalfCheetah", pooled.SCALE, rate), base, mann_whitney_p)
        effect = f["difference"], min(1, 2 * f["p"])  # Bonferroni's correction for two rates
        claim = f"SAC, rewards scaled, rate {rate}: helps early"
        gain = cheetah[float(rate)]
        rows.append(row(claim, page, gain, percents(f), [effect], f"runs: {sizes(f)}"))
    f = pooled.sac_early().iloc[0]
    claim, n = "The same, 0.01, with the long runs", f"long: {sizes(f)}"
    effect = f["difference"], f["p"]
    rows.append(row(claim, page, cheetah[0.01], percents(f), [effect], n, after=True))
    f = comparisons(read_returns("sac_200k")).set_index("environment")  # plans.md, set B
    effects = list(f[["difference", "holm"]].drop("together").itertuples(index=False, name=None))
    gain = gains.loc[["Hopper-v2", "Walker2d-v2", "Pusher-v2"], 0.01].mean()
    claim, n = "The same, 0.01, Hopper, Walker2d, Pusher", "sac_200k: 15 + 15"
    rows.append(row(claim, "B", gain, percents(f.loc["together"]), effects, n))
    found = read_returns("ablation")
    pairs = [
        [select(found, "PPO", e, *c) for c in ((pooled.SCALE, "0.05"), ())] for e in ENVIRONMENTS
    ]
    *change, p = average_change(pairs)
    claim, n = "The same noise helps PPO, rate 0.05", "ablation: 15 + 15"
    page = "rates"
    rows.append(row(claim, page, "–", change, [(change[0], p)], n, after=True))
    claim = "The same noise helps TD3"
    return [*rows, row(claim, page, "consistent", "–", [], "none")]


def others(runs):
    """Return the rows of the other claims."""
    rows = []
    spread = pd.read_csv(RESULTS / "tables/ppo_best_noises.csv")
    change = 100 * (spread["std_with"] / spread["std_without"] - 1)
    tests = list(zip(change, spread["brown_forsythe_p_holm"], strict=True))
    claim, page = "Noise lowers variance (ours: PPO)", "step"
    ours = f"{change.min():+.0f} to {change.max():+.0f} %"
    n = "runs: 50 + 50"
    paper = "10 of 15 best; PPO: 2 of 5"
    rows.append(row(claim, page, paper, ours, tests, n, claimed=-1, of=any))
    won = published("tables/numbers.csv", quantity="pairs won with reward noise, of 400")["value"]
    p = published("tables/numbers.csv", quantity="p of the pairs won with reward noise")["value"]
    claim, page = "PPO gains from reward noise", "best"
    effect = float(won) / 400 - 0.5, float(p)
    rows.append(
        row(claim, page, "4 of 5 best", f"{won} of 400 pairs won", [effect], "runs: 40 + 40")
    )
    claim = "TD3 gains from observation noise"
    rows.append(row(claim, "luck", "5 of 5 best", "–", [], "none"))
    claim = "The best noise of SAC and TD3 helps"
    rows.append(row(claim, "luck", "+1 to +34 %", "–", [], "none"))
    anywhere = select(read_returns("choice"), "PPO", "Pusher", ENDING_ANYWHERE, "1.0")
    same = runs[runs["seed"] <= len(anywhere)]
    f = compare(anywhere, select(same, "PPO", "Pusher", ENDING, "1.0"), mann_whitney_p)
    claim, page = "The step of early termination matters", "step"
    effect, n = (abs(f["difference"]), f["p"]), f"choice: {sizes(f)}"
    rows.append(row(claim, page, "7 and 8 of 18 worse", percents(f), [effect], n))
    steps = pooled.sac_headline()
    reached = f"steps to {pooled.PAPER_FINAL}"
    mean = steps[steps["seed"] == "mean"].set_index("noise")[reached]
    each = steps[steps["seed"] != "mean"].replace({reached: {"": np.inf}})
    late, early = (
        each.loc[(each["noise"] == "no noise") == without, reached].to_numpy(float)
        for without in (False, True)
    )
    saved, p = np.median(early) - np.median(late), mann_whitney_p(late, early)
    claim, ours = "Noise halves SAC's steps", f"{mean.iloc[0]:,}, not {mean.iloc[1]:,}"
    paper, n = "600,000, not 1,000,000", f"long: {len(late)} + {len(early)}"
    rows.append(row(claim, page, paper, ours, [(saved, p)], n))
    for noise, name in (
        ("NoisyObservation", "observation noise"),
        ("ScaleReward", "scaled rewards"),
    ):
        p = published("tables/numbers.csv", quantity=f"p of RandomUniform{noise}, Holm")["value"]
        claim = f"PPO is sensitive to beta of {name}"
        test = [(1, float(p))]
        rows.append(row(claim, "ablation", "a figure", f"p = {p}", test, "ablation: 75"))
    claim, page = "Rate 1 is seldom the best", "rates"
    return [*rows, row(claim, page, "6 of 15; chance 2.5", "–", [], "none")]


def table():
    """Return the table."""
    runs = read_returns("runs")
    rows = best_noises_of_ppo(runs) + harmful_noises(runs) + robustness()
    rows += consistent_noises() + scaled_rewards(runs) + others(runs)
    return pd.DataFrame(rows)
