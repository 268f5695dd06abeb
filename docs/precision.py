"""The learning curves of docs/performance.md, in float32 and bfloat16: python docs/precision.py."""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from analyze_runs import read_runs  # noqa: E402

runs = read_runs(HERE.parent / "results/precision")
precision = [json.loads(settings)["matmul_precision"] for settings in runs["settings"]]
curves = {name: np.stack(list(group)) for name, group in runs["returns"].groupby(precision)}
steps = runs["steps"].iloc[0]

fig, ax = plt.subplots(figsize=(6, 3.2), layout="constrained")
for (name, returns), line, color in zip(curves.items(), ("--", "-"), ("C1", "black"), strict=True):
    mean, std = returns.mean(0), returns.std(0, ddof=1)
    ax.plot(steps / 1e3, mean, line, color=color, label=f"{name} (n = {len(returns)})")
    ax.fill_between(steps / 1e3, mean - std, mean + std, color=color, alpha=0.15, linewidth=0)
    print(name, *(f"{m:.0f} ± {s:.0f}" for m, s in zip(mean, std, strict=True)), sep=" | ")
ax.set_xlabel("training steps (thousands)")
ax.set_ylabel("test return")
ax.legend(frameon=False)
fig.savefig(HERE / "precision.png", dpi=120, metadata={"Software": None})

test = stats.ttest_ind(curves["bf16"][:, -1], curves["medium"][:, -1], equal_var=False)
low, high = test.confidence_interval()
print(f"bf16 - medium at the last step: {low:.0f} to {high:.0f} (95 %, Welch)")
