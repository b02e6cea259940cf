"""Hand-eye calibration of several cameras together, from images of one board: ``stcal handeye rig``."""

from dataclasses import replace
from functools import partial

from stcal.errors import DegenerateError, StcalError
from stcal.handeye.data.rig import RigPoses
from stcal.handeye.report.outcome import Outcome
from stcal.handeye.report.rig_outcome import RigOutcome
from stcal.handeye.rig.result import Rig
from stcal.handeye.rig.solve import RigOptions, alone_or_none, handeye_rig, of_places, same_numbering
from stcal.handeye.rig.validate import RigHeldOut, cross_validate_rig, widened_by_scatter
from stcal.handeye.validate import LEAST_LEFT, splits
from stcal.parallel import Progress
from stcal.workflows.handeye.calibrate import Splits
from stcal.workflows.handeye.rig_inputs import RigInput


def calibrate_rig(
    given: RigInput,
    refine: bool = False,
    with_scale: bool = False,
    validation: Splits | None = None,
    progress: Progress = lambda *_: None,
) -> RigOutcome:
    """Solve all cameras in one adjustment and each by itself, and compare both on held-out poses of the robot.

    Raises
    ------
    StcalError
        For the reasons given in :func:`stcal.handeye.handeye_rig`; the message also names what was left out before.
    """
    validation = validation or Splits()
    options = RigOptions(refine=refine, with_scale=with_scale, symmetries=given.symmetries)
    poses, setup = given.given, given.files.setup
    try:
        rig = handeye_rig(poses, setup, options)
    except StcalError as error:
        dropped = [
            (camera.name, *item)
            for camera, items in zip(given.files.cameras, given.left_out, strict=True)
            for item in items
        ]
        if dropped:
            error.append(f"; {len(dropped)} left out before, first {dropped[0][0]}: {dropped[0][1]}: {dropped[0][2]}")
        raise
    poses, options = same_numbering(poses, setup, given.symmetries), replace(options, symmetries=())
    notes, held_out, factor = given.notes, None, 1.0
    if validation.repeats and (validation.held_out or len(poses) > LEAST_LEFT):
        rows = splits(len(poses), validation.held_out, validation.repeats, validation.seed)
        done = partial(progress, "held out")
        try:
            held_out = cross_validate_rig(poses, setup, options, rows, validation.workers, done)
            rig, factor = widened_by_scatter(rig, held_out)
        except DegenerateError as error:
            notes += (f"no errors on poses held out: {error}",)
    by_itself = tuple(alone_or_none(poses, i, setup, options) for i in range(len(poses.cameras)))
    notes += of_places(rig.names, list(by_itself))
    cameras = tuple(_part(given, poses, rig, held_out, refine, i) for i in range(len(poses.cameras)))
    return RigOutcome(given.files.file.name, rig, cameras, by_itself, held_out, notes, given.understood, factor)


def _part(given: RigInput, poses: RigPoses, rig: Rig, held_out: RigHeldOut | None, refine: bool, i: int) -> Outcome:
    camera, result = poses.cameras[i], rig.cameras[i]
    own_sigmas = all(view.covariance is not None for view in camera.views.views)
    errors = None if held_out is None else held_out.cameras[i].poses()
    prior = camera.prior
    return Outcome(
        camera.name,
        result,
        errors,
        pitch_mm=given.pitch_mm,
        colmap_model=prior.colmap_model if refine and prior is not None else "",
        own_sigmas=bool(own_sigmas),
        left_out=given.left_out[i],
        pairs=poses.pairs(i),
        views=camera.views,
        folder=given.files.cameras[i].images,
    )
