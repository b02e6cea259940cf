"""Photographs exposed again."""

import numpy as np
import pytest

from stcal.synthetic.optics import FULL_WELL, READ_NOISE, Light, expose
from tests.outcome import refuses

RAMP = np.tile(np.linspace(20, 200, 300).astype(np.uint8), (200, 1))


def test_brightness_follows_time():
    once, twice = expose(RAMP, [1.0, 0.5])
    assert np.abs(once.astype(float).mean(0) - RAMP[0]).max() < 1.5
    assert np.abs(twice.astype(float).mean(0) - RAMP[0] / 2).max() < 1.5


def test_saturation_and_noise():
    grey = np.full((300, 300), 128, np.uint8)
    dark, normal, bright = expose(grey, [0.1, 1.0, 4.0])
    assert (bright == 255).all()
    # Shot noise, read noise, and the steps of grey in the photograph (1/√12 of a grey level) and in the exposure.
    time, level = np.array([0.1, 1.0]), FULL_WELL / 256
    variance = FULL_WELL / 2 * time + READ_NOISE**2 + (time * level) ** 2 / 12 + level**2 / 12
    expected = np.sqrt(variance) / FULL_WELL * 255
    assert normal.std() == pytest.approx(expected[1], rel=0.05)
    assert dark.std() == pytest.approx(expected[0], rel=0.05)


def test_light_falls_off_and_glares():
    photograph = np.full((400, 200), 64, np.uint8)
    (graded,) = expose(photograph, [1.0], Light(stops=2.0))
    columns = graded.mean(0)  # noise of a grey level, of 400 rows
    assert columns[100] == pytest.approx(64.5 * 255 / 256, rel=0.005)
    assert columns[199] / columns[0] == pytest.approx(4, rel=0.02)
    (spot,) = expose(photograph, [1.0], Light(glare=0.5, glare_at=(0.25, 1.0), glare_radius=0.1))
    near = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 20.0**2)).mean() ** 2  # of the Gaussian's peak, over 11 × 11 px
    assert spot[195:206, 45:56].mean() - columns[100] == pytest.approx(127.5 * near, rel=0.01)
    assert spot[195:206, 145:156].mean() == pytest.approx(columns[100], rel=0.005)


def test_the_same_seed_gives_the_same_images_and_what_cannot_be_exposed_is_refused():
    first, again, other = (expose(RAMP, [1.0], seed=seed)[0] for seed in (3, 3, 4))
    assert (first == again).all()
    assert (first != other).any()
    refuses("E-IMAGE-TYPE", expose, RAMP.astype(float), [1.0])
    refuses("E-EXPOSURES-VALUE", expose, RAMP, [0.0])
