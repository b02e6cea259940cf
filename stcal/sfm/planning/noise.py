"""The σ of centres that a plan is forecast with, and a text on where it comes from."""

from stcal.geometry.arrays import require_arguments
from stcal.sfm.planning.advise import known_of
from stcal.sfm.planning.forecast import BLUR_PX, CONTRAST, IMAGE_NOISE, PRACTICE, CentreNoise
from stcal.sfm.runs.saved import AnyRun, saved_run


def stated_noise(sigma_px: float) -> tuple[CentreNoise, str]:
    """Returns the same σ for every circle and corner."""
    return CentreNoise(0.0, floor_px=sigma_px, corner_px=sigma_px), "--noise, whatever the size of a circle"


@require_arguments
def noise_of_run(run: AnyRun) -> CentreNoise:
    """Returns the noise of centres by size and tilt of the circles, as estimated from a run.

    Parameters
    ----------
    run : str, Path, SavedRun or RunResult
        The run's folder, or what :func:`stcal.sfm.load_run` or :func:`stcal.sfm.run` returned.

    Returns
    -------
    CentreNoise
        As :class:`stcal.sfm.PlanOptions` takes it.
    """
    known = known_of(saved_run(run))
    return known.noise.scaled(known.setup.sigma0)


def expected_noise(of_corners: bool = False) -> tuple[CentreNoise, str]:
    """Returns the σ to expect in good photographs; ``of_corners`` : of tags and squares, not of circles."""
    if of_corners:
        return CentreNoise.expected(), "what corners of tags have in rendered photographs (--noise, --run)"
    return CentreNoise.expected(), (
        f"image noise {100 * IMAGE_NOISE:g} % and contrast {100 * CONTRAST:g} % of full scale, edges "
        f"blurred by {BLUR_PX:g} px, {PRACTICE:g} × the Cramér–Rao bound (--noise, --run)"
    )
