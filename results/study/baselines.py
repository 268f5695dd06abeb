"""SAC and TD3 without noise beside published returns."""

import numpy as np
import pandas as pd
from scipy import stats

from results.study.compare import holm
from results.study.returns import RESULTS, read_returns

KEYS = ["algorithm", "environment", "steps"]
FOLDERS = ("runs", "long", "sac_200k", "td3_200k")
EARLY, FULL = 200_000, 1_000_000  # steps


def published():
    """Return published returns: KEYS, source, theirs, their_sd and their_n, a row each.

    The paper's are test returns of 5 seeds; those of TD3's authors, too, of 10. CleanRL's are the
    training returns of 3 seeds; its deviation is the population's (np.std in its rlops).
    """
    names = {"baseline_mean": "theirs", "baseline_std": "their_sd", "mean": "theirs"}
    names |= {"std": "their_sd", "test_return": "theirs"}
    best, early, authors, cleanrl = (
        pd.read_csv(RESULTS / f"paper/{name}.csv").rename(columns=names)
        for name in ("best", "early_performance_sac", "td3_authors", "cleanrl")
    )
    early = early.query("steps_millions == 0.2 and noise_rate == 0")
    authors = authors.query("step == @EARLY").groupby("environment")["theirs"]
    authors = authors.agg(theirs="mean", their_sd="std").reset_index()
    cleanrl["their_sd"] = cleanrl["population_std"] * np.sqrt(3 / 2)
    source = "CleanRL, " + cleanrl["version"] + ", training"
    found = [
        best.assign(steps=FULL, source="the paper, v2", their_n=5),
        early.assign(steps=EARLY, source="the paper, v2", their_n=5),
        authors.assign(algorithm="TD3", steps=EARLY, source="its authors, v1", their_n=10),
        cleanrl.assign(steps=FULL, source=source, their_n=3),
    ]
    table = pd.concat(found)[[*KEYS, "source", "theirs", "their_sd", "their_n"]]
    return table.assign(environment=table["environment"].str.split("-").str[0])


def sac_and_td3():
    """Compare SAC and TD3 with published returns: Welch's p, corrected for all of these tests."""
    runs = read_returns(*FOLDERS).query("noise == '' and algorithm != 'PPO'")
    runs = runs[runs.groupby(KEYS)["seed"].transform("nunique") > 1]  # one seed has no deviation
    groups = runs.groupby(KEYS)
    ours = groups.agg(n=("test", "size"), mean=("test", "mean"), sd=("test", "std"))
    training = groups["training"].agg(["mean", "std"]).set_axis(["mean", "sd"], axis=1)
    table = ours.reset_index().merge(published(), how="left", on=KEYS).set_index(KEYS)
    of_training = table["source"].str.endswith("training").fillna(False).astype(bool)
    for name in ("mean", "sd"):
        table.loc[of_training, name] = training[name].reindex(table.index[of_training])
    sides = ("mean", "sd", "n"), ("theirs", "their_sd", "their_n")
    values = [table[name].to_numpy(float) for side in sides for name in side]
    p = stats.ttest_ind_from_stats(*values, equal_var=False).pvalue
    error = np.sqrt(sum(table[sd] ** 2 / table[n] for _, sd, n in sides))
    table = table.assign(se=(table["mean"] - table["theirs"]) / error, p=p)
    tested = table["p"].notna()
    table.loc[tested, "holm"] = holm(table["p"][tested])
    return table.reset_index()
