"""The final adjustment of a finished run, repeated from its folder for what its files do not hold."""

from dataclasses import dataclass

from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraPrior, camera_prior
from stcal.labels import circle_labels
from stcal.sfm.adjust.calibration import with_sigma
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.joint import Adjusted, adjusted
from stcal.sfm.mapping.database import image_ids
from stcal.sfm.mapping.models import read_model
from stcal.sfm.runs.saved import SavedRun


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedRun:
    """The final adjustment of a run.

    ``state`` : groups in mm in the target frame, at the minimum, with σ as in the run; ``start`` : result of the run;
    ``prior`` : of the intrinsics if they were adjusted.
    """

    state: Adjusted
    start: CalibratedTarget
    prior: CameraPrior | None


def adjusted_run(run: SavedRun) -> AdjustedRun:
    """Repeats the final adjustment of a run, which moves nothing.

    Raises
    ------
    InputError
        The run's ``target_model`` is missing or damaged.
    ConvergenceError
        The adjustment finds no minimum.
    """
    read = read_model(run.folder / "target_model", run.observations, image_ids(run.observations), run.corrected_px)
    models = [with_sigma(model, run.report["summary"]["sigma_factor"]) for model in read.in_mm()]
    start = CalibratedTarget(
        run.faces.reference_face,
        run.faces.poses(),
        dict(zip(circle_labels(run.faces.circles), run.faces.circles.values(), strict=True)),
        {model.group: Rigid() for model in models},
    )
    prior = camera_prior(run.camera) if run.options.refine_camera else None
    state = adjusted(models, run.board, run.camera, run.options.flatness_mm, prior, read.camera)
    return AdjustedRun(state, start, prior)
