"""PPO on Walker2d-v4 beside CleanRL's own script, on one machine, for baselines.md.

data/side_by_side has our runs and cleanrl.csv: the last 100 training episodes of CleanRL's runs,
with the columns seed and episodic_return.
"""

import pandas as pd
from common import DATA, compare_rows, read_returns

from analysis.statistics import LEVEL, detectable_percent


def side_by_side(folder=DATA / "side_by_side"):
    """Compare the training returns of both scripts: numbers of compare_rows, and what they show."""
    ours = read_returns(folder)["training"].to_numpy()
    cleanrl = pd.read_csv(folder / "cleanrl.csv").groupby("seed")["episodic_return"].mean()
    row, numbers = compare_rows("", ours, cleanrl.to_numpy())
    return numbers | {
        "ours": row["first"],
        "cleanrl": row["second"],
        "differs": numbers["p"] <= LEVEL,
        "detectable": detectable_percent(ours, cleanrl),
    }
