"""All that a hand-eye calibration found, and its file."""

from dataclasses import dataclass

import numpy as np

import stcal
from stcal.handeye.data.loop import FRAMES
from stcal.handeye.judge.observability import Observability
from stcal.handeye.result import HandEye
from stcal.handeye.validate import Compared, HeldOut
from stcal.io.camera import PARAMETER_NAMES, parameter_names


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibration as it is reported.

    Parameters
    ----------
    where : str
        What it was made from.
    result : HandEye
    held_out : HeldOut, optional
        Errors of its method on poses held out.
    compared : tuple of Compared
        Every method, where that was asked for.
    pitch_mm : float, optional
        Of dots or squares, as the board's file states it.
    colmap_model : str
        Of the camera whose intrinsics were solved for.
    own_sigmas : bool
        Whether corners came with covariances, of which the result's ``corner_px`` is the factor.
    left_out : tuple of (str, str)
        Images and rows that did not take part, and why.
    notes : tuple of str
        Besides those of the result.
    """

    where: str
    result: HandEye
    held_out: HeldOut | None = None
    compared: tuple[Compared, ...] = ()
    pitch_mm: float | None = None
    colmap_model: str = ""
    own_sigmas: bool = False
    left_out: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    def all_notes(self) -> tuple[str, ...]:
        """Of the result, then the others."""
        return (*self.result.notes, *self.notes)

    def outliers(self) -> tuple[str, ...]:
        """Names of the poses that contradict the others."""
        return tuple(name for name, bad in zip(self.result.names, self.result.outliers, strict=True) if bad)


def outcome_json(outcome: Outcome) -> dict:
    """:func:`calibration_json`, with every split, and every method where they were compared."""
    names = outcome.result.names
    more = {"splits": _splits(outcome.held_out, names), "methods": [_method(each, names) for each in outcome.compared]}
    return calibration_json(outcome) | more


def calibration_json(outcome: Outcome) -> dict:
    """The result as plain values (form: ``data_layout.md``): mm, rad, px; None where there is no value."""
    result, frames = outcome.result, FRAMES[outcome.result.setup]
    return {
        "format": "stcal handeye 1",
        "version": stcal.__version__,
        "from": outcome.where,
        "setup": result.setup,
        "method": result.method,
        frames.camera: result.mount_from_camera.matrix().tolist(),
        "covariance": _listed(result.covariance),
        frames.board: result.stand_from_board.matrix().tolist(),
        f"{frames.board}_covariance": _listed(result.stand_covariance),
        "board": {
            "scale": float(result.scale),
            "scale_sigma": _plain(result.sigma_scale),
            "pitch_mm": None if outcome.pitch_mm is None else float(outcome.pitch_mm * result.scale),
        },
        "camera": _camera(outcome),
        "sigma": {name: float(value) for name, value in result.sigma.items()},
        "estimated": list(result.estimated),
        "corner_px_is_factor": outcome.own_sigmas,
        "rms": dict(zip(("rotation_rad", "translation_mm"), result.rms(), strict=True)),
        "poses": _poses(result),
        "outliers": list(outcome.outliers()),
        "left_out": [{"name": name, "reason": reason} for name, reason in outcome.left_out],
        "held_out": _held_out(outcome.held_out, outcome.result.outliers),
        "observability": _observability(result.observability),
        "notes": list(outcome.all_notes()),
    }


def _listed(values: np.ndarray | None) -> list | None:
    return None if values is None else np.asarray(values).tolist()


def _plain(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def _camera(outcome: Outcome) -> dict | None:
    found = outcome.result.reprojection
    if found is None or found.camera_covariance is None:
        return None
    names, sigma = parameter_names(outcome.colmap_model), np.sqrt(np.diag(found.camera_covariance))
    return {
        "model": outcome.colmap_model,
        "parameters": dict(zip(PARAMETER_NAMES, found.camera.parameters().tolist(), strict=True)),
        "sigma": dict(zip(names, sigma.tolist(), strict=True)),
    }


def _poses(result: HandEye) -> list[dict]:
    rows = []
    for i, (name, off) in enumerate(zip(result.names, result.residuals, strict=True)):
        row = {
            "name": name,
            "used": not bool(result.outliers[i]),
            "rotation_rad": off[:3].tolist(),
            "translation_mm": off[3:].tolist(),
        }
        if result.reprojection is not None:
            row["corner_rms_px"] = _plain(result.reprojection.rms_px(i))
        rows.append(row)
    return rows


def _held_out(found: HeldOut | None, outliers: np.ndarray) -> dict | None:
    if found is None:
        return None
    whole = {"splits": found.rows.shape[0], "poses": found.rows.shape[1], **found.means()}
    return whole | {"agreeing": (found.means(~outliers) or None) if outliers.any() else None}


def _splits(found: HeldOut | None, names: tuple[str, ...]) -> list[dict]:
    """Of each split the poses held out, and the errors on each."""
    if found is None:
        return []
    kinds = found.means()
    return [
        {"poses": [names[i] for i in row], **{kind: getattr(found, kind)[k].tolist() for kind in kinds}}
        for k, row in enumerate(found.rows)
    ]


def _method(each: Compared, names: tuple[str, ...]) -> dict:
    bad = np.zeros(len(names), bool) if each.result is None else each.result.outliers
    row = {"method": each.method, "reason": each.reason or None, "held_out": _held_out(each.held_out, bad)}
    if each.result is not None:
        row |= {name: pose.matrix().tolist() for name, pose in each.result.transforms.items()}
    return row | {"splits": _splits(each.held_out, names)}


def _observability(seen: Observability | None) -> dict | None:
    if seen is None:
        return None
    return {
        "turns_rad": seen.turns_rad.tolist(),
        "axes_flange": seen.axes.tolist(),
        "sigma_rad": _plain(seen.sigma_rad),
        "sigma_mm": _plain(seen.sigma_mm),
    }
