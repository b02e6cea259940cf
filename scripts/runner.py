"""What scripts share: options, each stated by its default, tables, the shared data, and errors of faces."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from stcal.parallel import one_thread

if TYPE_CHECKING:
    import numpy as np

    from stcal.geometry.rigid import Rigid
    from stcal.sfm.adjust.chain import CalibratedTarget

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "tests" / "data" / "sample"
DATA = ROOT.parent / "shared" / "data"
"""Data sets beside the repository."""


def options_of(doc: str | None, places: Mapping[str, object] | None = None, **defaults) -> argparse.Namespace:
    """Returns the options of the command line.

    Parameters
    ----------
    doc : the script's own text, which ``--help`` prints
    places : defaults of arguments by position; a list for several, a type where one must be given
    defaults : by the option's name: a number, text or path; a list for an option with several values; False for a
        switch; a type for an option without a default
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    places = places or {}
    for name, default in (*places.items(), *defaults.items()):
        words = [name] if name in places else [f"--{name.replace('_', '-')}"]
        one = default[0] if isinstance(default, list) else default
        kind = {"type": one if isinstance(one, type) else type(one)}
        if default is False:
            kind = {"action": "store_true"}
        elif isinstance(default, list):
            kind |= {"nargs": "*" if name in places else "+", "default": default}
        elif not isinstance(default, type):
            kind |= {"default": default} | ({"nargs": "?"} if name in places else {})
        parser.add_argument(*words, **kind)
    return parser.parse_args()


def script(places: Mapping[str, object] | None = None, limited: bool = False, **defaults) -> Callable:
    """Decorates the main function, which is the last of its file: where this is run, calls it with its options, those
    of :func:`options_of`; ``limited`` : BLAS has one thread meanwhile."""

    def decorated(main: Callable) -> Callable:
        if main.__module__ == "__main__":
            options = options_of(sys.modules["__main__"].__doc__, places, **defaults)
            with one_thread() if limited else nullcontext():
                main(options)
        return main

    return decorated


@contextmanager
def executor_of(scheduler: str | None = None) -> Iterator[Executor]:
    """Yields the workers of the Dask cluster at an address, or processes of this machine, one per core."""
    if scheduler is None:
        with ProcessPoolExecutor() as pool:
            yield pool
        return
    from stcal.workflows.cluster import connected

    with connected(scheduler) as client:
        yield client.get_executor(pure=False)


def head(*names: str) -> None:
    """Prints the head of a table in Markdown."""
    row(*names)
    print(f"|{'---|' * len(names)}", flush=True)


def row(*cells: object) -> None:
    """Prints a row of a table in Markdown."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def face_errors(found: "CalibratedTarget", true: "Mapping[str, Rigid]") -> "dict[str, np.ndarray]":
    """Error (6,), rad and mm, of the pose of each known face against the truth, both in the reference face's frame."""
    import numpy as np

    from stcal.geometry.rigid import Rigid

    own, errors = found.reference_face, {}
    for face, pose in found.target_from_face.items():
        if face != own and face in true:
            known = true[own].inverse() @ true[face]
            turn = Rigid(pose.rotation @ known.rotation.T).log()[:3]
            errors[face] = np.concatenate([turn, pose.translation - known.translation])
    return errors


def normalised(found: "CalibratedTarget", errors: "Mapping[str, np.ndarray]") -> "np.ndarray":
    """eᵀC⁻¹e/6 of each face's error of :func:`face_errors`, (n,)."""
    import numpy as np

    return np.array([e @ np.linalg.solve(found.face_covariance[face], e) / 6 for face, e in errors.items()])
