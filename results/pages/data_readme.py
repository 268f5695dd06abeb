"""Write results/data/README.md from the runs beside it: python results/pages/data_readme.py.

data_readme.md.jinja has the text, this file every number in it.
"""

import json

from common import DATA, RESULTS, plain, read_returns, render
from harmful import MIXUP, NORMAL, PLAIN_MIXUP
from helpful import fixed_beforehand
from paper_tables import SCALE

from analysis.paper import read_paper
from analysis.runs import read_runs


def noise_rates(folder):
    """The largest distance of a realised noise rate from p, in binomial standard deviations."""
    largest = 0
    for path in sorted(folder.glob("*/result.json")):
        args = json.loads((path.parent / "config.json").read_text())["args"]
        counts = json.loads(path.read_text())["noise_applied"].values()
        for rate, (applied, calls) in zip(args["noise_rate"], counts, strict=True):
            deviation = (calls * rate * (1 - rate)) ** 0.5
            if deviation:
                largest = max(largest, abs(applied - calls * rate) / deviation)
    return largest


def commits_of_the_five():
    """Count the commits that the runs of the five comparisons fixed beforehand are from."""
    best = plain(read_paper(RESULTS / "paper")["best"]).query("algorithm == 'PPO'")
    chosen = list(zip(best["environment"], best["noise"], best["noise_rate"], strict=True))
    runs = plain(read_runs(DATA / "runs")).query("algorithm == 'PPO'")
    names = fixed_beforehand(runs, chosen)["run"]
    configs = [json.loads((DATA / "runs" / name / "config.json").read_text()) for name in names]
    return len({config["git_commit"] for config in configs})


def numbers():
    """Compute all that the page says."""
    counts = read_returns(DATA / "runs").groupby("algorithm").size()
    long = read_returns(DATA / "long")
    groups = long.groupby(["algorithm", "environment", "noise"])
    return {
        "runs": ", ".join(f"{name} {n}" for name, n in counts.items()),
        "long": ", ".join(
            f"{algorithm} on {environment} {f'with `{noise}`' if noise else 'without noise'} {n}"
            for (algorithm, environment, noise), n in groups.size().items()
        ),
        "rate_error": noise_rates(DATA / "runs"),
        "commits": commits_of_the_five(),
        "normal": NORMAL,
        "mixup": MIXUP,
        "plain_mixup": PLAIN_MIXUP,
        "scaled_reward": SCALE,
    }


def page():
    """Return the text of data/README.md."""
    return render("data_readme.md.jinja", numbers())


if __name__ == "__main__":
    (DATA / "README.md").write_text(page())
    print(f"Wrote {DATA / 'README.md'}")
