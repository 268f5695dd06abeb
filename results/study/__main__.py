"""Write the tables that are computed from results/data: python -m results.study.

The other tables are of finished studies, see results/tables/README.md.
"""

from results.study import claims, pooled
from results.study.compare import TOGETHER, by_the_tool, comparisons, in_looks
from results.study.returns import RESULTS, read_returns

# The sets of plans.md by what their plans compare: each environment, looks at one comparison, or
# environments together (compare.TOGETHER)
BY_ENVIRONMENT = ("ppo_hopper", "sac_200k", "td3_200k")
IN_LOOKS = ("ppo_walker2d",)


def tables():
    """Return {name: frame}, without those that have no rows yet."""
    found = {name: comparisons(read_returns(name)) for name in BY_ENVIRONMENT}
    found |= {name: in_looks(read_returns(name)) for name in IN_LOOKS}
    found |= {name: by_the_tool(name, *planned) for name, planned in TOGETHER.items()}
    found |= {
        "all_runs_fresh": pooled.with_fresh(),
        "all_runs_best_noises": pooled.best_noises(),
        "all_runs_sac_early": pooled.sac_early(),
        "consistent_rows": pooled.consistent_rows(),
        "sac_headline": pooled.sac_headline(),
        "claims": claims.table(),
    }
    return {name: table for name, table in found.items() if len(table)}


def as_csv(table):
    """Return a table as the text of its csv."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


if __name__ == "__main__":
    for name, table in tables().items():
        (RESULTS / f"tables/{name}.csv").write_text(as_csv(table), encoding="utf-8")
