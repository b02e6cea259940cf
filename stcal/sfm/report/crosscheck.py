"""Section of the report on the cross-check with the native COLMAP."""

from stcal.labels import parse_label
from stcal.report.text import NONE, cells, number

LIMITS = (
    ("mapped_sigma", "σ", "of faces and circles between the programs"),
    ("sigma", "σ", "of these adjusted"),
    ("face_um", "µm", "of faces"),
    ("face_mdeg", "mdeg", "of faces"),
    ("circle_um", "µm", "of circles"),
    ("camera_um", "µm", "of cameras"),
    ("camera_mdeg", "mdeg", "of cameras"),
)
COMPARISONS = ("mapping", "result", "plain")


def crosscheck_values(check: dict) -> dict:
    """Returns the section ``crosscheck`` of ``report.json`` as the template shows it."""
    limits = check["tolerances"]
    allowed = [f"{limits[key]:g} {unit} {object_name}" for key, unit, object_name in LIMITS if limits[key] is not None]
    faces: dict[str, list[tuple[float, str]]] = {}
    for label, value in check["mapping"]["circles_um"].items():
        faces.setdefault(parse_label(label).plane, []).append((value, label))
    sigmas = check["mapping"]["circles_sigmas"]
    programs = {
        "native": f"COLMAP {check['native']}",
        "pycolmap": f"pycolmap {check['pycolmap']}",
        "run": "this result",
    }
    return {
        "allowed": allowed,
        "models": [
            [name, check["images"][key], number(check["residual_rms_px"][key], 4)] for key, name in programs.items()
        ],
        "faces": [_face_row(check, face) for face in check["mapping"]["faces"]],
        "circles": [
            [face, len(rows), number(sum(v for v, _ in rows) / len(rows), 3), number(max(rows)[0], 3), max(rows)[1]]
            for face, rows in sorted(faces.items())
        ],
        "single": [
            [label, number(value, 3), number(sigmas.get(label), 2)]
            for label, value in check["mapping"]["circles_um"].items()
        ],
        "worst_camera": max(check["mapping"]["cameras"], key=lambda row: row["sigmas"], default=None),
    }


def _face_row(check: dict, face: str) -> list[str]:
    """Returns the row of a face: position, rotation and σ of each comparison."""
    row = [face]
    for key in COMPARISONS:
        entry = check[key]["faces"].get(face)
        row += [*cells(entry, "translation_um:3 rotation_mdeg:3"), number(entry["sigmas"], 2)] if entry else [NONE] * 3
    return row
