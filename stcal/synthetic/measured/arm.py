"""An arm whose axes are off its file, at poses of a hand-eye calibration."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot import Joint, Robot, inverse, jacobian
from stcal.robot.kinematics.example import mh80
from stcal.robot.kinematics.forward import chain_parameters, flange_poses, moved_chain

STEPS, REACHED = 50, 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class TrueArm:
    """``robot`` : as its file says, without joint limits; ``parameters`` : (k,) by which its axes really are off, small
    motions of the joints' frames; ``q`` : (m, n) joint values at which the flange is where it was wanted."""

    robot: Robot
    parameters: np.ndarray
    q: np.ndarray


def arm_at(rng: np.random.Generator, base_from_flange: Poses, sigma_rad: float, sigma_mm: float) -> TrueArm:
    """The example of a robot with axes off by these σ, at poses of its flange.

    Raises
    ------
    ConvergenceError
        A pose is not reached.
    """
    robot = replace(mh80(), joints=(Joint(),) * 6)
    chain = replace(robot, world_from_base=Rigid()).chain()
    sigma = [sigma_rad if component < 3 else sigma_mm for _, component in chain_parameters(chain)]
    parameters = rng.normal(0, sigma)
    true, q = moved_chain(chain, parameters), inverse(robot, base_from_flange).q.copy()
    for _ in range(STEPS):
        off = base_from_flange.difference(flange_poses(true, q))
        if np.abs(off).max() < REACHED:
            return TrueArm(robot, parameters, q)
        q += np.linalg.solve(jacobian(robot, q), off[:, :, None])[:, :, 0]
    raise ConvergenceError(f"arm: a pose of the flange is missed by {np.abs(off).max():.2g}; take others")
