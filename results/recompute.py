"""Compute the numbers of results/ a second time, from the test episodes in data/.

    python results/recompute.py

Imports nothing of the project and no package but NumPy: readers, tests and intervals are its own.
Prints each number of tables/ that is not right to its last digit (a p that is drawn at random: to 5
standard errors), how many numbers there are, and which tables are not computed here. Exit status 1:
a number differs.
"""

import csv
import json
import re
import sys
from collections import Counter, defaultdict
from itertools import combinations
from math import comb
from pathlib import Path
from statistics import NormalDist

import numpy as np

HERE, DRAWS = Path(__file__).resolve().parent, 100_000
ENVS = ["HalfCheetah", "Hopper", "Humanoid", "Pusher", "Walker2d"]
ALL = "runs paper_tests robustness ablation choice schedules"
END, CUT = "RandomEarlyTermination(50)", "RandomEarlyTermination(50, truncate=True)"
DYNAMICS, WEAK = "RandomDynamics(0.8, 1.2)", "RandomNormalNoisyObservation(0.001)"
SCALED, NORMAL = "RandomUniformScaleObservation(0.8, 1.2)", "RandomNormalNoisyObservation(1.0)"
MIXUP = "RandomMixupObservation(0.0, recursive=True)"
RUNS, checked, wrong = defaultdict(dict), Counter(), []


def rows_of(path):
    """Return the rows of a csv."""
    with (HERE / path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def means(rows, key, kind=str):
    """Return {value of a column: mean return of its episodes}."""
    groups = defaultdict(list)
    for row in rows:
        groups[kind(row[key])].append(float(row["episodic_return"]))
    return {name: np.mean(values) for name, values in groups.items()}


def read_runs():
    """Fill RUNS: {algorithm, folder, environment, noise, rate: {seed: (curve, path)}}."""
    for path in sorted(HERE.glob("data/**/result.json")):
        config = json.loads((path.parent / "config.json").read_text())
        args, curve = config["args"], means(rows_of(path.parent / "eval.csv"), "step", int)
        noise = " + ".join(args["noise"]), " + ".join(map(str, args["noise_rate"]))
        key = path.relative_to(HERE / "data").parts[0], args["env_id"], *noise
        RUNS[config["algorithm"], *key][args["seed"]] = curve, path.parent


def ends(
    folders, env, noise="", rate="1.0", first=1, last=9999, algorithm="PPO", step=None, late=False
):
    """Return the last tests of a configuration, seeds first to last; equal runs count once.

    late: the means of the tests in the last 15 % of the steps instead.
    """
    found = {}
    for folder in folders.split():
        runs = RUNS[algorithm, folder, env + "-v5", noise, rate if noise else ""]
        for seed, (curve, _) in sorted(runs.items()):
            if first <= seed <= last:
                end = max(curve)
                tests = [value for at, value in curve.items() if at > 0.85 * end]
                found[seed, curve[end]] = np.mean(tests) if late else curve[step or end]
    return np.array(list(found.values()))


def tail(t, df):
    """Return P(Student's t > t); t = sqrt(df) tan(angle) has the density cos(angle)^(df - 1)."""
    spans = [np.linspace(a, np.pi / 2, 20_001) for a in (np.arctan(t / df**0.5), -np.pi / 2)]
    part, whole = (np.trapezoid(np.maximum(np.cos(a), 0) ** (df - 1), a) for a in spans)
    return part / whole


def quantile(df):
    """Return the t with 2.5 % above it."""
    low, high = 0.0, 100.0
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if tail(middle, df) > 0.025 else (low, middle)
    return low


def freedom(variances, sizes):
    """Return Satterthwaite's degrees of freedom."""
    return sum(variances) ** 2 / sum(v**2 / (n - 1) for v, n in zip(variances, sizes, strict=True))


def welch(mean, sd, n, mean2, sd2, n2):
    """Return the difference, its interval and p."""
    parts, difference = (sd**2 / n, sd2**2 / n2), mean - mean2
    error, df = sum(parts) ** 0.5, freedom(parts, (n, n2))
    half = error * quantile(df)
    return difference, difference - half, difference + half, 2 * tail(abs(difference) / error, df)


def fieller(x, y):
    """Return the change in percent, and the interval: the ratios that t does not reject."""
    a, b, va, vb = x.mean(), y.mean(), x.var(ddof=1) / len(x), y.var(ddof=1) / len(y)
    q = quantile(freedom((va, (a / b) ** 2 * vb), (len(x), len(y)))) ** 2
    ratios = np.roots([b * b - q * vb, -2 * a * b, a * a - q * va]).real
    found = sorted(100 * (ratio - 1) * np.sign(b) for ratio in ratios)
    if b * b <= q * vb or max(map(abs, found)) > 1000:
        found = [np.nan, np.nan]
    return 100 * (a / b - 1) * np.sign(b), *(max(end, least(x, y)) for end in found)


def least(*samples):
    """Return the least change in percent: -100 where all returns are positive."""
    return -100 if min(map(min, samples)) > 0 else -np.inf


def average(pairs):
    """Return the average change, with the limits' distances added at right angles."""
    found = np.array([fieller(x, y) for x, y in pairs])
    change, k = found[:, 0].mean(), len(pairs)
    low, high = np.hypot.reduce(found[:, 1:] - found[:, :1]) / k
    return change, max(change - low, least(*sum(pairs, ()))), change + high


def mann_whitney(x, y):
    """Return the exact p: the ways to choose ranks, counted by their sum."""
    n, total = len(x), len(x) + len(y)
    ways = np.zeros((n + 1, total * n + 1))
    ways[0, 0] = 1
    for rank in range(1, total + 1):
        ways[1:, rank:] += ways[:-1, :-rank].copy()
    actual = (x[:, None] > y).sum() + n * (n + 1) // 2
    below, above = ways[n, : actual + 1].sum(), ways[n, actual:].sum()
    return min(1, 2 * min(below, above) / ways[n].sum())


def divided(x, y, rng, every=False):
    """Return Welch's t as the runs are, and as they are divided at random, or in every way."""
    values, n, m = np.concatenate([x, y]), len(x), len(y)
    chosen = rng.permuted(np.tile(np.arange(n + m), (DRAWS, 1)), axis=1)[:, :n]
    if every and comb(n + m, n) <= DRAWS:
        chosen = np.array(list(combinations(range(n + m), n)))
    part = values[np.vstack([np.arange(n), chosen])]
    other = (values.sum() - part.sum(1)) / m
    spread = ((values**2).sum() - (part**2).sum(1) - m * other**2) / (m - 1) / m
    return (part.mean(1) - other) / np.sqrt(part.var(1, ddof=1) / n + spread)


def permutation(pairs):
    """Return p of the sum of Welch's t over environments."""
    rng = np.random.default_rng(1)
    sums = sum(divided(x, y, rng, every=len(pairs) == 1) for x, y in pairs)
    far = [sums[1:] >= sums[0] - 1e-9, sums[1:] <= sums[0] + 1e-9]
    if len(pairs) > 1:
        return np.mean(abs(sums[1:]) >= abs(sums[0]) - 1e-9)
    return min(1, 2 * min(f.mean() for f in far))


def in_scores(pairs):
    """Return p of the sum over environments of the normal quantiles of the ranks of t."""
    rng, sums, quantile_at = np.random.default_rng(1), 0, NormalDist().inv_cdf
    for x, y in pairs:
        actual, *ways = divided(x, y, rng, every=True).round(9)
        t, counts = np.unique(ways, return_counts=True)
        ranks = counts.cumsum() - counts / 2  # equal ones share theirs; each less a half
        scores = np.array([quantile_at(rank / len(ways)) for rank in ranks])
        drawn = rng.choice(scores, DRAWS, p=counts / len(ways))
        sums = sums + np.append(scores[t.searchsorted(actual)], drawn)
    far = (sums >= sums[0] - 1e-9).mean(), (sums <= sums[0] + 1e-9).mean()
    return min(1, 2 * min(far))


def holm(ps):
    """Return p-values corrected by Holm's method."""
    corrected, most = {}, 0
    for i, p in enumerate(sorted(ps)):
        most = corrected[p] = min(1, max(most, p * (len(ps) - i)))
    return [corrected[p] for p in ps]


def check(table, row, column, *values, drawn=False):
    """Compare the numbers in a cell with values, of which NaN stand for none."""
    texts = re.findall(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]\d+)?", row[column])
    values = [value for value in values if not np.isnan(value)]
    if texts and not values:
        wrong.append(f"{table}.csv, {column}: nothing to compute in {list(row.values())}")
    if len(texts) < len(values):
        wrong.append(f"{table}.csv, {column}: {values} are missing in {list(row.values())}")
    for text, value in zip(texts, values, strict=False):
        digits, _, exponent = text.replace(",", "").partition("e")
        last = 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
        error = 5 * (4 * value / DRAWS) ** 0.5 if drawn else 0
        if abs(float(text.replace(",", "")) - value) > 0.51 * last + error:
            wrong.append(f"{table}.csv, {column}: {text} is {value:.7g} in {list(row.values())}")
        checked[table] += 1


def compare(table, pairs, test=mann_whitney):
    """Check a table whose rows have two sides, their difference and p."""
    rows, ps = rows_of(f"tables/{table}.csv"), [test(x, y) for x, y in pairs]
    alone = [row for row in rows if row.get("environment") != "together"]
    for row, (x, y), p, corrected in zip(alone, pairs, ps, holm(ps), strict=True):
        first, second = ((z.mean(), z.std(ddof=1), len(z)) for z in (x, y))
        difference, *limits, _ = welch(*first, *second)
        change, *ends = fieller(x, y)
        names = ["mean", "sd", "n", "mean_without", "sd_without", "n_without", "difference"]
        names += ["low", "high", "difference_percent", "low_percent", "high_percent"]
        values = [*first, *second, difference, *limits, change, *ends]
        cells = {name: (value,) for name, value in zip(names, values, strict=True)}
        cells |= dict.fromkeys(["first", "with noise", "trained with it"], first[:2])
        cells |= dict.fromkeys(["second", "without", "without noise"], second[:2])
        cells |= {"difference [95 %]": (difference, *limits), "change": (change,)}
        cells |= {"ours": (*first[:2], change), "p": (p,), "holm": (corrected,)}
        cells["Holm"] = cells["holm"]
        cells["t"] = (difference / (first[1] ** 2 / first[2] + second[1] ** 2 / second[2]) ** 0.5,)
        for column in cells.keys() & row.keys():
            check(table, row, column, *cells[column], drawn=test is one and column in ("p", "holm"))
    if rows[-1].get("environment") == "together":
        together(table, rows[-1], "difference", pairs)


def together(table, row, name, pairs):
    """Check the average change over environments, and p of all of them at once."""
    for column, value in zip((name, "low", "high"), average(pairs), strict=True):
        check(table, row, f"{column}_percent", value)
    check(table, row, "p", permutation(pairs), drawn=True)


def one(x, y):
    """Return the permutation test's p for one environment."""
    return permutation([(x, y)])


def sides(table, folders, **more):
    """Return the two sides of each row of a table that names a noise and its rate."""
    pairs = []
    for row in rows_of(f"tables/{table}.csv"):
        env, rate = row.get("environment", "HalfCheetah"), row.get("rate") or row["noise_rate"]
        if env != "together":
            noisy = ends(folders, env, row["noise"], str(float(rate)), **more)
            pairs.append((noisy, ends(folders, env, **more)))
    return pairs


def averages(table, folder, rate, few, many):
    """Check changes in percent: a column for each environment, and their average."""
    for row in rows_of(f"tables/{table}.csv"):
        percents = []
        for env in [env for env in ENVS if row[env]]:
            noise = row["noise"].strip("`")
            x = ends(folder, env, noise, rate if "Scale" in noise else "1.0", last=few)
            percents.append(fieller(x, ends(folder, env, last=many))[0])
            check(table, row, env, percents[-1])
        check(table, row, "average", np.mean(percents), np.std(percents, ddof=1))


def harmful():
    """Check the intervals of changes in percent that noises.md lists under "Further numbers"."""
    numbers = {row["quantity"]: row for row in rows_of("tables/numbers.csv")}
    for noise, name in ((NORMAL, "NormalNoisyObservation(1.0)"), (MIXUP, "mixup")):
        pairs = [(ends("runs", e, noise, last=5), ends("runs", e, last=10)) for e in ENVS]
        row = numbers[f"its interval ({name} on Pusher)"]
        check("numbers", row, "value", *fieller(*pairs[ENVS.index("Pusher")])[1:])
        row = numbers[f"interval of the average change with {name}, percent"]
        check("numbers", row, "value", *average(pairs)[1:])


def baselines():
    """Check runs without noise: batches of PPO, and SAC and TD3 beside what others published."""
    for row in rows_of("tables/all_runs_batches.csv"):
        tests = ends(row["folder"], row["environment"])
        for name, value in {"n": len(tests), "mean": tests.mean(), "sd": tests.std(ddof=1)}.items():
            check("all_runs_batches", row, name, value)
    for row in rows_of("tables/baselines_sac_td3.csv"):
        folders = "long" if row["steps"] == "1000000" else "runs sac_200k td3_200k"
        tests = ends(folders, row["environment"], algorithm=row["algorithm"])
        if not row["source"].endswith("training"):  # those are means of training episodes
            check("baselines_sac_td3", row, "mean", tests.mean())
            check("baselines_sac_td3", row, "sd", tests.std(ddof=1))


def new_set(name, algorithm):
    """Check set F or G, whose runs count with the mean of their tests in the last 15 % of steps."""
    if not (HERE / f"tables/{name}.csv").exists():
        return
    rows, where = rows_of(f"tables/{name}.csv"), {"algorithm": algorithm, "late": True}
    alone = [row for row in rows if row["environment"] != "together"]
    pairs = defaultdict(dict)  # of each noise, by environment
    for row in alone:
        env, noise = row["environment"], row["noise"]
        rate = str(float(row["rate"]))
        pairs[noise][env] = ends(name, env, noise, rate, **where), ends(name, env, **where)
    together = {noise: in_scores(list(found.values())) for noise, found in pairs.items()}
    corrected = dict(zip(together, holm(together.values()), strict=True))
    for row in alone:
        x, y = pairs[row["noise"]][row["environment"]]
        _, low, high = fieller(x, y)
        if min(len(x), len(y)) < 5:  # too few for an interval
            low = high = np.nan
        cells = {"n": len(x), "mean": x.mean(), "sd": x.std(ddof=1)}
        cells |= {"n_without": len(y), "mean_without": y.mean(), "sd_without": y.std(ddof=1)}
        cells |= {"difference": x.mean() - y.mean(), "effect_size": effect_size(x, y)}
        cells |= {"difference_percent": percent(x, y), "low_percent": low, "high_percent": high}
        for column, value in cells.items():
            check(name, row, column, value)
        check(name, row, "p", one(x, y), drawn=True)
    for row in rows[len(alone) :]:
        found = list(pairs[row["noise"]].values())
        check(name, row, "difference_percent", np.mean([percent(x, y) for x, y in found]))
        check(name, row, "effect_size", np.median([effect_size(x, y) for x, y in found]))
        check(name, row, "p", together[row["noise"]], drawn=True)
        check(name, row, "holm", corrected[row["noise"]], drawn=True)


def ended_by_its_rule():
    """Check that set E ended at the first look that decides, or sees too little hope: plans.md."""
    rows = rows_of("tables/ppo_walker2d.csv")
    rule = {10: (0.0000011, 0.0), 20: (0.00079, 0.3), 30: (0.0074, 0.75), 40: (0.0220, 1.3)}
    for row in rows:
        level, least = rule[int(row["n"])]
        check("ppo_walker2d", row, "level", level)
        if (float(row["p"]) <= level or abs(float(row["t"])) < least) != (row is rows[-1]):
            wrong.append(f"ppo_walker2d.csv: not the end by the rule: {list(row.values())}")


def percent(x, y):
    """Return the change in percent, or NaN where the mean without noise may be zero."""
    margin = quantile(len(y) - 1) * y.std(ddof=1) / len(y) ** 0.5
    return fieller(x, y)[0] if abs(y.mean()) > margin else np.nan


def effect_size(x, y):
    """Return the difference in standard deviations over seeds."""
    return (x.mean() - y.mean()) / ((x.var(ddof=1) + y.var(ddof=1)) / 2) ** 0.5


def physics():
    """Check set D: policies under other masses and frictions, in robustness.csv of each run."""
    changed, found = [f"factor {factor}" for factor in (0.7, 0.85, 1.15, 1.3)], {}
    names = {f"RandomDynamics({name[7:]}, {name[7:]})": name for name in changed}
    names |= {
        "": "factor 1.0",
        "RandomActionDelay(1)": "delay 1",
        "RandomActionDelay(2)": "delay 2",
    }
    for row in rows_of("tables/physics_returns.csv"):
        noise = row["trained with"].replace("no noise", "")
        runs = RUNS["PPO", "physics", row["environment"] + "-v5", noise, "1.0" if noise else ""]
        tests = [means(rows_of(path / "robustness.csv"), "noise") for _, path in runs.values()]
        cells = {name: np.array([test[key] for test in tests]) for key, name in names.items()}
        cells["clean"] = ends("physics", row["environment"], noise)
        cells["changed physics"] = np.mean([cells[name] for name in changed], axis=0)
        for name, values in cells.items():
            check("physics_returns", row, name, values.mean(), values.std(ddof=1))
            found[row["environment"], noise, name] = values
    for row in rows_of("tables/physics_questions.csv"):
        name = "clean" if row["question"].startswith("clean") else "changed physics"
        others = [WEAK, SCALED] if "cheap" in row["question"] else [""]
        pairs = [
            (found[env, DYNAMICS, name], np.mean([found[env, o, name] for o in others], axis=0))
            for env in ENVS
            if env != "Humanoid"
        ]
        together("physics_questions", row, "change", pairs)


def main():
    """Check all tables that are computed here; return the exit status."""
    read_runs()
    sac, td3 = {"algorithm": "SAC"}, {"algorithm": "TD3"}
    compare("all_runs_best_noises", sides("all_runs_best_noises", ALL))
    compare("all_runs_sac_early", sides("all_runs_sac_early", "runs long", step=200_000, **sac))
    compare("all_runs_fresh", sides("all_runs_fresh", f"{ALL} ppo_hopper ppo_walker2d"))
    compare("ppo_hopper", sides("ppo_hopper", "ppo_hopper"), one)
    compare("sac_200k", sides("sac_200k", "sac_200k", **sac), one)
    compare("td3_200k", sides("td3_200k", "td3_200k", **td3), one)
    looks = [int(row["n"]) for row in rows_of("tables/ppo_walker2d.csv")]
    pairs = [sides("ppo_walker2d", "ppo_walker2d", last=100 + n)[0] for n in looks]
    compare("ppo_walker2d", pairs, one)
    ended_by_its_rule()
    compare("ppo_paper_best", sides("ppo_best_noises", "runs", last=10))
    clean, cut, first = (ends("runs", "Pusher", noise, last=20) for noise in ("", CUT, END))
    pairs = [
        [ends("runs", "Pusher", noise, "1.0", *seeds) for noise in (END, "")]
        for seeds in ((1, 10), (11, 30), (1, 30))
    ]
    compare("early_termination", [*pairs, (cut, clean), (cut, first)])
    falling = ends("schedules", "Pusher", END, "1.0:0.0")
    compare("falling_rate", [(falling, first), (falling, clean)])
    weak = ends("schedules", "Pusher", WEAK)
    both = ends("schedules", "Pusher", f"{END} + {WEAK}", "1.0 + 1.0")
    compare("two_noises", [(weak, clean[:10]), (both, clean[:10]), (both, first[:10])])
    pair = [ends("choice", "Pusher", noise, first=1001) for noise in (END, "")]
    compare("choice_confirmation", [pair])
    noisy = [ends("runs", "HalfCheetah", NORMAL, rate, **td3) for rate in ("0.01", "1.0")]
    clean = ends("runs", "HalfCheetah", **td3)
    compare("td3_harmful", [(x, clean) for x in noisy])
    averages("ppo_harmful", "runs", "1.0", 5, 10)
    averages("ablation", "ablation", "0.05", 3, 3)
    new_set("td3_fresh", "TD3")
    new_set("ppo_relative", "PPO")
    harmful()
    baselines()
    physics()
    for line in wrong:
        print(line)
    others = sorted(path.stem for path in HERE.glob("tables/*.csv") if path.stem not in checked)
    print(f"{len(wrong)} of {sum(checked.values())} numbers in {len(checked)} tables differ")
    print("not computed here:", ", ".join(others))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
