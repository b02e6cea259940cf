"""Reduced normal equations of a group against the same in full, derivatives by differences."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.design import BoardDesign
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel, DotLabel
from stcal.sfm.adjust import equations
from stcal.sfm.adjust.equations import GroupPart, Setting
from stcal.synthetic.scene import SceneOptions, make_scene


@pytest.fixture(scope="module")
def group(labels_only):
    scene = make_scene(
        SceneOptions(seed=9, width=1296, height=864, images_per_group=3, groups=(("1", "2"), ("1", "4")))
    )
    observed = labels_only.observations(scene, 0.01, np.random.default_rng(2))
    return labels_only.models(scene, observed)[0], scene.camera


def test_weights_are_hubers_and_the_cost_is_theirs(group):
    """Weight 1 within the limit and limit/length beyond; the cost's derivative by a residual is 2 w r."""
    model, camera = group
    far = model.measured_px.copy()
    far[5] += [1.0, 0.0]
    model = replace(model, measured_px=far)
    length = np.linalg.norm(equations.normalised(model, camera), axis=1)
    weights = equations.robust_weights(model, camera, 4.0)
    assert weights[5] == pytest.approx(4 / length[5])
    assert (weights[length < 4] == 1).all()

    def cost(shift: float) -> float:
        changed = far.copy()
        changed[5, 0] += shift
        return equations.image_cost(replace(model, measured_px=changed), camera, 4.0)

    gradient = (cost(1e-4) - cost(-1e-4)) / 2e-4
    by_x = model.whiten(np.tile([1.0, 0.0], (len(far), 1)))[5]
    turned = tuple(Rigid.exp([np.pi, 0, 0, 0, 0, 0]) @ pose for pose in model.camera_from_model)
    assert equations.image_cost(replace(model, camera_from_model=turned), camera, 4.0) == np.inf  # behind them
    assert gradient == pytest.approx(2 * weights[5] * by_x @ equations.normalised(model, camera)[5], rel=1e-5)


def test_dots_off_their_design_cost_their_squares_over_sigma(group):
    model, camera = group
    (dot_rows,) = np.nonzero([isinstance(label, DotLabel) for label in model.labels])
    (circle_rows,) = np.nonzero([isinstance(label, CircleLabel) for label in model.labels])
    labels = tuple(model.labels[i] for i in circle_rows)

    def cost(off_mm: np.ndarray) -> float:
        own = GroupPart(
            model=model,
            model_from_board=Rigid(),
            design=model.xyz_model[dot_rows] + off_mm,
            dots=dot_rows,
            circles=circle_rows,
            cells=np.arange(len(dot_rows)),
            circle_place=np.arange(len(circle_rows)),
        )
        board = BoardDesign(10, 10, 20.0, 5.0, "bright", sigma_mm=0.02)
        setting = Setting((own,), labels, board, 0.0, np.inf, camera, np.zeros((16, 0)), np.zeros((0, 0)), np.inf)
        values = setting.values(model.xyz_model[circle_rows], camera)
        return setting.joined(values).cost(values)

    off = np.random.default_rng(0).normal(0, 0.05, (len(dot_rows), 3))
    assert cost(off) - cost(0 * off) == pytest.approx((off**2).sum() / 0.02**2, rel=1e-6)
