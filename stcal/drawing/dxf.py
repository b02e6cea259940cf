"""DXF of a sheet in mm for laser and mill: circles and outlines, with one layer for each use.

It needs ``ezdxf``, which ``stcal[cad]`` installs.
"""

import io

import numpy as np

from stcal.drawing.shapes import LAYERS, Area, Disc, Shape, Text
from stcal.drawing.sheets import Sheet
from stcal.errors import InputError

COLOURS = {"GROUND": 9, "PATTERN": 7, "CUT": 1, "FOLD": 3, "DIMENSIONS": 8, "LABELS": 8}
"""AutoCAD's colour numbers of the layers."""
APPLICATION = "STCAL"


def new_drawing():
    """Return an empty drawing, R2010, mm.

    Raises
    ------
    InputError
        ``stcal[cad]`` is not installed.
    """
    try:
        from ezdxf import units
        from ezdxf.filemanagement import new
    except ImportError as error:
        raise InputError("E-EXTRA-MISSING", "DXF: needs ezdxf; install stcal[cad]") from error
    return new("R2010", units=units.MM)


def dxf_text(drawing) -> str:
    """Return the drawing as the text of a file."""
    stream = io.StringIO()
    drawing.write(stream)
    return stream.getvalue()


def dxf(sheet: Sheet) -> str:
    """Return the text of the file, R2010.

    It holds ``CIRCLE``, closed ``LWPOLYLINE`` (the area between it and those inside it is inked) and ``TEXT``. Labels
    of circles and the ink are extended data ``STCAL``.

    Raises
    ------
    InputError
        ``stcal[cad]`` is not installed.
    """
    drawing = new_drawing()
    drawing.appids.add(APPLICATION)
    drawing.linetypes.add("FOLD", [4.5, 3.0, -1.5], description="__ __")
    for layer in LAYERS:
        drawing.layers.add(layer, color=COLOURS[layer], linetype="FOLD" if layer == "FOLD" else "CONTINUOUS")
    space = drawing.modelspace()
    for shape in sheet.shapes():
        for entity in _entities(space, shape):
            if not isinstance(shape, Text):
                name = [(1000, shape.name)] if isinstance(shape, Disc) and shape.name else []
                entity.set_xdata(APPLICATION, [(1000, shape.ink), *name])
    drawing.header.custom_vars.append("stcal", sheet.title)
    return dxf_text(drawing)


def _entities(space, shape: Shape) -> list:
    attribs = {"layer": shape.layer}
    if isinstance(shape, Disc):
        return [space.add_circle((shape.x, shape.y), shape.radius, dxfattribs=attribs)]
    if isinstance(shape, Area):
        return [space.add_lwpolyline(np.asarray(line).tolist(), close=True, dxfattribs=attribs) for line in shape.lines]
    if isinstance(shape, Text):
        from ezdxf.enums import TextEntityAlignment

        text = space.add_text(shape.words, height=shape.height, rotation=90 if shape.turned else 0, dxfattribs=attribs)
        align = {"start": "LEFT", "middle": "CENTER", "end": "RIGHT"}[shape.anchor]
        text.set_placement((shape.x, shape.y), align=TextEntityAlignment[align])
        return [text]
    return [space.add_lwpolyline(shape.points.tolist(), close=shape.closed, dxfattribs=attribs)]
