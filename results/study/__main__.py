"""Write the tables that are computed from results/data: python -m results.study.

The other tables are of finished studies, see results/tables/README.md.
"""

from results.study import baselines, claims, physics, pooled
from results.study.compare import comparisons, in_looks
from results.study.returns import RESULTS, read_returns

SETS = ("ppo_hopper", "sac_200k", "td3_200k", "ppo_walker2d")  # of plans.md, as they finish


def tables():
    """Return {name: frame}."""
    sets = {name: read_returns(name) for name in SETS}
    sets = {name: runs for name, runs in sets.items() if len(runs) and runs["seed"].nunique() > 1}
    found = {name: comparisons(runs) for name, runs in sets.items()}
    found["ppo_walker2d"] = in_looks(found["ppo_walker2d"])
    return found | {
        "all_runs_batches": pooled.batches(),
        "all_runs_best_noises": pooled.best_noises(),
        "baselines_sac_td3": baselines.sac_and_td3(),
        "all_runs_sac_early": pooled.sac_early(),
        "consistent_rows": pooled.consistent_rows(),
        "pusher_steps": pooled.pusher_steps(),
        "sac_headline": pooled.sac_headline(),
        "claims": claims.table(),
        **physics.tables(),
    }


def as_csv(table):
    """Return a table as the text of its csv."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


if __name__ == "__main__":
    for name, table in tables().items():
        (RESULTS / f"tables/{name}.csv").write_text(as_csv(table), encoding="utf-8")
    if len(tests := physics.read_tests()):
        physics.draw(tests, RESULTS / "figures/physics.svg")
