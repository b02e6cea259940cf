"""What commands say of the designs that they work with: the reference ones that stand in for files that are not given,
and faces that are nearly alike."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stcal.cli.terminal import print_each, say
from stcal.errors import InputError, StcalError


@contextmanager
def designs_told(
    target: Path | None, board: Path | None, with_target: bool = True, with_board: bool = True
) -> Iterator[None]:
    """Say which reference designs are assumed, and name them in what goes wrong meanwhile; say which faces of the
    target's file are nearly alike.

    Parameters
    ----------
    target, board : path, optional
        Files that were given.
    with_target, with_board : bool
        Whether the reference design stands in for a file that was not.
    """
    from stcal.io.design import target_of
    from stcal.sfm.detect.ambiguity import likeness_notes

    if target is not None:
        print_each("note", likeness_notes(target_of(target)))
    assumed = assumed_designs(target is None and with_target, board is None and with_board)
    for each in assumed:
        say(f"assumed: {each}")
    try:
        yield
    except StcalError as error:
        if assumed and not isinstance(error, InputError):
            error.append(f"; assumed: {' and '.join(assumed)}")
        raise


def assumed_designs(target: bool, board: bool) -> list[str]:
    """The reference target and board in a few words, with the options that name others."""
    from stcal.design import reference_board, reference_target

    own, grid, words = reference_target(), reference_board(), []
    if target:
        words.append(f"the reference target, {len(own.faces)} faces of {len(own.faces[0].ids)} circles (no --target)")
    if board:
        words.append(
            f"the reference board, {grid.rows}×{grid.columns} dots of radius {grid.radius_mm:g} mm, "
            f"pitch {grid.pitch_mm:g} mm (no --board)"
        )
    return words
