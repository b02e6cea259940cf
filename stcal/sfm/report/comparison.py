"""Table of the comparison with the published method."""

from stcal.report.text import NONE, number


def comparison_cells(comparison: dict) -> tuple[list[str], list[list[str]]]:
    """Returns heads and rows of the table; ``comparison`` : its content in ``report.json``."""
    faces = list(comparison["sigma"])
    heads = ["<Method", *(f"Face {face} (µm)" for face in faces), "Rotation, largest (mdeg)", "Board, mean (µm)",
             "± (µm)", "Residual (px)"]  # fmt: skip
    rows = []
    for row in comparison["rows"]:
        differences, last = row["faces"], row is comparison["rows"][-1]
        shown = [number(differences[face]["translation_um"], 2) if face in differences else NONE for face in faces]
        turned = number(max((difference["rotation_mdeg"] for difference in differences.values()), default=None), 2)
        if last:
            shown = [f"σ {number(comparison['sigma'][face]['translation_um'], 2)}" for face in faces]
            turned = f"σ {number(max(difference['rotation_mdeg'] for difference in comparison['sigma'].values()), 2)}"
        board = [number(row[key], 1) for key in ("board_mean_um", "board_spread_um")]
        rows.append([row["method"], *shown, turned, *board, number(row["residual_rms_px"], 4)])
    return heads, rows
