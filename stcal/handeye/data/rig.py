"""What several cameras of one robot saw of one board."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views, pairs_of_views
from stcal.io.cameras.model import CameraPrior


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """What one camera of a rig saw.

    Parameters
    ----------
    name : str
        What the camera is called.
    views : Views
        v of them, with the camera's intrinsics.
    rows : (v,) int array
        At which of the robot's poses each was taken; no pose twice.
    images : tuple of str
        Name of each view.
    prior : CameraPrior, optional
        What is known of the intrinsics; they are exact where None.
    """

    name: str
    views: Views
    rows: np.ndarray
    images: tuple[str, ...]
    prior: CameraPrior | None = None

    def __post_init__(self):
        object.__setattr__(self, "rows", frozen(self.rows, (len(self.views),), "rows", int))
        if len(self.images) != len(self.views):
            raise InputError(
                "E-NAMES-COUNT", f"camera {self.name}: {len(self.images)} names of {len(self.views)} views; one each"
            )
        if len(set(self.rows.tolist())) < len(self.rows):
            raise InputError(
                "E-RIG-INSTANT", f"camera {self.name}: two images of one pose of the robot; take one of them out"
            )

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index) -> "RigCamera":
        """Views by a mask or list."""
        kept = np.arange(len(self))[index]
        images = tuple(self.images[i] for i in kept)
        return replace(self, views=self.views[kept], rows=self.rows[kept], images=images)


@dataclass(frozen=True, slots=True, eq=False)
class RigPoses:
    """Cameras on one flange, or in one base, that saw one board from the poses of one robot.

    Parameters
    ----------
    base_from_flange : Poses
        m of them, mm, as the robot states them; errors of each are shared by all images that were taken there.
    cameras : tuple of RigCamera
        c of them, each with a name of its own.
    names : tuple of str
        What each pose of the robot is called; ``pose 1`` … where none are given.
    where : str
        What they were read from.

    Raises
    ------
    InputError
        No camera, two of one name, or a row that is not there.
    """

    base_from_flange: Poses
    cameras: tuple[RigCamera, ...]
    names: tuple[str, ...] = ()
    where: str = "rig"

    def __post_init__(self):
        m = len(self.base_from_flange)
        names = tuple(self.names) or tuple(f"pose {i}" for i in range(1, m + 1))
        object.__setattr__(self, "names", names)
        if len(names) != m:
            raise InputError(
                "E-NAMES-COUNT", f"{self.where}: {len(names)} names of {m} poses of the robot; one each needed"
            )
        called = [camera.name for camera in self.cameras]
        if not called or len(set(called)) < len(called):
            raise InputError(
                "E-RIG-CAMERAS", f"{self.where}: cameras {', '.join(called) or '–'}; one or more, each of its own name"
            )
        for camera in self.cameras:
            if len(camera) and not (camera.rows.min() >= 0 and camera.rows.max() < m):
                raise InputError(
                    "E-RIG-ROW", f"{self.where}: camera {camera.name}: a row that none of {m} poses has; correct it"
                )

    def __len__(self) -> int:
        return len(self.base_from_flange)

    def only(self, rows: np.ndarray) -> "RigPoses":
        """With the images of these poses of the robot alone, (k,) int; all keep their numbers."""
        cameras = tuple(camera[np.isin(camera.rows, rows)] for camera in self.cameras)
        return replace(self, cameras=cameras)

    def pairs(self, i: int) -> HandEyePoses:
        """Pose pairs of one camera, the board's poses from each view by itself."""
        camera = self.cameras[i]
        where = f"{self.where}: camera {camera.name}"
        return pairs_of_views(self.base_from_flange[camera.rows], camera.views, camera.images, where)
