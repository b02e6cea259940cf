"""The σ of centres that a plan is forecast with, and a text on where it comes from."""

from stcal.sfm.planning.advise import known_of
from stcal.sfm.planning.forecast import BLUR_PX, CONTRAST, IMAGE_NOISE, PRACTICE, CentreNoise
from stcal.sfm.runs.saved import SavedRun


def stated_noise(sigma_px: float) -> tuple[CentreNoise, str]:
    """Returns the same σ for every circle and corner."""
    return CentreNoise(0.0, floor_px=sigma_px, corner_px=sigma_px), "--noise, whatever the size of a circle"


def noise_of_run(run: SavedRun) -> tuple[CentreNoise, str]:
    """Returns σ by size and tilt of the circles, as estimated from a run."""
    known = known_of(run)
    return known.noise.scaled(known.setup.sigma0), f"by size and tilt as in {run.folder}"


def expected_noise(of_corners: bool = False) -> tuple[CentreNoise, str]:
    """Returns the σ to expect in good photographs; ``of_corners`` : of tags and squares, not of circles."""
    if of_corners:
        return CentreNoise.expected(), "what corners of tags have in rendered photographs (--noise, --run)"
    return CentreNoise.expected(), (
        f"image noise {100 * IMAGE_NOISE:g} % and contrast {100 * CONTRAST:g} % of full scale, edges "
        f"blurred by {BLUR_PX:g} px, {PRACTICE:g} × the Cramér–Rao bound (--noise, --run)"
    )
