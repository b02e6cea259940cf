"""File ``truth.json`` with the truth of a scene."""

from typing import Literal

import numpy as np
from pydantic import Field

from stcal.io.json import ByFace, ByGroup, ByImage, ByLabel, Pair, Part, Points, Pose, ResultFile, Vector3
from stcal.labels import BOARD, Label
from stcal.synthetic.observe import image_circles
from stcal.synthetic.scene import Scene

FIRST_IMAGE = 1000


class TrueCircle(Part):
    centre_px: Pair
    tilt_deg: float | None = None
    must_find: bool


class TrueImage(Part):
    camera_from_target: Pose | None = Field(None, description="frame of the camera")
    circles: dict[ByLabel, TrueCircle] = Field(
        description="`centre_px` image of the circle's centre (not of the ellipse's), px; `tilt_deg` angle between its "
        "normal and the line of sight; `must_find` whether detection is expected to. Dots are numbered row by row "
        "here: `board:0` …"
    )


class TrueGroup(Part):
    board_circles_target: Points = Field(description="dots as really placed, row-major, target frame, mm")
    images: dict[ByImage, TrueImage] = Field(description="`group/file` → what it shows")


class TruthFile(ResultFile):
    """Truth of a scene: mm, target frame, pixels from the centre of the top-left one. A ``faces.json`` is valid too."""

    format: Literal["stcal truth 1", "stcal faces 1"] = Field(
        default="stcal truth 1", description="the file's form and its version; may be left out"
    )
    unit: Literal["mm"] = Field(description="of all lengths")
    reference_face: str = Field(description="face id")
    target_from_face: dict[ByFace, Pose] = Field(description="three-point frame of each face")
    circles: dict[ByLabel, Vector3] = Field(description="`face:circle` → centre, target frame, mm")
    groups: dict[ByGroup, TrueGroup] | None = Field(None, description="by folder of `images`")

    @classmethod
    def of(cls, scene: Scene, image_format: str = "jpg") -> "TruthFile":
        """Returns the truth of a scene, with images named by :func:`image_name`."""
        return cls(
            unit="mm",
            reference_face=scene.reference_face,
            target_from_face={face: pose.matrix() for face, pose in scene.target_from_face.items()},
            circles={str(label): xyz for label, xyz in scene.circles_target.items()},
            groups={
                name: TrueGroup(
                    board_circles_target=group.board_circles_target,
                    images={
                        image_name(name, i, image_format): TrueImage(
                            camera_from_target=pose.matrix(), circles=_circles(scene, name, i)
                        )
                        for i, pose in enumerate(group.camera_from_target)
                    },
                )
                for name, group in scene.groups.items()
            },
        )


def image_name(group: str, image: int, image_format: str = "jpg") -> str:
    """Returns the name of an image inside ``images``: ``12/IMG_1000.jpg``."""
    return f"{group}/IMG_{FIRST_IMAGE + image}.{image_format}"


def _circles(scene: Scene, group: str, image: int) -> dict[str, TrueCircle]:
    shown = image_circles(scene, group, image)
    number: dict[Label, str] = {label: f"{BOARD}:{i}" for i, label in enumerate(scene.board.labels())}
    return {
        number.get(label, label): TrueCircle(
            centre_px=np.array([round(float(x), 5) for x in centre]),
            tilt_deg=round(float(np.degrees(tilt)), 2),
            must_find=bool(must),
        )
        for label, centre, tilt, must in zip(
            shown.labels, shown.centre_px, shown.tilt_rad, shown.must_find, strict=True
        )
    }
