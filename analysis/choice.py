"""The file of `./benchmark.sh choose`: how a noise was chosen."""

from pathlib import Path

import pandas as pd

from analysis import folders
from analysis.folders import RETURN, SUCCESS
from noisy_wrappers import Configuration

KEYS = ["algorithm", "environment", "exp_name", "tested"]  # they tell one choice from another
CHOICE_COLUMNS = [*KEYS, "phase", "round", "noise", "noise_rate", "seeds", "score", "survives"]


def choice_file(metric=RETURN):
    """Name the file of what was chosen by a metric: scores of two do not compare."""
    return "choice_by_success.csv" if metric == SUCCESS else "choice.csv"


def read_choice(runs_dir, metric=RETURN):
    """Read the choice_file of `./benchmark.sh choose`, or return None where there is none.

    Raises ValueError for a damaged file.
    """
    path = Path(runs_dir) / choice_file(metric)
    if not path.exists():
        return None
    text = dict.fromkeys(set(CHOICE_COLUMNS) - {"seeds", "score"}, str)
    with folders.naming(path):
        choice = pd.read_csv(path, dtype=text, keep_default_na=False)
        if list(choice.columns) != CHOICE_COLUMNS:
            raise ValueError(f"its columns are not {','.join(CHOICE_COLUMNS)}")
        pairs = zip(choice["noise"], choice["noise_rate"], strict=True)
        choice["noise_rate"] = [Configuration.parse(*pair).noise_rate for pair in pairs]
    return choice
