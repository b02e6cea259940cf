"""Read-only float arrays with a checked shape, for the frozen dataclasses of the package."""

import numpy as np

from stcal.errors import InputError


def frozen(values, shape: tuple[int | None, ...] | None = None, what: str = "array", dtype=float) -> np.ndarray:
    """Return a read-only copy of ``values``; ``None`` in ``shape`` admits any length.

    Raises
    ------
    InputError
        If the shape differs, or a float array holds a value that is not finite.
    """
    array = np.array(values, dtype=dtype)
    if shape is not None and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError(f"{what}: shape {array.shape}, {shape} needed")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"{what}: holds values that are not finite")
    array.flags.writeable = False
    return array
