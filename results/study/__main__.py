"""Write the tables that are computed from results/data: python -m results.study.

The other tables are of finished studies, see results/tables/README.md.
"""

from results.study import claims, pooled
from results.study.compare import by_the_tool, comparisons, in_looks
from results.study.returns import RESULTS, read_returns

SETS = ("ppo_hopper", "sac_200k", "td3_200k")  # A, B and C of plans.md
# F and G, with their environments, seeds with noise and without; they get a table when they have
# runs in two environments
NEW_SETS = {"td3_fresh": (3, 8, 8), "ppo_relative": (4, 6, 9)}


def tables():
    """Return {name: frame}."""
    found = {name: comparisons(read_returns(name)) for name in SETS}
    new = {name: by_the_tool(name, *planned) for name, planned in NEW_SETS.items()}
    found |= {name: table for name, table in new.items() if len(table)}
    return found | {
        "ppo_walker2d": in_looks(read_returns("ppo_walker2d")),
        "all_runs_hopper": pooled.hopper(),
        "all_runs_best_noises": pooled.best_noises(),
        "all_runs_sac_early": pooled.sac_early(),
        "consistent_rows": pooled.consistent_rows(),
        "sac_headline": pooled.sac_headline(),
        "claims": claims.table(),
    }


def as_csv(table):
    """Return a table as the text of its csv."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


if __name__ == "__main__":
    for name, table in tables().items():
        (RESULTS / f"tables/{name}.csv").write_text(as_csv(table), encoding="utf-8")
