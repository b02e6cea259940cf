"""Result of every hand-eye method."""

from dataclasses import dataclass, field, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pose_pairs import FRAMES, Setup, rms_of
from stcal.handeye.judge.observable import Observability
from stcal.handeye.judge.remarks import Verdict
from stcal.handeye.methods.reprojection import Reprojection


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HandEye(Brief):
    """A hand-eye calibration from m pose pairs.

    Parameters
    ----------
    method : name of the method, one of :data:`~stcal.handeye.METHODS`
    setup : ``eye-in-hand`` or ``eye-to-hand``
    mount_from_camera, stand_from_board : the two unknowns, mm; see :attr:`transforms`
    residuals : (m, 6), deviation of each pose's chain from ``stand_from_board``: rotation vector (rad), and translation
        (mm) at the board's origin, in the axes of the stand
    names : names of the poses
    outliers : (m,) bool, poses that were left out of the solution because they contradict the others
    covariance, stand_covariance : (6, 6), covariances of ``mount_from_camera`` and ``stand_from_board``: rotation
        (rad), translation (mm), left perturbation. None if the method gives no covariance.
    scale : the board's true size over its stated size, if it was solved for; else 1
    sigma_scale : σ of the scale
    sigma : σ by which poses or corners were weighted, if the method weights: ``robot_rad``, ``robot_mm``,
        ``camera_rad``, ``camera_mm``, ``corner_px``, ``board_mm``. ``camera_factor`` is the factor on the σ that were
        stated with camera_from_board. ``camera_focal``, ``camera_centre``, ``camera_radial``, ``camera_tangential``
        (``camera_all`` if their covariance is stated) are the factors, 1 or more, by which the σ of the stated
        intrinsics were widened.
    estimated : keys of ``sigma`` that were estimated from the residuals
    reprojection : adjusted camera, board and robot, if corners were adjusted
    observability : what the poses determine
    notes : notes on the result, one line each
    common_covariance : (6, 6), part of ``covariance`` that comes from what the errors of the board's poses have in
        common, where that is stated; more poses do not make it smaller
    judgement : whether to use the result; None of a single method's solution, which was not judged. See
        :attr:`verdict`.
    """

    method: str
    setup: Setup
    mount_from_camera: Rigid
    stand_from_board: Rigid
    residuals: np.ndarray
    names: tuple[str, ...]
    outliers: np.ndarray
    covariance: np.ndarray | None = None
    stand_covariance: np.ndarray | None = None
    scale: float = 1.0
    sigma_scale: float | None = None
    sigma: dict[str, float] = field(default_factory=dict)
    estimated: tuple[str, ...] = ()
    reprojection: Reprojection | None = None
    observability: Observability | None = None
    notes: tuple[str, ...] = ()
    common_covariance: np.ndarray | None = None
    judgement: Verdict | None = None

    def __post_init__(self):
        m = len(self.names)
        freeze(self, "residuals", (m, 6), "residuals")
        freeze(self, "outliers", (m,), "outliers", bool)
        for name in ("covariance", "stand_covariance", "common_covariance"):
            if getattr(self, name) is not None:
                freeze(self, name, (6, 6), name)

    @property
    def verdict(self) -> Verdict:
        """Whether to use the result: its ``word`` is ``good``, ``use with care`` or ``do not use``.

        ``sentence()`` adds the reasons, ``remedies()`` what to do. Raises InputError if nobody judged the result.
        """
        if self.judgement is None:
            said = f"hand-eye: the solution of {self.method} alone has no verdict"
            raise InputError("E-HANDEYE-NOT-JUDGED", f"{said}; handeye.handeye judges what it returns")
        return self.judgement

    @property
    def transforms(self) -> dict[str, Rigid]:
        """``flange_from_camera`` and ``base_from_board``, or ``base_from_camera`` and ``flange_from_board``."""
        frames = FRAMES[self.setup]
        return {frames.camera: self.mount_from_camera, frames.board: self.stand_from_board}

    @property
    def flange_from_camera(self) -> Rigid:
        """The transform flange_from_camera of the eye-in-hand setup; raises InputError in the other setup."""
        return self._named("flange_from_camera")

    @property
    def base_from_camera(self) -> Rigid:
        """The transform base_from_camera of the eye-to-hand setup; raises InputError in the other setup."""
        return self._named("base_from_camera")

    def _named(self, name: str) -> Rigid:
        if name not in self.transforms:
            said = f"hand-eye: {self.setup} has no {name}; it has {' and '.join(self.transforms)}"
            raise InputError("E-HANDEYE-NO-TRANSFORM", said)
        return self.transforms[name]

    def widened(self, factor: float) -> "HandEye":
        """Returns the result with all σ of the two unknowns multiplied by ``factor``."""
        if self.covariance is None or self.stand_covariance is None:
            return self
        square = factor**2
        return replace(self, covariance=square * self.covariance, stand_covariance=square * self.stand_covariance)

    def rms(self) -> tuple[float, float]:
        """Returns the RMS lengths of the residuals of all poses except outliers: rad, mm."""
        return rms_of(self.residuals[~self.outliers])
