"""Time of the robot's two heavy computations, and their ratio to plain numpy of the same size in the same run.

.venv/bin/python scripts/bench_robot.py [--poses 3000] [--vectors 1000000]

Forward kinematics of many joint vectors of a six-axis arm, beside six products of as many 4×4 matrices: what a chain of
six transforms is at least. Identification from poses (adjustment, σ, covariance, and the cross-validation with its six
further adjustments), beside one least-squares solution of a matrix of its size.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.robot import IdentifyOptions, forward, identify
from stcal.robot.kinematics.model import mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed

JOINTS, PARAMETERS, PER_POSE = 6, 30, 6


def seconds(work: Callable, repeats: int = 3) -> float:
    """Least of some runs: what others do on the machine only adds."""
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


def forward_times(vectors: int) -> tuple[float, float]:
    """Seconds of the forward kinematics, and of plain products."""
    robot, rng = mh80(), np.random.default_rng(0)
    q = joint_vectors(robot, vectors, rng)
    step = rng.normal(size=(vectors, 4, 4))

    def products() -> None:
        pose = step
        for _ in range(JOINTS):
            pose = pose @ step

    return seconds(lambda: forward(robot, q)), seconds(products)


def identify_times(poses: int, folds: int = 6) -> tuple[float, float]:
    """Seconds of the identification, and of one least-squares solution."""
    rng = np.random.default_rng(0)
    tool = Rigid.exp([0.1, 0.2, -0.3, 100, 50, 150])
    true = placed(made(mh80(), rng), Rigid.exp([0.1, 0.2, 0.3, 900, 800, 700]), {"": tool})
    data = measured(true, joint_vectors(true, poses, rng), rng)
    matrix = rng.normal(size=(PER_POSE * poses, PARAMETERS))
    right = rng.normal(size=len(matrix))
    options = IdentifyOptions(folds=folds)
    return (
        seconds(lambda: identify(mh80(), data, options), 2),
        seconds(lambda: np.linalg.lstsq(matrix, right, rcond=None), 5),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--poses", type=int, default=3000)
    parser.add_argument("--vectors", type=int, default=1_000_000)
    arguments = parser.parse_args()
    own, plain = forward_times(arguments.vectors)
    print(f"forward kinematics of {arguments.vectors} joint vectors: {own:.2f} s")
    print(f"  {own / plain:.1f} times the {plain:.2f} s of {JOINTS} products of as many 4×4 matrices")
    for folds in (0, 6):
        own, plain = identify_times(arguments.poses, folds)
        what = f"with {folds}-fold cross-validation" if folds else "without cross-validation"
        print(f"identification from {arguments.poses} poses {what}: {own:.2f} s")
        print(f"  {own / plain:.0f} times the {1000 * plain:.1f} ms of one least-squares solution of that size")


if __name__ == "__main__":
    main()
