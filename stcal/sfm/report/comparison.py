"""The comparison with the published method as a table."""

from stcal.report.text import NONE, number


def comparison_cells(comparison: dict) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table; ``comparison`` : its content in ``report.json``."""
    faces = list(comparison["sigma"])
    heads = ["<Method", *(f"Face {face} (µm)" for face in faces), "Rotation, largest (mdeg)", "Board, mean (µm)",
             "± (µm)", "Residual (px)"]  # fmt: skip
    rows = []
    for row in comparison["rows"]:
        own, last = row["faces"], row is comparison["rows"][-1]
        shown = [number(own[face]["translation_um"], 2) if face in own else NONE for face in faces]
        turned = number(max((each["rotation_mdeg"] for each in own.values()), default=None), 2)
        if last:
            shown = [f"σ {number(comparison['sigma'][face]['translation_um'], 2)}" for face in faces]
            turned = f"σ {number(max(each['rotation_mdeg'] for each in comparison['sigma'].values()), 2)}"
        board = [number(row[key], 1) for key in ("board_mean_um", "board_spread_um")]
        rows.append([row["method"], *shown, turned, *board, number(row["residual_rms_px"], 4)])
    return heads, rows
