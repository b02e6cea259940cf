"""The report's section on the cross-check with the native COLMAP."""

from html import escape

from stcal.labels import parse_label
from stcal.report.page import Html, cells, fold, number, table

QUESTIONS = {
    "mapping": "Native – pycolmap",
    "result": "Native, adjusted – result",
    "plain": "Native – result",
}


def crosscheck_section(check: dict) -> str:
    """HTML of ``report.json``'s ``crosscheck``."""
    limits = check["tolerances"]
    differences = check["differences"]
    verdict = (
        "They agree."
        if not differences
        else f'<strong class="alarm">They differ: {escape("; ".join(differences))}.</strong>'
    )
    notes = "".join(f"<p>{escape(note)}</p>\n" for note in check["notes"])
    return (
        f"<p>Native COLMAP {escape(check['native'])} and pycolmap {escape(check['pycolmap'])} on the same database "
        f"(schema {escape(check['schema'])} for the native one), initial pairs and thresholds. {verdict}</p>\n"
        f"{_models(check)}<h3>Faces</h3>\n<p>Differences in the target frame: the two programs' models as COLMAP "
        "adjusts them; the native models after our own adjustment against this result; and without it. Allowed in the "
        f"first two: {limits['face_um']:g} µm and {limits['face_mdeg']:g} mdeg; the third shows what weights "
        "and the joint adjustment are worth.</p>\n"
        f"{_faces(check)}{_circles(check)}{_cameras(check)}{notes}"
    )


def _models(check: dict) -> Html:
    residual, images = check["residual_rms_px"], check["images"]
    rows = [
        [f"COLMAP {check['native']}", images["native"], number(residual["native"], 4)],
        [f"pycolmap {check['pycolmap']}", images["pycolmap"], number(residual["pycolmap"], 4)],
        ["this result", images["run"], number(residual["run"], 4)],
    ]
    return table(["<Model", "Images", "Residual RMS (px)"], rows)


def _faces(check: dict) -> Html:
    columns, over = ["<Face"], [("", 1)]
    for text in QUESTIONS.values():
        columns += ["Position (µm)", "Rotation (mdeg)"]
        over.append((text, 2))
    rows = []
    for face in check["mapping"]["faces"]:
        row = [face]
        for key in QUESTIONS:
            own = check[key]["faces"].get(face)
            row += cells(own, "translation_um:3 rotation_mdeg:3") if own else ["–", "–"]
        rows.append(row)
    return table(columns, rows, over)


def _circles(check: dict) -> str:
    faces: dict[str, list[tuple[float, str]]] = {}
    for label, value in check["mapping"]["circles_um"].items():
        faces.setdefault(parse_label(label).plane, []).append((value, label))
    rows = [
        [face, len(own), number(sum(v for v, _ in own) / len(own), 3), number(max(own)[0], 3), max(own)[1]]
        for face, own in sorted(faces.items())
    ]
    single = [[label, number(value, 3)] for label, value in check["mapping"]["circles_um"].items()]
    return (
        f"<h3>Circles</h3>\n<p>Native against pycolmap; {check['tolerances']['circle_um']:g} µm allowed.</p>\n"
        f"{table(['<Face', 'Circles', 'Mean (µm)', 'Max (µm)', '<Worst'], rows)}"
        + fold("Circle by circle", table(["<Circle", "Difference (µm)"], single))
    )


def _cameras(check: dict) -> str:
    limits = check["tolerances"]
    rows = [cells(row, "image position_um:2 rotation_mdeg:3") for row in check["mapping"]["cameras"]]
    worst = max(check["mapping"]["cameras"], key=lambda row: row["position_um"], default=None)
    text = f"{limits['camera_um']:g} µm and {limits['camera_mdeg']:g} mdeg allowed"
    if worst:
        text += f"; the largest is {number(worst['position_um'], 1)} µm at {worst['image']}"
    return f"<h3>Cameras</h3>\n<p>Native against pycolmap, against the target; {escape(text)}.</p>\n" + fold(
        "Camera by camera", table(["<Image", "Position (µm)", "Rotation (mdeg)"], rows)
    )
