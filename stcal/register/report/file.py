"""What a registration found, for programs: the keys of ``data_layout.md``."""

from dataclasses import asdict

import numpy as np

from stcal.geometry.affine import Affine
from stcal.geometry.rigid import Rigid
from stcal.register.core.models import Transform, parts
from stcal.register.core.result import ErrorFigures, HeldOut
from stcal.register.workspace.findings import Findings

FORMAT = "stcal registration 1"
NAMES = {
    6: ("rx", "ry", "rz", "x", "y", "z"),
    7: ("rx", "ry", "rz", "x", "y", "z", "scale"),
    12: tuple(f"m{row}{column}" for row in "123" for column in "1234"),
}
UNIT = {"r": "rad", "s": "1", "m": "1"}
GRID = 7
"""Places along each side of the grid of the field, over the box of the points and …"""
MARGIN = 0.25
"""… so much of its sides beyond it."""


def matrix_of(transform: Transform) -> np.ndarray:
    """(4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = parts(transform)
    return whole


def registration_json(found: Findings) -> dict:
    """Everything; lengths in mm, angles in rad."""
    result = found.registration
    names = NAMES[len(result.covariance)]
    content = {
        "format": FORMAT,
        "pairs": found.where,
        "model": result.model,
        "method": result.method,
        "b_from_a": matrix_of(result.b_from_a).tolist(),
        "covariance": result.covariance.tolist(),
        "covariance_of": list(names),
        "units": {
            "b_from_a": "mm",
            "residuals": "mm",
            "covariance": ["mm" if n in "xyz" or n.endswith("4") else UNIT[n[0]] for n in names],
        },
        **_transform(result.b_from_a),
        "sigma_mm": result.sigma_mm,
        "dof": result.redundancy if np.isfinite(result.redundancy) else None,
        "sigma_factor": result.sigma_factor,
        "scaled": result.scaled,
        "threshold_mm": result.threshold_mm,
        **_figures(result.inlier_errors),
        "held_out": None if result.held_out is None else _held_out(found, result.held_out),
        "ambiguous": bool(result.ambiguous),
        "alternative": None,
        "notes": list(result.notes),
        "seed": result.seed,
        "samples": result.samples,
        "lines": [int(line) for line in found.lines],
        "inliers": result.inliers.tolist(),
        "residuals": result.residuals.tolist(),
        "outliers": [_outlier(found, row) for row in result.outliers],
        "field": None if found.field is None else _field(found),
        "cubes": None if found.cubes is None else _cubes(found),
    }
    other = result.alternative
    if other is not None:
        content["alternative"] = {
            "b_from_a": matrix_of(other.b_from_a).tolist(),
            "lines": [int(found.lines[i]) for i in other.rows],
            "apart_mm": other.apart_mm,
            "turn_rad": other.turn_rad,
        }
    return content


def _transform(transform: Transform) -> dict:
    """What the matrix hides: scale of a similarity, shear and scales of an affine transform."""
    if isinstance(transform, Rigid):
        return {}
    if isinstance(transform, Affine):
        return {"scales": np.linalg.svd(transform.linear, compute_uv=False).tolist()}
    return {"scale": transform.scale}


def _held_out(found: Findings, held: HeldOut) -> dict:
    return {
        "folds": held.folds,
        "inliers": _figures(held.of_inliers),
        "all": _figures(held.of_all),
        "lines": [int(found.lines[i]) for i in held.rows],
        "error_mm": held.error_mm.tolist(),
    }


def _outlier(found: Findings, row: int) -> dict:
    residual = found.registration.residuals[row]
    return {
        "line": int(found.lines[row]),
        "residual_mm": residual.tolist(),
        "length_mm": float(np.linalg.norm(residual)),
    }


def _field(found: Findings) -> dict:
    field = found.field
    grid = grid_of(found)
    error, covariance = field.at(grid)
    return {
        "seen": field.seen,
        "p_value": field.p_value,
        "length_mm": field.length_mm,
        "size_mm": field.size_mm,
        "noise_mm": field.noise_mm,
        "points": len(field.rows),
        "taken_back_lines": [int(found.lines[i]) for i in field.taken_back],
        "left_out": {
            "transform": _figures(ErrorFigures.of(field.plain_mm)),
            "transform_and_field": _figures(ErrorFigures.of(field.corrected_mm)),
            "sigma_ratio": field.sigma_ratio,
        },
        "grid": {
            "xyz_a_mm": grid.tolist(),
            "error_mm": error.tolist(),
            "sigma_mm": np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3).tolist(),
        },
    }


def grid_of(found: Findings) -> np.ndarray:
    """(g, 3) places in and around the points used, frame a, mm."""
    own = found.xyz_a[found.field.rows]
    low, high = own.min(0), own.max(0)
    side = MARGIN * (high - low)
    axes = [np.linspace(a, b, GRID) if b > a else [a] for a, b in zip(low - side, high + side, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _cubes(found: Findings) -> dict:
    reach = found.cubes
    return {
        "middle_a_mm": reach.middle.tolist(),
        "sides_mm": reach.sides_mm.tolist(),
        "fitted_in": [
            {
                "side_mm": float(side),
                "errors": [None if e is None else asdict(e) for e in row],
            }
            for side, row in zip(reach.sides_mm, reach.errors, strict=True)
        ],
    }


def _figures(errors: ErrorFigures) -> dict:
    return {name: _or_none(getattr(errors, name)) for name in ("mean_mm", "rms_mm", "max_mm")}


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
