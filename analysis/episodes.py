"""Episodes of trained policies that were tested again: robustness.csv in a run's folder."""

import numpy as np
import pandas as pd

from analysis.folders import naming, rewritten
from noisy_wrappers import WRAPPERS, Configuration

KEYS = ["noise", "noise_rate", "environment"]  # the environment is empty for that of the training
RESULTS = ["episodic_return", "episodic_length", "success"]
COLUMNS = ["noise", "noise_rate", "episode", *RESULTS, "environment"]
OPTIONAL = ["success", "environment"]  # columns that a file lacks where they would be empty


def read_episodes(folder):
    """Read robustness.csv, or robustness.csv.gz: {(Configuration, environment): its episodes}.

    An array (episodes, 3) of returns, lengths and successes (1 or 0; NaN where the environment does
    not tell it). Raises DamageError; what does not exist is empty.
    """
    path = folder / "robustness.csv"
    if not path.exists():
        path = path.with_suffix(".csv.gz")
    if not path.exists():
        return {}
    found = {}
    with naming(path):
        table = pd.read_csv(path, dtype=dict.fromkeys(KEYS, str))
        if [name for name in table if name not in OPTIONAL] != COLUMNS[:5] or table.empty:
            raise ValueError("unexpected header, or no episodes")
        table = table.reindex(columns=COLUMNS).astype(dict.fromkeys(KEYS, object))
        table = table.fillna(dict.fromkeys(KEYS, ""))
        for (noise, rate, environment), rows in table.groupby(KEYS, sort=False):
            condition, episodes = Configuration.parse(noise, rate), rows[RESULTS].to_numpy(float)
            if not np.isfinite(episodes[:, :2]).all():
                raise ValueError(f"a return under {condition} is not finite")
            if rows["episode"].tolist() != list(range(len(rows))):  # i begins alike everywhere
                raise ValueError(f"episodes under {condition} are lost, repeated or out of order")
            for name in wrapper_names(condition):
                if name not in WRAPPERS and ":" not in name:  # nor one of the user's own
                    raise ValueError(f"unknown noise {name!r}")
            found[condition, environment] = episodes
    return found


def wrapper_names(configuration):
    """Return the names of a configuration's wrappers, in order: perhaps with a module."""
    return [noise.partition("(")[0] for noise in configuration.noises]


def store_episodes(folder, key, episodes):
    """Add a condition to robustness.csv, beside what other processes have stored meanwhile.

    key, episodes: see read_episodes. Of two results for one condition the longer one is kept.
    """
    with rewritten(folder / "robustness.csv") as file:
        stored = read_episodes(folder)
        stored[key] = max(stored.get(key, []), episodes, key=len)
        rows = [
            (*condition.columns, i, *episode, environment or None)
            for (condition, environment), results in stored.items()
            for i, episode in enumerate(results)
        ]
        table = pd.DataFrame(rows, columns=COLUMNS)
        table = table.astype({"episodic_length": int, "success": "Int64"})
        table.dropna(axis="columns", how="all").to_csv(file, index=False)
