"""Export of circles as triangles for viewers (PLY), and for drawings and coordinate measuring (DXF)."""

import numpy as np

from stcal.drawing.formats import dxf_text, new_drawing
from stcal.sfm.interop.export.content import BOARD_RGB, Content, Photograph

EDGES = 48
"""Number of edges of a disc. Its triangles leave out 0.3 % of its area."""
ACI = 1
"""First colour of a DXF layer for readers without true colours."""
CAMERA_SHARE = 0.06
"""Depth of a camera's pyramid as a share of the scene's extent."""


def disc(radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (EDGES + 1, 3), the centre first, and triangles (EDGES, 3), counter-clockwise seen from +Z."""
    angle = 2 * np.pi * np.arange(EDGES) / EDGES
    rim = radius_mm * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(EDGES)])
    around = 1 + np.arange(EDGES)
    return np.vstack([np.zeros(3), rim]), np.column_stack([np.zeros(EDGES, int), around, 1 + around % EDGES])


def discs(content: Content, face: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns points and triangles of a face's circles, target frame, mm."""
    points, triangles, count = [], [], 0
    for circle in content.of_face(face):
        points_of_disc, triangles_of_disc = disc(circle.radius_mm)
        points.append(points_of_disc @ content.faces[face].rotation.T + circle.xyz_mm)
        triangles.append(triangles_of_disc + count)
        count += len(points_of_disc)
    return np.vstack([np.empty((0, 3)), *points]), np.vstack([np.empty((0, 3), int), *triangles])


def camera_depth_mm(content: Content) -> float:
    """Returns the depth of the pyramids that show cameras, mm."""
    places = [circle.xyz_mm for circle in content.circles]
    places += [photograph.target_from_camera.translation for photograph in content.photographs]
    return CAMERA_SHARE * float(np.ptp(np.array(places), axis=0).max())


def pyramid(content: Content, photograph: Photograph, depth_mm: float) -> np.ndarray:
    """Returns the projection centre and the image's corners at that depth, without distortion, (5, 3), target frame."""
    camera = content.camera
    corners = [[-0.5, -0.5], [camera.width - 0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]]
    corners += [[-0.5, camera.height - 0.5]]
    ideal = (np.array(corners) - camera.centre) / camera.focal
    rays = np.column_stack([ideal, np.ones(4)]) * depth_mm
    return photograph.target_from_camera @ np.vstack([np.zeros(3), rays])


def ply(content: Content) -> str:
    """Returns text PLY in double precision: coloured discs, cameras as grey pyramids, and labels as comments."""
    points, triangles, rgb, comments, count = [], [], [], [], 0
    for face in content.faces:
        points_of_face, triangles_of_face = discs(content, face)
        for place, circle in enumerate(content.of_face(face)):
            comments.append(f"vertex {count + place * (EDGES + 1)}: centre of {circle.label}")
        points.append(points_of_face)
        triangles.append(triangles_of_face + count)
        rgb += [content.rgb[face]] * len(points_of_face)
        count += len(points_of_face)
    depth = camera_depth_mm(content)
    sides = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    for photograph in content.photographs:
        comments.append(f"vertex {count}: projection centre of {photograph.name}")
        points.append(pyramid(content, photograph, depth))
        triangles.append(sides + count)
        rgb += [BOARD_RGB] * 5
        count += 5
    header = ["ply", "format ascii 1.0"]
    header += [f"comment {line}" for line in (*content.said(), "mm", *comments)]
    header += [f"element vertex {count}", *(f"property double {axis}" for axis in "xyz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    corners = np.vstack(triangles)
    header += [f"element face {len(corners)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(repr, [*p, *c])) for p, c in zip(np.vstack(points).tolist(), rgb, strict=True)]
    return "\n".join([*header, *rows, *(f"3 {a} {b} {c}" for a, b, c in corners.tolist()), ""])


def dxf(content: Content) -> str:
    """Returns DXF R2010 in mm: a layer per face with a CIRCLE and a POINT for each circle, and a layer of labels.

    Raises InputError if ``stereo-target-calibration[cad]`` is not installed.
    """
    drawing = new_drawing()
    from ezdxf.colors import rgb2int
    from ezdxf.math import OCS, Vec3

    space = drawing.modelspace()
    drawing.appids.add("STCAL")
    drawing.layers.add("LABELS", color=8)
    for place, (face, pose) in enumerate(content.faces.items()):
        layer = f"FACE_{place + 1}"
        drawing.layers.add(layer, color=ACI + place % 6, true_color=rgb2int(content.rgb[face]))
        drawing.layers.get(layer).description = f"face {face}"
        normal = Vec3(pose.rotation[:, 2])
        plane = OCS(normal)
        for circle in content.of_face(face):
            xdata = [(1000, str(circle.label))]
            if circle.sigma_mm is not None:
                xdata += [(1000, "sigma x y z, mm"), *((1040, float(v)) for v in circle.sigma_mm)]
            centre = Vec3(circle.xyz_mm)
            attributes = {"layer": layer}
            rim = space.add_circle(
                plane.from_wcs(centre), circle.radius_mm, dxfattribs=attributes | {"extrusion": normal}
            )
            point = space.add_point(centre, dxfattribs=attributes)
            for entity in (rim, point):
                entity.set_xdata("STCAL", xdata)
            text = space.add_text(
                str(circle.label),
                height=0.6 * circle.radius_mm,
                dxfattribs={"layer": "LABELS", "extrusion": normal},
            )
            text.set_placement(plane.from_wcs(centre))
    for line in content.said():
        drawing.header.custom_vars.append("stcal", line)
    return dxf_text(drawing)
