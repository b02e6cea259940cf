"""Sources of uncertainty of a budget, and the conditions stated for them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stcal.boards.design import TAG_SIGMA_MM
from stcal.design import DOTS_SIGMA_MM, BoardDesign, StatedSize, faces_of_known_shape, known_distances
from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.io.design import BoardSizeEntry, SizeEntry
from stcal.io.toml import Strict, load_toml
from stcal.sfm.adjust.calibration import FLATNESS_MM
from stcal.sfm.adjust.uncertainty import (
    BOARD,
    CIRCLES,
    DISTANCES,
    DOTS,
    FLATNESS,
    INTRINSICS,
    PRINT,
    SIZES,
    Contributions,
)

FIELDS = ("number", "laboratory", "place", "customer", "instrument", "operator", "date", "traceability")
"""Fields in the head of every budget, after those that are given, and empty if they are not."""
LONGEST = 500
DEFAULT = "; the default, which `design` writes too: measure it and state it"
"""Words for a σ that nobody has changed."""


def _written(value: object) -> object:
    """Returns a date or time of TOML as its text."""
    if isinstance(value, datetime):
        return value.isoformat(" ")
    return value.isoformat() if isinstance(value, date | time) else value


Text = Annotated[str, BeforeValidator(_written), Field(max_length=LONGEST)]
FieldName = Annotated[str, Field(min_length=1, max_length=60)]


class StatementFile(Strict):
    """The file of ``--statement``."""

    one_thermometer: bool = False
    fields: dict[FieldName, Text] = Field(default_factory=dict)
    board: BoardSizeEntry = BoardSizeEntry()
    target: SizeEntry = SizeEntry()


@dataclass(frozen=True, slots=True)
class Statement:
    """What the user states."""

    board: StatedSize
    target: StatedSize
    origin: dict[tuple[str, str], str]  # the file that states a value, by ``board`` or ``target`` and key
    fields: dict[str, str]  # of the head by name
    one_thermometer: bool = False  # True if the temperatures of both err alike


def statement_of(own: StatedSize, path: Path | None = None, given: Mapping[str, str] | None = None) -> Statement:
    """Statement of a run: ``own`` of its ``board.toml``, overridden by the file, whose fields ``given`` overrides."""
    file = load_toml(path, StatementFile, "statement", "give a TOML file") if path else StatementFile()
    sizes, origin = {}, {}
    for body, first, second in (("board", own, file.board.stated()), ("target", StatedSize(), file.target.stated())):
        values = {}
        for key in (field.name for field in fields(StatedSize)):
            values[key] = getattr(second, key)
            origin[body, key] = str(path)
            if values[key] is None:
                values[key], origin[body, key] = getattr(first, key), "board.toml"
        sizes[body] = StatedSize(**values)
    for name, value in (given or {}).items():
        if not name or len(name) > 60 or len(value) > LONGEST:
            raise InputError(
                "E-OPTION-VALUE",
                f"--field {name[:20]}: {len(f'{name}={value}')} characters; up to 60 for a name, {LONGEST} for a value",
            )
    named = file.fields | dict(given or {})
    named |= {name: "" for name in FIELDS if name not in named}
    _require_past(named["date"], "--field" if path is None or "date" in (given or {}) else str(path))
    return Statement(sizes["board"], sizes["target"], origin, named, file.one_thermometer)


def _require_past(text: str, where: str) -> None:
    """Checks that the date of a calibration, if there is one, is of ISO 8601 and not in the future."""
    if not text.strip():
        return
    try:
        day = datetime.fromisoformat(text.strip()).date()
    except ValueError as error:
        raise InputError(
            "E-OPTION-VALUE", f"{where}: date {text}: no date as YYYY-MM-DD (ISO 8601); write it so"
        ) from error
    if day > date.today() + timedelta(days=1):  # in some time zone it is tomorrow
        raise InputError("E-OPTION-VALUE", f"{where}: date {text}: in the future; give the date of the calibration")


def fields_of(given: Sequence[str]) -> dict[str, str]:
    """Parses ``NAME=VALUE`` into a dictionary; an error without ``=``, or for a name given twice."""
    values: dict[str, str] = {}
    for text in given:
        name, sign, value = (word.strip() for word in text.partition("="))
        if not sign or not name:
            raise InputError("E-OPTION-VALUE", f"--field {text!r}: NAME=VALUE needed, such as operator='A. Smith'")
        if name in values:
            raise InputError("E-OPTION-REPEATED", f"--field {name}: given twice; give it once")
        values[name] = value
    return values


Origin = Literal["estimated", "stated", "assumed", "not stated", "not known"]
PPM = 1e-6
REFERENCE_C = 20.0
"""Reference temperature of ISO 1:2022, used unless another one is stated."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A row of the budget."""

    key: str  # name in files
    title: str  # name in tables
    evaluation: Literal["A", "B"]  # statistics of this run, or other knowledge
    origin: Origin  # where the input's σ comes from, explained in ``words``
    words: str
    sigma: float | None  # in ``unit``, None if it is not one number
    unit: str
    covariance_mm2: np.ndarray  # (3c, 3c) of the circles due to this input alone

    def __post_init__(self):
        freeze(self, "covariance_mm2", (None, None), f"{self.key}: covariance")


def sources_of(
    contributions: Contributions,
    camera: Camera,  # as given to the run, with the covariance that its file states
    board: BoardDesign,
    flatness_mm: float | None,
    refined: bool,  # whether its intrinsics were adjusted
    statement: Statement,
    camera_given: bool = True,  # False if the camera was found from the photographs
) -> tuple[Source, ...]:
    """Returns all rows of the budget, also for inputs that are not stated, so that the reader sees what is left out."""
    common = contributions.joint.board_common
    shape = f"{100 * common:.0f} % of it common to all groups" if common else "each group its own"
    by_dots = f"sigma_mm of board.toml × σ₀ {contributions.joint.sigma_scale:.3f}; {shape}"
    corners = bool(faces_of_known_shape(board))
    centres = ("circle_centres", "corners and centres of faces" if corners else "centres of circles", CIRCLES)
    dots = ("dot_centres", "centres of dots", DOTS)
    rows = [
        Source(key, title, "A", "estimated", "residuals; RMS per axis", contributions.centre_sigma_px[kind], "px",
               contributions.covariance_mm2[kind])
        for key, title, kind in (centres, dots)[: 2 if board.rows else 1]
    ]  # fmt: skip
    if board.rows:
        sigma_um = 1e3 * board.sigma_mm * contributions.joint.sigma_scale
        covariance = contributions.covariance_mm2[BOARD]
        origin: Origin = "assumed" if board.sigma_mm == DOTS_SIGMA_MM else "stated"
        by_dots += DEFAULT * (origin == "assumed")
        rows.append(Source("board_dots", "places of dots", "B", origin, by_dots, sigma_um, "µm", covariance))
    rows += _own_size(contributions, board)
    if not corners or contributions.covariance_mm2[FLATNESS].any():
        rows.append(_flatness(contributions, flatness_mm))
    rows.append(_intrinsics(contributions, camera, refined, camera_given))
    if board.rows:
        rows.append(_scale(contributions.by_scale, statement))
    grown = contributions.joint.xyz_model - contributions.joint.xyz_model.mean(0)
    bodies = (("board", statement.board, contributions.by_scale), ("target", statement.target, -grown.ravel()))
    if board.rows:
        rows += [row for body, stated, effect in bodies for row in _temperature(body, stated, effect, statement)]
        if statement.one_thermometer:
            rows = [row for row in rows if row.key not in ("board_temperature", "target_temperature")]
            rows.append(_one_thermometer(bodies))
    return tuple(rows)


def _own_size(contributions: Contributions, board: BoardDesign) -> Iterator[Source]:
    """Yields the rows of faces of known shape and of known distances."""
    factor = contributions.joint.sigma_scale
    if faces := faces_of_known_shape(board):
        print_factor = contributions.joint.print_factor
        within_stated = max(face.sigma_mm or 0.0 for face in faces)
        within = within_stated * print_factor * factor
        words = f"sigma_mm of target.toml × {print_factor * factor:.2f}, in the plane; off it --flatness"
        origin: Origin = "assumed" if within_stated == TAG_SIGMA_MM else "stated"
        words += DEFAULT * (origin == "assumed")
        yield Source(
            "print", "print of faces", "B", origin, words, 1e3 * within, "µm", contributions.covariance_mm2[PRINT]
        )
        largest = max(faces, key=lambda face: face.size_sigma)
        sigma, by_statement = largest.size_sigma, largest.size_sigma > 0 and largest.edge_share < 1
        stated: Origin = "stated" if by_statement else "assumed" if sigma else "not stated"
        edges = "a common displacement of the edges of all tags"
        words = f"no size_sigma_mm; {edges if sigma else 'taken as exact'}"
        if by_statement:
            words = "size_sigma_mm" + (f", and {edges}" if largest.edge_share else "")
        ppm = 1e6 * sigma if sigma else None
        yield Source("print_size", "size of print", "B", stated, words, ppm, "ppm", contributions.covariance_mm2[SIZES])
    if known := known_distances(board):
        sigma_um = 1e3 * max(each.sigma_mm for each in known) * factor
        words = f"[[scale]] of target.toml, {len(known)} in all; the largest σ"
        covariance = contributions.covariance_mm2[DISTANCES]
        if known[0].drawn:
            words = "nothing of known size was in view: only the shape is known"
            yield Source("distances", "size", "B", "not known", words, None, "µm", covariance)
            return
        yield Source("distances", "known distances", "B", "stated", words, sigma_um, "µm", covariance)


def _flatness(contributions: Contributions, flatness_mm: float | None) -> Source:
    words = f"--flatness of the run × σ₀ {contributions.joint.sigma_scale:.3f}"
    if flatness_mm is None:
        words = "--flatness off: faces need not be flat"
    sigma = None if flatness_mm is None else 1e3 * flatness_mm * contributions.joint.sigma_scale
    origin: Origin = "not stated" if flatness_mm is None else "stated"
    if flatness_mm == FLATNESS_MM:
        origin, words = "assumed", f"the default of {words}"
    return Source(
        "flatness", "flatness of faces", "B", origin, words, sigma, "µm", contributions.covariance_mm2[FLATNESS]
    )


def _intrinsics(contributions: Contributions, camera: Camera, refined: bool, camera_given: bool) -> Source:
    if not camera_given:
        words = "found from these photographs, without a camera file; adjusted with all else"
        return _camera_row("estimated", words, contributions.covariance_mm2[INTRINSICS], "A")
    stated = camera.covariance is not None
    origin: Origin = "stated" if stated else "assumed" if refined else "not stated"
    if refined:
        words = "adjusted; σ before that " + ("of the camera file" if stated else "of a calibration of some age")
        return _camera_row(origin, words, contributions.covariance_mm2[INTRINSICS])
    if camera.covariance is None:
        words = "fixed; no σ in the camera file"
        return _camera_row(origin, words, np.zeros_like(contributions.joint.covariance_mm2))
    effect = contributions.by_intrinsics @ intrinsic_basis(camera.colmap_model)
    return _camera_row(origin, "fixed; σ of the camera file", effect @ camera.covariance @ effect.T)


def _camera_row(origin: Origin, words: str, covariance: np.ndarray, evaluation: Literal["A", "B"] = "B") -> Source:
    return Source("intrinsics", "intrinsics", evaluation, origin, words, None, "", covariance)


def _stated(
    key: str, title: str, unit: str, absent: Sequence[str], words: str, sigma: float | None, covariance: np.ndarray
) -> Source:
    """Returns the row of an input that the user states; where keys are absent from the statement, it is exact."""
    if absent:
        zero = np.zeros_like(covariance)
        return Source(key, title, "B", "not stated", f"no {' and '.join(absent)}", None, unit, zero)
    return Source(key, title, "B", "stated", words, sigma, unit, covariance)


def _scale(by_scale: np.ndarray, statement: Statement) -> Source:
    name, sigma = "pitch_sigma_ppm", statement.board.pitch_sigma_ppm
    words = f"{name} of {statement.origin['board', name]}"
    covariance = ((sigma or 0.0) * PPM) ** 2 * np.outer(by_scale, by_scale)
    return _stated("board_pitch", "board's pitch", "ppm", [name] * (sigma is None), words, sigma, covariance)


def _temperature(what: str, stated: StatedSize, effect: np.ndarray, statement: Statement) -> Iterator[Source]:
    """Yields the rows of temperature and expansion; ``effect``: (3c,) of a relative change of size."""
    warmer = warmer_k(stated)
    for key, name, needed, factor, unit in (
        ("temperature", "temperature_sigma_k", "expansion_ppm_per_k", stated.expansion_ppm_per_k, "K"),
        ("expansion", "expansion_sigma_ppm_per_k", "temperature_c", warmer, "ppm/K"),
    ):
        sigma = getattr(stated, name)
        absent = [name] * (sigma is None) + [needed] * (factor is None)
        words = f"{name} of {statement.origin[what, name]}"
        covariance = ((sigma or 0.0) * (factor or 0.0) * PPM) ** 2 * np.outer(effect, effect)
        yield _stated(f"{what}_{key}", f"{what}'s {key}", unit, absent, words, sigma, covariance)


def _one_thermometer(bodies: Iterable[tuple[str, StatedSize, np.ndarray]]) -> Source:
    """Row of an error common to both temperatures (JCGM 100, 5.2.2, r = 1), nearly nil if bodies expand alike."""
    total, absent, sigmas = 0.0, [], []
    for body, stated, effect in bodies:
        sigma, rate = stated.temperature_sigma_k, stated.expansion_ppm_per_k
        keys = (("temperature_sigma_k", sigma), ("expansion_ppm_per_k", rate))
        absent += [f"{key} of [{body}]" for key, value in keys if value is None]
        sigmas.append(sigma)
        total = total + (sigma or 0.0) * (rate or 0.0) * PPM * effect
    sigma = sigmas[0] if sigmas[0] == sigmas[1] else None
    title, words = "temperature of board and target", "temperature_sigma_k of both, one_thermometer: fully correlated"
    return _stated("temperature", title, "K", absent, words, sigma, np.outer(total, total))


def warmer_k(stated: StatedSize) -> float | None:
    """Returns the temperature in the photographs minus the reference temperature, or None if it is not stated."""
    return None if stated.temperature_c is None else stated.temperature_c - reference_temperature_c(stated)


def reference_temperature_c(stated: StatedSize) -> float:
    """Returns the temperature at which the size of a body is to be stated: the given one, or 20 °C."""
    return REFERENCE_C if stated.reference_temperature_c is None else stated.reference_temperature_c


@dataclass(frozen=True, slots=True)
class Conditions:
    """The temperature for which lengths and positions hold, and what they are corrected by for that."""

    size_known: bool  # False if nothing of known size was in view
    correction: float  # relative, 0 for none
    temperature_c: float | None  # of the target, None if it is not known
    words: str  # the same as a sentence without its stop


def conditions_of(statement: Statement, board: BoardDesign) -> Conditions:
    """Returns the temperature for which lengths hold, and their correction for the expansion of the board and, only
    with it, of the target: that starts from the length at the photographs' temperature. A size stated of the target
    itself holds at its reference temperature (ISO 1), so that no expansion enters."""
    target = statement.target
    if any(known.drawn for known in known_distances(board)):
        words = "Only the shape is known, as nothing of known size was in view: no length and no position holds in mm"
        return Conditions(False, 0.0, None, words)
    wanted = reference_temperature_c(target)
    if not board.rows:
        words = (
            f"Lengths and positions hold at {wanted:g} °C, as the sizes stated of the target do (ISO 1); they are its "
            "own, so that no expansion enters"
        )
        return Conditions(True, 0.0, wanted, words)
    of_board, of_target = _growth(statement.board), _growth(target)
    if of_board is not None and of_target is not None:
        total = of_board - of_target
        words = f", with a correction of {total / PPM:+.1f} ppm for the stated expansion" if total else ""
        return Conditions(True, total, wanted, f"Lengths and positions hold at {wanted:g} °C{words}")
    photographed = "the temperature at which the target was photographed"
    if target.temperature_c is not None:
        photographed = f"{target.temperature_c:g} °C, at which the target was photographed"
    held = f"Lengths and positions hold at {photographed}"
    if of_board is not None:
        corrected = f", with a correction of {of_board / PPM:+.1f} ppm for the board's expansion" if of_board else ""
        words = f"{held}{corrected}: expansion and temperature of the target are not both stated"
        return Conditions(True, of_board, target.temperature_c, words)
    words = (
        f"{held}, as far as the board's grid had the size of its file there: its expansion and temperature are not "
        "both stated"
    )
    if of_target is not None:
        words += ", and without them the target's are not corrected for"
    return Conditions(True, 0.0, target.temperature_c, words)


def _growth(stated: StatedSize) -> float | None:
    """Returns the relative expansion of a body since its reference temperature; None if it is not known."""
    warmer = warmer_k(stated)
    if 0.0 in (warmer, stated.expansion_ppm_per_k):
        return 0.0
    if warmer is None or stated.expansion_ppm_per_k is None:
        return None
    return stated.expansion_ppm_per_k * PPM * warmer
