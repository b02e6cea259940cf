"""How many honest sets of poses `stcal handeye` finds good.

.venv/bin/python scripts/studies/handeye_verdicts.py [--sets 60]

Poses of robot and board are simulated with errors as they are assumed: σ 0.5 mrad and 0.2 mm on either side. The way of
solving is chosen as it is where no method is named. "Taken": the ways, and how often; "off": the distance of X from the
truth, mm, mean and largest, and the same for all sets solved by poses as filed.
"""

from collections import Counter

import numpy as np

from scripts.runner import options_of
from stcal.handeye import HandEyeOptions, splits
from stcal.handeye.judge.remarks import GOOD
from stcal.handeye.pipeline import validated
from stcal.handeye.report.outcome import Outcome, judged
from stcal.handeye.solve import handeye
from tests.support.handeye import simulated

NOISE = (5e-4, 0.2)
POSES = (16, 25)


def main() -> None:
    """Both numbers of poses."""
    sets, good = options_of(__doc__, sets=60).sets, 0
    print("| poses | good | taken | off | off as filed |\n|---|---|---|---|---|")
    for count in POSES:
        words, taken, off = [], Counter(), []
        for seed in range(sets):
            truth = simulated(np.random.default_rng([count, seed]), count, "eye-in-hand", NOISE, NOISE)
            pairs, setup, options = truth.pairs, truth.setup, HandEyeOptions()
            found = validated(pairs, setup, None, None, options, None, splits(count), choosing=True)
            outcome = Outcome("simulated", found.result, found.held_out, choice=found.choice, pairs=pairs)
            words.append(judged(outcome).word)
            if found.choice is not None:
                taken[found.choice.chosen.name] += 1
            results = found.result, handeye(pairs, setup, "pose")
            true = truth.mount_from_camera.translation
            off.append([np.linalg.norm(each.mount_from_camera.translation - true) for each in results])
        good += words.count(GOOD)
        ways = ", ".join(f"{name} {times}" for name, times in taken.most_common())
        figures = [f"{column.mean():.2f}, {column.max():.2f}" for column in np.array(off).T]
        print(f"| {count} | {words.count(GOOD)} of {sets} | {ways} | {' | '.join(figures)} |", flush=True)
    print(f"good: {good} of {len(POSES) * sets}")


if __name__ == "__main__":
    main()
