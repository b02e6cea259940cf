"""Normal equations without the board's corners are those of all unknowns, eliminated."""

import numpy as np
import pytest

from stcal.geometry.least_squares import NormalEquations
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.variances import Parts
from stcal.handeye.methods.equations import Components, Equations, Part
from tests.handeye.derivatives import dense

KEPT, CORNERS = 7, 5


def drawn(rng, with_cross=True) -> Equations:
    jacobian = rng.normal(size=(40, KEPT))
    by_corner = rng.normal(size=(40, 3))
    corner, residual = np.arange(40) % CORNERS, rng.normal(size=40)
    block, slope, cross = np.zeros((CORNERS, 3, 3)), np.zeros((CORNERS, 3)), np.zeros((CORNERS, 3, KEPT))
    np.add.at(block, corner, by_corner[:, :, None] * by_corner[:, None])
    np.add.at(slope, corner, by_corner * residual[:, None])
    np.add.at(cross, corner, by_corner[:, :, None] * jacobian[:, None])
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    return Equations(float(residual @ residual), normal, gradient, block, slope, cross if with_cross else None)


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_a_step_is_that_of_all_unknowns(damping):
    equations = drawn(np.random.default_rng(0))
    normal, gradient = dense(equations)
    step, gain = equations.step(damping)
    whole, whole_gain = NormalEquations(equations.cost, normal, gradient).step(damping)
    np.testing.assert_allclose(step, whole, rtol=1e-9)
    assert gain == pytest.approx(whole_gain, rel=1e-9)
    np.testing.assert_allclose(equations.inverse(), generalised_inverse(normal)[:KEPT, :KEPT], rtol=1e-8)
    assert equations.gain() == pytest.approx(gradient @ np.linalg.solve(normal, gradient), rel=1e-9)


def test_the_likelihood_of_sigma_is_that_of_all_unknowns():
    rng = np.random.default_rng(1)
    parts, fixed = [Part(40, drawn(rng)), Part(40, drawn(rng, with_cross=False))], drawn(rng)
    whole = []
    for equations in (*(part.equations for part in parts), fixed):
        normal, gradient = dense(equations)
        whole.append(NormalEquations(equations.cost, normal, gradient))
    x, caution = np.array([0.3, -0.2]), np.array([2.0, 0.0])
    value, slope = Components(parts, fixed, caution, 1e-10).at(x)
    expected = Parts(NormalEquations.stacked(whole[:2]), np.array([40, 40]), whole[2], caution=caution, held=1e-10)
    expected_value, expected_slope, _, _ = expected.at(x[None])
    assert value == pytest.approx(expected_value[0], rel=1e-9)
    np.testing.assert_allclose(slope, expected_slope[0], rtol=1e-9)
