"""Linear solutions of the loop, many subsets of poses at once; and one that a third of bad poses does not disturb."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Rigid
from stcal.handeye.loop import Loop

SUBSETS = 200
"""Of three or four poses: with a third of all poses bad, hundreds of clean ones are among them on average …"""
SEED = 0
"""… and the same ones every time."""


def linear(loop: Loop) -> tuple[Rigid, Rigid]:
    """X and Z from all poses: rotations by Shah (2013), then translations by linear least squares.

    It takes no logarithms, so that half turns are motions like any other.
    """
    solved = _linear(loop, np.arange(len(loop))[None])
    return Rigid(solved[0][0], solved[1][0]), Rigid(solved[2][0], solved[3][0])


def robust(loop: Loop) -> tuple[Rigid, Rigid]:
    """The best X, Z of many small subsets: with the least product of the median rotation and translation residuals.

    The product has no unit that would have to be weighed. Refined once by all poses within three times the medians.

    Raises
    ------
    DegenerateError
        Fewer than three poses.
    """
    m = len(loop)
    if m < 3:
        raise DegenerateError(f"hand-eye: {m} poses, 3 needed; rotate the flange about two axes and take more")
    candidates = [_linear(loop, np.arange(m)[None])]
    rng = np.random.default_rng(SEED)
    if m > 3:
        size = 3 if m < 6 else 4
        candidates.append(_linear(loop, rng.permuted(np.tile(np.arange(m), (SUBSETS, 1)), axis=1)[:, :size]))
    parts = [np.concatenate(part) for part in zip(*candidates, strict=True)]
    turn, shift = _misses(loop, *parts)
    best = np.argmin(np.log(np.median(turn, 1) + 1e-15) + np.log(np.median(shift, 1) + 1e-12))
    inside = (turn[best] <= 3 * np.median(turn[best])) & (shift[best] <= 3 * np.median(shift[best]))
    if inside.sum() >= 3:
        again = _linear(loop, np.flatnonzero(inside)[None])
        new_turn, new_shift = _misses(loop, *again)
        if np.median(new_turn) * np.median(new_shift) < np.median(turn[best]) * np.median(shift[best]):
            parts, best = again, 0
    return Rigid(parts[0][best], parts[1][best]), Rigid(parts[2][best], parts[3][best])


def _linear(loop: Loop, subsets: np.ndarray) -> tuple[np.ndarray, ...]:
    """X and Z of subsets (s, k) of the poses: rotations (s, 3, 3) and translations (s, 3) of each."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    # R_G R_X R_C = R_Z: Σ R_C ⊗ R_G maps vec R_X to k vec R_Z, both of the same length: its first singular vectors.
    k = np.einsum("mab,mcd->madbc", hand.rotation, eye.rotation).reshape(len(loop), 9, 9)
    u, _, vt = np.linalg.svd(k[subsets].sum(1))
    z, x = u[:, :, 0].reshape(-1, 3, 3), vt[:, 0].reshape(-1, 3, 3)
    sign = np.sign(np.linalg.det(x))[:, None, None]
    x, z = _nearest_rotation(sign * x), _nearest_rotation(sign * z)
    # R_G t_X − t_Z = −t_G − R_G R_X t_C.
    rows = np.concatenate([hand.rotation, np.tile(-np.eye(3), (len(loop), 1, 1))], axis=2)[subsets]
    right = -hand.translation[subsets] - np.einsum(
        "skab,sbc,skc->ska", hand.rotation[subsets], x, eye.translation[subsets]
    )
    solved = np.linalg.pinv(rows.reshape(len(subsets), -1, 6), rcond=1e-9) @ right.reshape(len(subsets), -1, 1)
    return x, solved[:, :3, 0], z, solved[:, 3:, 0]


def _misses(loop: Loop, x, t_x, z, t_z) -> tuple[np.ndarray, np.ndarray]:
    """Angles (s, m) and distances (s, m) by which the chains miss Z."""
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    chain = np.einsum("mab,sbc,mcd->smad", hand.rotation, x, eye.rotation)
    cosine = (np.einsum("smab,sab->sm", chain, z) - 1) / 2
    at = np.einsum("mab,smb->sma", hand.rotation, eye.translation @ np.swapaxes(x, 1, 2) + t_x[:, None])
    return np.arccos(np.clip(cosine, -1, 1)), np.linalg.norm(at + hand.translation - t_z[:, None], axis=2)


def _nearest_rotation(m: np.ndarray) -> np.ndarray:
    """Rotations nearest to matrices (s, 3, 3)."""
    u, _, vt = np.linalg.svd(m)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def mean_pose(chain) -> Rigid:
    """Mean of poses: the chordal mean of their rotations."""
    return Rigid(Rotation.from_matrix(np.array(chain.rotation)).mean().as_matrix(), chain.translation.mean(0))
