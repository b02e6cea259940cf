"""The report's section on the cross-check with the native COLMAP."""

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
    """``report.json``'s ``crosscheck`` as the template shows it."""
    limits = check["tolerances"]
    allowed = [f"{limits[key]:g} {unit} {of}" for key, unit, of in LIMITS if limits[key] is not None]
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
            [face, len(own), number(sum(v for v, _ in own) / len(own), 3), number(max(own)[0], 3), max(own)[1]]
            for face, own in sorted(faces.items())
        ],
        "single": [
            [label, number(value, 3), number(sigmas.get(label), 2)]
            for label, value in check["mapping"]["circles_um"].items()
        ],
        "worst_camera": max(check["mapping"]["cameras"], key=lambda row: row["sigmas"], default=None),
    }


def _face_row(check: dict, face: str) -> list[str]:
    """Position and rotation of each comparison."""
    row = [face]
    for key in COMPARISONS:
        own = check[key]["faces"].get(face)
        row += [*cells(own, "translation_um:3 rotation_mdeg:3"), number(own["sigmas"], 2)] if own else [NONE] * 3
    return row
