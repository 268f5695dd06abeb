"""The learning curves of docs/performance.md, in float32 and bfloat16.

python results/pages/precision.py
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

RESULTS = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(RESULTS.parent))
from analysis.effects import PALETTE  # noqa: E402
from analysis.runs import read_runs  # noqa: E402

runs = read_runs(RESULTS / "data/precision")
runs["precision"] = [json.loads(text)["matmul_precision"] for text in runs["arguments"]]
algorithms = runs.groupby("algorithm")

fig, axes = plt.subplots(
    1, len(algorithms), figsize=(2 + 4 * len(algorithms), 3.2), layout="constrained", squeeze=False
)
for ax, (algorithm, group) in zip(axes[0], algorithms, strict=True):
    steps = group["steps"].iloc[0]
    curves = {name: np.stack(list(same)) for name, same in group.groupby("precision")["returns"]}
    for name, line, color in (("bf16", "--", PALETTE[1]), ("medium", "-", "black")):
        mean, std = curves[name].mean(0), curves[name].std(0, ddof=1)
        ax.plot(steps / 1e3, mean, line, color=color, label=f"{name} (n = {len(curves[name])})")
        ax.fill_between(steps / 1e3, mean - std, mean + std, color=color, alpha=0.15, linewidth=0)
        print(f"{algorithm} {name} at the last step: {mean[-1]:.0f} ± {std[-1]:.0f}")
    ax.set_title(algorithm)
    ax.set_xlabel("training steps (thousands)")
    ax.set_ylabel("test return")
    ax.legend(frameon=False)

    bf16, medium = curves["bf16"][:, -1], curves["medium"][:, -1]
    low, high = stats.ttest_ind(bf16, medium, equal_var=False).confidence_interval()
    print(f"{algorithm}, bf16 - medium: {low:.0f} to {high:.0f} (95 %, Welch)")
fig.savefig(RESULTS / "figures/precision.png", dpi=120, metadata={"Software": None})
