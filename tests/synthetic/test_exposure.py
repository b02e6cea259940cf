"""Photographs exposed again."""

import numpy as np
import pytest

from stcal.synthetic.optics import Light, Sensor, expose, lit, moved
from tests.outcome import fails_with

RAMP = np.tile(np.linspace(20, 200, 300).astype(np.uint8), (200, 1))


def test_brightness_follows_time_through_the_response():
    once, twice = expose(RAMP, [1.0, 0.5], Sensor(gamma=1.0))
    assert np.abs(once.astype(float).mean(0) - RAMP[0]).max() < 1.5
    assert np.abs(twice.astype(float).mean(0) - RAMP[0] / 2).max() < 1.5
    half = expose(RAMP, [0.5], Sensor(gamma=2.2))[0]
    assert np.abs(half.astype(float).mean(0) - RAMP[0] * 0.5 ** (1 / 2.2)).max() < 1.5


def test_saturation_and_noise():
    sensor = Sensor(full_well=2000.0, read_noise=20.0)
    grey = np.full((300, 300), 128, np.uint8)
    dark, normal, bright = expose(grey, [0.1, 1.0, 4.0], sensor)
    assert (bright == 255).all()
    # 1000 electrons: shot noise √1000, read noise 20, and steps of grey in the photograph (1/√12 of 7.8 electrons)
    electrons = np.array([1000 * 0.1, 1000.0])
    expected = np.sqrt(electrons + 400 + (np.array([0.1, 1]) * 7.8) ** 2 / 12) / 2000 * 255
    assert normal.std() == pytest.approx(expected[1], rel=0.05)
    assert dark.std() == pytest.approx(expected[0], rel=0.05)


def test_light_falls_off_and_glares():
    scene = np.full((100, 200), 0.25)
    graded = lit(scene, Light(stops=2.0, pivot=(0.5, 0.25)))
    assert graded[50, 100] == pytest.approx(0.25, rel=1e-3)
    assert graded[50, 199] / graded[50, 0] == pytest.approx(4, rel=0.02)
    spot = lit(scene, Light(glare=1.0, glare_at=(0.25, 0.25), glare_radius=0.05))
    assert spot[50, 50] == pytest.approx(1.25, rel=1e-3)
    assert spot[50, 150] == pytest.approx(0.25, rel=1e-3)


def test_the_same_seed_gives_the_same_images():
    assert (expose(RAMP, [1.0], seed=3)[0] == expose(RAMP, [1.0], seed=3)[0]).all()
    assert (expose(RAMP, [1.0], seed=3)[0] != expose(RAMP, [1.0], seed=4)[0]).any()


def test_deep_images():
    deep = expose(RAMP, [1.0], Sensor(bits=16))[0]
    assert deep.dtype == np.uint16
    assert deep.max() > 255 * 150


def test_a_shift():
    assert (moved(RAMP, (5, 0))[:, 10:] == RAMP[:, 5:-5]).all()


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: expose(RAMP.astype(float), [1.0]), "E-IMAGE-TYPE"),
        (lambda: expose(RAMP, [0.0]), "E-EXPOSURES-VALUE"),
        (lambda: Sensor(gamma=0), "E-SIMULATE-OPTIONS"),
    ],
)
def test_what_cannot_be_exposed(call, reason):
    with fails_with(reason):
        call()
