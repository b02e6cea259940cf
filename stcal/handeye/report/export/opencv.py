"""Matrices of a hand-eye calibration as YAML: for OpenCV's FileStorage, and for Zivid's SDK."""

import yaml

from stcal.geometry.rigid import Rigid
from stcal.handeye.report.export.frames import said_of
from stcal.handeye.result import HandEye
from stcal.io.plain_yaml import load_yaml, opencv_matrix


def opencv_yaml(result: HandEye) -> str:
    """Returns a file for ``cv2.FileStorage``: both transforms, 4×4, and their covariances if there are any; mm, rad."""
    covariances = (result.covariance, result.stand_covariance)
    lines = ["%YAML:1.0", "---", f'setup: "{result.setup}"', f'method: "{result.method}"', 'unit: "mm"']
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        lines += opencv_matrix(name, pose.matrix())
        if covariance is not None:
            lines += opencv_matrix(f"{name}_covariance", covariance)
    return "\n".join(lines) + "\n"


def zivid_yaml(result: HandEye) -> str:
    """Returns a file as ``zivid.Matrix4x4`` saves and loads it: 4×4, mm."""
    head = "".join(f"# {line}\n" for line in said_of(result))
    content = {
        "__version__": {"serializer": 1, "data": 1},
        "FloatMatrix": {"Data": result.mount_from_camera.matrix().tolist()},
    }
    return head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)


def read_zivid(text: str) -> Rigid:
    """Returns the transform in a file of :func:`zivid_yaml`, mm."""
    return Rigid.from_matrix(load_yaml(text)["FloatMatrix"]["Data"])
