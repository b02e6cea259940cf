"""Export of a finished run for viewers: glTF 2.0, Rerun, circles as triangles (PLY), and DXF for drawings."""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stcal.drawing.formats import dxf_text, new_drawing
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.images import find_images
from stcal.io.poses.programs import metres, xyzw
from stcal.sfm.interop.export.content import BOARD_RGB, Circle, Content, Photograph, ellipsoid, exaggeration

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


MM_M = 1e-3
FLOAT, UNSIGNED = 5126, 5125
VERTICES, INDICES = 34962, 34963
LINES, TRIANGLES = 1, 4
NEAR_M = 0.01
RINGS, SEGMENTS = 8, 12
"""Numbers of rings and segments of the ball that shows σ."""
Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Quaternion x y z w that turns the target's Z to glTF's Y, which points up."""
GL_FROM_CV = np.diag([1.0, -1.0, -1.0])
"""Rotation from OpenCV's to glTF's camera axes. glTF's cameras look along −Z, with Y up."""
UNLIT = "KHR_materials_unlit"


@dataclass(slots=True, eq=False)
class _Buffer:
    """Numerical data of a file, to which arrays are added."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict] = field(default_factory=list)
    accessors: list[dict] = field(default_factory=list)

    def add(self, values: np.ndarray, target: int) -> int:
        """Adds points (n, 3), m, or indices (n,), and returns the index of their accessor."""
        points = target == VERTICES
        raw = np.ascontiguousarray(values, "<f4" if points else "<u4")
        accessor = {"bufferView": len(self.views), "componentType": FLOAT if points else UNSIGNED, "count": len(raw)}
        accessor |= {"type": "VEC3" if points else "SCALAR"}
        if points:
            accessor |= {"min": raw.min(axis=0).tolist(), "max": raw.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": raw.nbytes, "target": target}
        self.views.append(view)
        self.accessors.append(accessor)
        self.data += raw.tobytes()
        return len(self.accessors) - 1


def gltf(content: Content) -> str:
    """Returns glTF as JSON with its buffer inside."""
    tree, data = _tree(content)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode("ascii")
    return json.dumps(tree | {"buffers": [{"uri": uri, "byteLength": len(data)}]}, ensure_ascii=False, indent=1) + "\n"


def glb(content: Content) -> bytes:
    """Returns glTF as one binary file."""
    tree, data = _tree(content)
    text = json.dumps(tree | {"buffers": [{"byteLength": len(data)}]}, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _tree(content: Content) -> tuple[dict, bytes]:
    buffer, meshes, nodes = _Buffer(), [], []
    factor = exaggeration(content)
    ball, around = _ball()
    sphere = buffer.add(ball, VERTICES), buffer.add(around, INDICES)

    def mesh(name: str, parts: tuple[int, int], colour: int, mode: int = TRIANGLES) -> int:
        primitive = {"attributes": {"POSITION": parts[0]}, "indices": parts[1], "material": colour, "mode": mode}
        meshes.append({"name": name, "primitives": [primitive]})
        return len(meshes) - 1

    def node(**own) -> int:
        nodes.append({key: value for key, value in own.items() if value != []})
        return len(nodes) - 1

    below = []
    for place, (face, pose) in enumerate(content.faces.items()):
        grey = mesh(f"sigma of face {face}", sphere, len(content.faces))
        circles = []
        for circle in content.of_face(face):
            points, triangles = disc(circle.radius_mm * MM_M)
            parts = buffer.add(points, VERTICES), buffer.add(triangles.ravel(), INDICES)
            own = mesh(str(circle.label), parts, place)
            balls = [node(**_sigma(circle, pose, factor), mesh=grey)] if circle.covariance_mm2 is not None else []
            circles.append(
                node(
                    name=content.circle_frame(circle.label),
                    mesh=own,
                    translation=(MM_M * (pose.inverse() @ circle.xyz_mm)).tolist(),
                    children=balls,
                    extras=_of_circle(circle),
                )
            )
        extras = {"face": face, "target_from_face_mm": pose.matrix().tolist()}
        if face in content.covariances:
            extras["covariance_rad_mm"] = content.covariances[face].tolist()
        below.append(node(name=content.face_frame(face), **_placed(pose), children=circles, extras=extras))
    if content.photographs:
        below += _cameras(content, buffer, mesh, node)
    below_up = node(name=content.root, children=below, extras={"said": content.said(), "sigma_drawn_times": factor})
    up = node(name="y_up", rotation=Y_UP, children=[below_up])
    colours = [*(content.rgb[face] for face in content.faces), (40, 40, 40), BOARD_RGB]
    tree = {
        "asset": {"version": "2.0", "generator": content.said()[0]},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [up]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [_material(rgb) for rgb in colours],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    if content.photographs:
        tree["cameras"] = [_lens(content)]
    return tree, bytes(buffer.data)


def _cameras(content: Content, buffer: _Buffer, mesh, node) -> list[int]:
    camera_from_target = content.photographs[0].target_from_camera.inverse()
    shape = camera_from_target @ pyramid(content, content.photographs[0], camera_depth_mm(content))
    lines = np.array([0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1])
    parts = buffer.add(MM_M * shape @ GL_FROM_CV, VERTICES), buffer.add(lines, INDICES)
    frustum = mesh("image at depth", parts, len(content.faces) + 1, LINES)
    nodes = []
    for photograph in content.photographs:
        pose = Rigid(photograph.target_from_camera.rotation @ GL_FROM_CV, photograph.target_from_camera.translation)
        extras = {"group": photograph.group, "target_from_camera_mm": photograph.target_from_camera.matrix().tolist()}
        nodes.append(node(name=photograph.name, camera=0, mesh=frustum, **_placed(pose), extras=extras))
    return nodes


def _lens(content: Content) -> dict:
    """Returns a glTF camera with the field of view, and all intrinsics as extras.

    glTF supports neither distortion nor a principal point off the centre.
    """
    camera = content.camera
    parameters = {
        "model": camera.colmap_model,
        "size_px": [camera.width, camera.height],
        "focal_px": list(map(float, camera.focal)),
        "centre_px": list(map(float, camera.centre)),
        "distortion": list(map(float, camera.distortion)),
    }
    return {
        "name": "camera",
        "type": "perspective",
        "perspective": {
            "yfov": 2 * float(np.arctan(camera.height / 2 / camera.focal[1])),
            "aspectRatio": float(camera.width / camera.focal[0] / (camera.height / camera.focal[1])),
            "znear": NEAR_M,
        },
        "extras": parameters,
    }


def _sigma(circle: Circle, pose: Rigid, factor: float) -> dict:
    """Returns the node that turns the unit ball into the ellipsoid of σ in the face's axes, times ``factor``."""
    sigma, axes = ellipsoid(circle, pose)
    turned = xyzw(Rigid(axes, np.zeros(3)))
    size = (factor * MM_M * sigma).tolist()
    return {"name": f"sigma of {circle.label}, times {factor:g}", "rotation": turned, "scale": size}


def _of_circle(circle: Circle) -> dict:
    extras = {"label": str(circle.label), "xyz_mm": circle.xyz_mm.tolist(), "radius_mm": circle.radius_mm}
    return extras if circle.covariance_mm2 is None else extras | {"covariance_mm2": circle.covariance_mm2.tolist()}


def _placed(pose: Rigid) -> dict:
    return {"translation": metres(pose), "rotation": xyzw(pose)}


def _material(rgb: tuple[int, int, int]) -> dict:
    linear = [((v / 255 + 0.055) / 1.055) ** 2.4 if v > 10 else v / 255 / 12.92 for v in rgb]
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}}


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Returns points (n, 3) of the unit sphere, and the corners of its triangles (3t,)."""
    polar, turn = np.pi * np.arange(RINGS + 1) / RINGS, 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    p, t = (v.ravel() for v in np.meshgrid(polar, turn, indexing="ij"))
    points = np.column_stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)])
    ring, segment = (v.ravel() for v in np.meshgrid(np.arange(RINGS), np.arange(SEGMENTS), indexing="ij"))
    corner, next_corner = ring * SEGMENTS + segment, ring * SEGMENTS + (segment + 1) % SEGMENTS
    quads = np.column_stack(
        [corner, corner + SEGMENTS, next_corner, next_corner, corner + SEGMENTS, next_corner + SEGMENTS]
    )
    return points, quads.ravel()


CORNER_PX = 0.5
"""Offset of Rerun's pixel origin, which is the corner of the image."""
MEDIA = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}
APPLICATION = "stcal"


def write_rrd(content: Content, path: Path) -> list[str]:
    """Writes a recording of Rerun, and returns notes on photographs that it lacks.

    JPEG and PNG photographs are copied as they are. Each is a step of the time line ``photograph``. The file is written
    here: Rerun's own writer tries for ever where the disk is full.

    Raises InputError if ``stereo-target-calibration[rerun]`` is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise InputError(
            "E-EXTRA-MISSING", "Rerun: needs rerun-sdk; install stereo-target-calibration[rerun]"
        ) from error
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{APPLICATION}-{content.run.folder.name}")
    stream = recording.binary_stream()
    factor = exaggeration(content)
    root = f"world/{_part(content.root)}"
    about = [*content.said(), f"ellipsoids: sigma, {factor:g} times as large"]
    about.append("cameras are drawn without their distortion; circles found are those of the photographs as they are")
    recording.log("about", rr.TextDocument("\n\n".join(about), media_type="text/markdown"), static=True)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for face, pose in content.faces.items():
        circles = content.of_face(face)
        entity = f"{root}/{_part(face)}"
        pose_of_face = rr.Transform3D(translation=pose.translation, quaternion=rr.Quaternion(xyzw=xyzw(pose)))
        recording.log(entity, pose_of_face, rr.TransformAxes3D(20.0), static=True)
        centres = np.array([pose.inverse() @ circle.xyz_mm for circle in circles]).reshape(-1, 3)
        names = [str(circle.label) for circle in circles]
        flat = [[circle.radius_mm, circle.radius_mm, 0.0] for circle in circles]
        discs = rr.Ellipsoids3D(
            centers=centres, half_sizes=flat, colors=content.rgb[face], labels=names, show_labels=False, fill_mode=3
        )
        recording.log(f"{entity}/circles", discs, static=True)
        uncertain = [
            (centre, circle)
            for centre, circle in zip(centres, circles, strict=True)
            if circle.covariance_mm2 is not None
        ]
        if uncertain:
            parts = [ellipsoid(circle, pose) for _, circle in uncertain]
            ellipsoids = rr.Ellipsoids3D(
                centers=[centre for centre, _ in uncertain],
                half_sizes=[factor * sigma for sigma, _ in parts],
                quaternions=[rr.Quaternion(xyzw=xyzw(Rigid(axes, np.zeros(3)))) for _, axes in parts],
                colors=(40, 40, 40),
            )
            recording.log(f"{entity}/sigma", ellipsoids, static=True)
    for group, dots in content.boards.items():
        recording.log(f"world/board/{_part(group)}", rr.Points3D(dots, colors=BOARD_RGB, radii=1.0), static=True)
    with open(path, "wb") as file:
        missing = _photographs(content, recording, rr, lambda: file.write(stream.read() or b""))
    recording.disconnect()
    return missing


def _photographs(content: Content, recording, rr, write: Callable[[], object]) -> list[str]:
    """Adds the photographs. ``write`` : called after each, writes what has been added, so that memory holds one."""
    files = {}
    if content.run.images.is_dir():
        files = {item.name: item for item in find_images(content.run.images)[0]}
    camera, depth = content.camera, camera_depth_mm(content)
    observations = {item.name: item for item in content.run.observations}
    missing, unreadable = [], []
    for place, photograph in enumerate(content.photographs):
        recording.set_time("photograph", sequence=place)
        entity = f"world/cameras/{_part(photograph.name)}"
        pose = photograph.target_from_camera
        recording.log(entity, rr.Transform3D(translation=pose.translation, quaternion=rr.Quaternion(xyzw=xyzw(pose))))
        lens = rr.Pinhole(
            focal_length=camera.focal,
            principal_point=camera.centre + CORNER_PX,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=depth,
        )
        recording.log(f"{entity}/image", lens)
        observed = observations[photograph.name]
        colours = [content.rgb.get(label.plane, BOARD_RGB) for label in observed.labels]
        centres = rr.Points2D(
            observed.centre_px + CORNER_PX,
            colors=colours,
            labels=list(map(str, observed.labels)),
            show_labels=False,
            radii=3.0,
        )
        recording.log(f"{entity}/image/circles", centres)
        file = files.get(photograph.name)
        suffix = "" if file is None else file.path.suffix.lower()
        if file is None:
            missing.append(photograph.name)
        elif suffix not in MEDIA:
            unreadable.append(photograph.name)
        else:
            picture = rr.EncodedImage(contents=file.read(), media_type=MEDIA[suffix])
            recording.log(f"{entity}/image", picture)
        write()
    write()
    lines = []
    if missing:
        lines.append(f"{len(missing)} photographs are no longer in {content.run.images}, {missing[0]} first: left out")
    if unreadable:
        lines.append(f"{len(unreadable)} photographs are neither JPEG nor PNG, {unreadable[0]} first: left out")
    return lines


def _part(name: str) -> str:
    """Returns a name as part of an entity's path, with special characters escaped."""
    return "".join(c if c.isalnum() or c in "-_." else "\\" + c for c in name)
