"""How much robot and camera err: stated, or estimated from the residuals as variance components."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.handeye.leastsq import generalised_inverse
from stcal.handeye.loop import Loop

ROUNDS = 500
SETTLED = 1e-6
LEAST_RAD, LEAST_MM = 1e-9, 1e-6
"""Estimates stay above: exact data have none."""


@dataclass(frozen=True, slots=True)
class Noise:
    """σ of one coordinate; None where it is not known and to be estimated from the residuals, 0 for what is exact.

    Parameters
    ----------
    robot_rad, robot_mm : float, optional
        Of base_from_flange, in the axes of the base, about the flange.
    camera_rad, camera_mm : float, optional
        Of camera_from_board, about the board's origin. From poses alone the errors of two sides cannot be told apart
        well: if nothing is known of either, the robot is taken to be exact, and what is estimated holds both.
    corner_px : float, optional
        Of a corner in the image, or the factor of the stated covariances of corners. Never 0.
    board_mm : float, optional
        Of a corner's place on the board.
    """

    robot_rad: float | None = None
    robot_mm: float | None = None
    camera_rad: float | None = None
    camera_mm: float | None = None
    corner_px: float | None = None
    board_mm: float | None = None

    def __post_init__(self):
        for side in ("robot", "camera"):
            pair = getattr(self, f"{side}_rad"), getattr(self, f"{side}_mm")
            if (pair[0] is None) != (pair[1] is None):
                raise InputError(f"noise: one of σ_rot and σ_trans of the {side} is given; both or none needed")
            if pair[0] is not None and not (np.isfinite(pair).all() and min(pair) >= 0):
                raise InputError(f"noise: σ of the {side} is {pair[0]:g} rad, {pair[1]:g} mm; not negative needed")
        for name, least in (("corner_px", 1e-9), ("board_mm", 0.0)):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value >= least):
                raise InputError(f"noise: {name} is {value:g}, {'more than 0' if least else 'not negative'} needed")
        if self.robot_rad is not None and not self.robot_rad + (self.camera_rad if self.camera_rad is not None else 1):
            raise InputError("noise: σ_rot of robot and camera are both 0; one of them must err")


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Covariances of a loop's residuals, (m, 6, 6): ``known``, and each of ``free``, (2, m, 6, 6), times a variance.

    ``side`` : ``camera`` or ``robot``, whose the free ones are; empty where all is known.
    """

    known: np.ndarray
    free: np.ndarray
    side: str

    def total(self, variances: np.ndarray) -> np.ndarray:
        """(m, 6, 6)."""
        return self.known + np.tensordot(variances, self.free, 1) if self.side else self.known

    def of(self, used: np.ndarray) -> "Components":
        """Of some poses."""
        return Components(self.known[used], self.free[:, used], self.side)


def components(loop: Loop, noise: Noise, mount_from_camera: Rigid, scale: float = 1.0) -> Components:
    """At an estimate of X, on which arms of levers depend."""
    by = {"robot": loop.by_robot(mount_from_camera, scale), "camera": loop.by_camera(mount_from_camera, scale)}
    stated = {
        "robot": _stated(len(loop), loop.robot_covariance, noise.robot_rad, noise.robot_mm),
        "camera": _stated(len(loop), loop.camera_covariance, noise.camera_rad, noise.camera_mm),
    }
    known = sum(
        (by[s] @ stated[s] @ np.swapaxes(by[s], 1, 2) for s in by if stated[s] is not None), np.zeros_like(by["camera"])
    )
    side = next((s for s in ("camera", "robot") if stated[s] is None), "")
    if not side:
        return Components(known, np.zeros((0, *known.shape)), "")
    parts = [by[side][:, :, :3], by[side][:, :, 3:]]
    return Components(known, np.array([p @ np.swapaxes(p, 1, 2) for p in parts]), side)


def _stated(m: int, covariance: np.ndarray | None, rad: float | None, mm: float | None) -> np.ndarray | None:
    """The covariances of the poses where they have any, else of one σ for all."""
    if covariance is not None:
        return covariance
    if rad is None:
        return None
    return np.tile(np.diag([rad**2] * 3 + [mm**2] * 3), (m, 1, 1))


def first_variances(residuals: np.ndarray) -> np.ndarray:
    """Of rotation and translation, (2,), from the medians of residuals (m, 6): bad poses do not count."""
    squared = np.median((residuals.reshape(-1, 2, 3) ** 2).sum(2), axis=0) / chi2.ppf(0.5, 3)
    return np.maximum(squared, [LEAST_RAD**2, LEAST_MM**2])


def variance_components(parts: Components, residuals: np.ndarray, slope: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Restricted maximum-likelihood variances (2,) of the free components, from residuals (m, 6) at a solution.

    ``slope`` : (m, 6, k) derivative of the residuals by the parameters solved for. The fixed point of Zhou, Hu, Qiao &
    Cho (2019), *MM algorithms for variance components models*, which never leaves the positive and always gains.
    """
    theta, least = first, np.array([LEAST_RAD**2, LEAST_MM**2])
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(parts.total(theta))
        weighted = inverse @ slope
        covariance = generalised_inverse(np.einsum("mai,maj->ij", slope, weighted))
        fitted = np.einsum("mab,mb->ma", inverse, residuals)
        hit = np.einsum("ma,kmab,mb->k", fitted, parts.free, fitted)
        spare = np.einsum("mab,kmab->k", inverse, parts.free)
        spare -= np.einsum("mai,kmab,mbj,ij->k", weighted, parts.free, weighted, covariance, optimize=True)
        new = np.maximum(theta * np.sqrt(np.maximum(hit, 0) / np.maximum(spare, 1e-300)), least)
        done = np.abs(np.log(new / theta)).max() < SETTLED
        theta = new
        if done:
            break
    return theta
