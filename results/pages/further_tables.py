"""Write to tables/ what the pages only sum up: python results/pages/further_tables.py.

Gains and standard deviations are in units of the return, differences ending in _se in standard
errors. p is two-sided; where it ends in _holm it is corrected for the rows of its table.
"""

import baselines
import pandas as pd
import readme
from common import ENVIRONMENTS, RESULTS
from paper_tables import kinds_by_chance, spread_tests, steps_to_the_baseline

from analysis.paper import read_paper

DIGITS = "%.6g"


def best_noises_of_ppo(found):
    """PPO with the paper's best noises, seeds 1 to 10: gains, spreads, steps, a test's share.

    found: of readme.numbers(). Steps are those of the first test at which the mean over seeds is at
    the baseline's final mean; the share is that of the test's episodes in the variance over seeds.
    """
    table = found["five"]["gains"].join(found["spread"]["table"])
    for name in ("without", "with"):
        table[f"steps_{name}"] = pd.Series(found["speed"][name]).astype("Int64")
    for name in ("without", "with"):
        table[f"test_percent_of_variance_{name}"] = found["test_share"][name]
    return table.reset_index()


def baselines_in_full(found):
    """How far each baseline is from the paper's test and CleanRL's training returns: Welch's p.

    found: of baselines.numbers(). Holm's correction is over PPO's five environments.
    """
    rows = []
    for total, name in ((baselines.FULL_LENGTH, "full"), (baselines.SHORT_LENGTH, "short")):
        for baseline, others in found[name]["numbers"].items():
            row = {"baseline": baseline, "total_timesteps": total}
            row |= {f"{who}_{key}": other[key] for who, other in others.items() for key in other}
            if others:
                rows.append(row)
    table = pd.DataFrame(rows)
    of_ppo = {f"PPO on {name}-v5": name for name in ENVIRONMENTS}
    environment = table["baseline"].map(of_ppo)
    table.insert(4, "paper_p_holm", environment.map(found["holm"]))
    return table.assign(test_percent_of_variance=environment.map(found["share"]))


def tables():
    """Return {name: frame}."""
    paper, found = read_paper(RESULTS / "paper"), readme.numbers()
    return {
        "ppo_best_noises": best_noises_of_ppo(found),
        "paper_spread": spread_tests(paper),
        "paper_kinds": kinds_by_chance(paper),
        "paper_steps_to_baseline": steps_to_the_baseline(paper),
        "baselines": baselines_in_full(baselines.numbers()),
    }


if __name__ == "__main__":
    for name, table in tables().items():
        table.to_csv(RESULTS / f"tables/{name}.csv", index=False, float_format=DIGITS)
    print(f"Wrote tables to {RESULTS / 'tables'}")
