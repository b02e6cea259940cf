"""Normal equations of hand-eye adjustments against central differences."""

from collections.abc import Iterable

import numpy as np

from stcal.handeye.methods.equations import Equations


def dense(equations: Equations) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of all unknowns, the kept ones first."""
    s, k = len(equations.gradient), len(equations.block)
    normal = np.zeros((s + 3 * k, s + 3 * k))
    normal[:s, :s] = equations.normal
    for i, block in enumerate(equations.block):
        at = slice(s + 3 * i, s + 3 * i + 3)
        normal[at, at] = block
    if equations.cross is not None:
        mixed = equations.cross.reshape(3 * k, s)
        normal[s:, :s], normal[:s, s:] = mixed, mixed.T
    return normal, np.concatenate([equations.gradient, equations.slope.ravel()])


def assert_derivatives(problem, state, unknowns: Iterable[int]) -> None:
    """Where all residuals are zero, the gradient changes with an unknown by that column of the normal matrix, if the
    derivatives in both are those of the residuals."""
    normals = {name: dense(part.equations)[0] for name, part in problem.parts(state).items()}
    for k in unknowns:
        step = np.zeros(problem.places()["board"].stop)
        step[k] = 1e-5
        ahead, behind = (problem.parts(problem.moved(state, sign * step)) for sign in (1, -1))
        for name, normal in normals.items():
            change = (dense(ahead[name].equations)[1] - dense(behind[name].equations)[1]) / 2e-5
            assert np.abs(change - normal[:, k]).max() <= 1e-5 * max(np.abs(normal[:, k]).max(), 1), (name, k)
