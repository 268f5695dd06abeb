"""Write results/README.md from the runs in data/: python results/pages/readme.py.

README.md.jinja has the text. paper_tables.py, helpful.py, harmful.py and robustness.py compute its
numbers, and verdicts.py makes the verdicts from them.
"""

from functools import cache

import ablation
import headline
import verdicts
from common import DATA, RESULTS, plain, read_returns, render, variance_share
from harmful import MIXUP, NORMAL, PLAIN_MIXUP, td3, worse_noises
from helpful import (
    five_noises,
    fixed_beforehand,
    half_cheetah,
    other_step,
    pusher,
    sac,
    speed,
    spread,
)
from paper_tables import (
    SCALE,
    kinds,
    luck_of_the_best,
    luck_of_the_consistent,
    luck_with_the_winners_spread,
    paper_speed,
    paper_spread,
    rates,
    scaled_rewards,
    worse_everywhere,
)
from reconstruction import reward_scale
from robustness import by_noise, scores, tests

from analysis.luck import DRAWS, FALSE_ALARMS_IN_THE_PAPER, POWER_IN_THE_PAPER
from analysis.paper import PAPER_SEEDS, read_paper, with_luck
from analysis.robustness import is_unseen
from analysis.runs import make_studies, read_runs
from analysis.tables import make_tables


@cache  # reading the committed runs takes seconds
def numbers():
    """Compute all that the page says."""
    paper, luck = with_luck(read_paper(RESULTS / "paper"))
    best = plain(paper["best"]).query("algorithm == 'PPO'").set_index("environment").sort_index()
    best = best.assign(n=PAPER_SEEDS["PPO"])
    paper_base, paper_noisy = (
        best[[f"{name}_mean", f"{name}_std", "n"]].set_axis(["mean", "std", "n"], axis=1)
        for name in ("baseline", "noisy")
    )

    runs = read_runs(DATA / "runs")
    tables = make_tables(make_studies(runs)[0], read_paper(RESULTS / "paper"))
    statistics, early = (
        plain(tables[n].frame) for n in ("statistics", "compare_early_performance")
    )

    returns = read_returns(DATA / "runs")
    ppo = returns.query("algorithm == 'PPO'")
    chosen = list(zip(best.index, best["noise"], best["noise_rate"], strict=True))
    of_five = fixed_beforehand(ppo, chosen)
    base, noisy = of_five[of_five["noise"] == ""], of_five[of_five["noise"] != ""]
    five_runs = runs[runs["algorithm"] == "PPO"]
    five_runs = five_runs.loc[fixed_beforehand(plain(five_runs), chosen).index]
    five = make_tables(make_studies(five_runs)[0])
    five_statistics, five_summary = (plain(five[n].frame) for n in ("statistics", "summary_PPO"))
    five_statistics = five_statistics[five_statistics["p"].notna()]
    return {
        "draws": f"{DRAWS:,}",
        "alarms": FALSE_ALARMS_IN_THE_PAPER,
        "finds_best": POWER_IN_THE_PAPER,
        "scaled_reward": SCALE,
        "normal": NORMAL,
        "mixup": MIXUP,
        "plain_mixup": PLAIN_MIXUP,
        "luck": luck_of_the_best(paper) | {"winners": luck_with_the_winners_spread(paper)},
        "smallest_consistent": paper["consistent"]["p_luck"].min(),
        "consistent": luck_of_the_consistent(luck),
        "rates": rates(paper),
        "kinds": kinds(paper),
        "scaled": scaled_rewards(paper),
        "worse": worse_everywhere(paper),
        "paper_spread": paper_spread(paper),
        "paper_speed": paper_speed(paper),
        "five": five_noises(
            base, noisy, paper_base, paper_noisy, best["improvement_percent"], five_statistics
        ),
        "spread": spread(base, noisy, paper_base, paper_noisy),
        "speed": speed(five_summary),
        "test_share": {"without": variance_share(base), "with": variance_share(noisy)},
        "pusher": pusher(ppo) | {"step": other_step(read_returns(DATA / "choice"), ppo)},
        "half_cheetah": half_cheetah(ppo, best["improvement_percent"]["HalfCheetah"]),
        "worse_noises": worse_noises(ppo, paper),
        "td3": td3(returns.query("algorithm == 'TD3'"), paper),
        "sac": sac(early, statistics),
        "ablation": ablation.numbers(read_returns(ablation.FOLDER), paper),
        "headline": headline.numbers(headline.read_curves()),
        "scale": reward_scale(),
        "unseen": by_noise(scores(tests(), is_unseen)),
    }


def page():
    """Return the text of README.md."""
    found = numbers()
    return render("README.md.jinja", found | {"claims": verdicts.table(found)})


if __name__ == "__main__":
    (RESULTS / "README.md").write_text(page())
    print(f"Wrote {RESULTS / 'README.md'}")
