"""Export of a hand-eye transform as a frame of robot controllers: KUKA, ABB, Universal Robots, FANUC."""

import numpy as np

from stcal.handeye.data.loop import FRAMES
from stcal.handeye.report.export.frames import said_of
from stcal.handeye.result import HandEye
from stcal.io.poses.controllers import ABB, FANUC, KUKA, UR

REMARK = 32
"""Largest number of characters of a remark in a FANUC program."""


def kuka_dat(result: HandEye, name: str) -> str:
    """Returns a data list of KRL with the frame."""
    head = "".join(f"; {line}\n" for line in said_of(result))
    frame = f"DECL GLOBAL FRAME {FRAMES[result.setup].camera}={{{KUKA.write(result.mount_from_camera)}}}\n"
    return f"&ACCESS RVP\nDEFDAT {name} PUBLIC\n{head}{frame}ENDDAT\n"


def abb_module(result: HandEye, name: str) -> str:
    """Returns a module of RAPID with a ``pose``."""
    head = "".join(f"  ! {line}\n" for line in said_of(result))
    frame = f"  PERS pose {FRAMES[result.setup].camera}:=[{ABB.write(result.mount_from_camera)}];\n"
    return f"MODULE {name}\n{head}{frame}ENDMODULE\n"


def ur_script(result: HandEye) -> str:
    """Returns a pose of URScript."""
    head = "".join(f"# {line}\n" for line in said_of(result))
    return f"{head}{FRAMES[result.setup].camera} = {UR.write(result.mount_from_camera)}\n"


def fanuc_program(result: HandEye, name: str) -> str:
    """Returns a program (LS) with the frame as its position."""
    remarks = [FRAMES[result.setup].camera]
    if result.covariance is not None:
        sigma = np.sqrt(np.diag(result.covariance))
        for unit, part in (("mm", sigma[3:]), ("deg", np.degrees(sigma[:3]))):
            remarks.append(f"sigma {unit} " + " ".join(f"{v:.2g}" for v in part))
    lines = [f"/PROG  {name}", "/ATTR", 'COMMENT = "stcal handeye";', "/MN"]
    lines += [f"   {k}:  !{remark[:REMARK]} ;" for k, remark in enumerate(remarks, 1)]
    lines += ["/POS", "P[1]{", "   GP1:", "\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',"]
    return "\n".join([*lines, FANUC.write(result.mount_from_camera), "};", "/END"]) + "\n"
