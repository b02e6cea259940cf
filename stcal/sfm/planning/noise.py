"""The σ of centres that a plan is forecast with, and in words where it comes from."""

from stcal.sfm.planning.advise import known_of
from stcal.sfm.planning.forecast import BLUR_PX, CONTRAST, IMAGE_NOISE, PRACTICE, CentreNoise
from stcal.sfm.runs.saved import SavedRun


def stated_noise(sigma_px: float) -> tuple[CentreNoise, str]:
    """The same for every circle."""
    return CentreNoise(0.0, floor_px=sigma_px), "--noise, whatever the size of a circle"


def noise_of_run(run: SavedRun) -> tuple[CentreNoise, str]:
    """By size and tilt, as a run found it."""
    known = known_of(run)
    return known.noise.scaled(known.setup.sigma0), f"by size and tilt as in {run.folder}"


def expected_noise() -> tuple[CentreNoise, str]:
    """Of good photographs."""
    return CentreNoise.expected(), (
        f"image noise {100 * IMAGE_NOISE:g} % and contrast {100 * CONTRAST:g} % of full scale, edges "
        f"blurred by {BLUR_PX:g} px, {PRACTICE:g} × the Cramér–Rao bound (--noise, --run)"
    )
