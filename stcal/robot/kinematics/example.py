"""The example of a robot that ``stcal robot init`` writes."""

import numpy as np

from stcal.robot.kinematics.model import DHRow, Joint, Robot


def mh80() -> Robot:
    """Returns an arm with the size, reach (2061 mm) and joint ranges of Yaskawa's Motoman MH80, from its data sheet; J3
    is not coupled, and the tool is at the flange."""
    rows = ((145, -90, 540, 0), (870, 0, 0, -90), (210, -90, 0, 0), (0, 90, 1025, 0), (0, -90, 0, 0), (0, 0, 175, 0))
    ranges = ((-180, 180), (-90, 155), (-80, 90), (-360, 360), (-125, 125), (-360, 360))
    return Robot(
        "MH80",
        "standard",
        tuple(DHRow(a, float(np.radians(alpha)), d, float(np.radians(theta))) for a, alpha, d, theta in rows),
        tuple(Joint("revolute", *np.radians(r).tolist()) for r in ranges),
    )
