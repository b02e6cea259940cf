"""Faces, circles with their σ, and cameras for viewers: glTF 2.0, as JSON with its buffer inside or as one binary file.

The format is JSON and a block of numbers; libraries for it hold meshes only, or the same JSON as classes.
"""

import base64
import json
import struct
from dataclasses import dataclass, field

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.io.poses.static import metres, xyzw
from stcal.sfm.interop.export.content import BOARD_RGB, Circle, Content, ellipsoid, exaggeration
from stcal.sfm.interop.export.solids import camera_depth_mm, disc, pyramid

MM_M = 1e-3
FLOAT, UNSIGNED = 5126, 5125
VERTICES, INDICES = 34962, 34963
LINES, TRIANGLES = 1, 4
NEAR_M = 0.01
RINGS, SEGMENTS = 8, 12
"""Of the ball that shows σ."""
Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Quaternion x y z w: the target's Z upwards, as glTF has Y."""
GL_FROM_CV = np.diag([1.0, -1.0, -1.0])
"""glTF's cameras look along −Z, Y up."""
UNLIT = "KHR_materials_unlit"


@dataclass(slots=True, eq=False)
class _Buffer:
    """Numbers of the file as they gather."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict] = field(default_factory=list)
    accessors: list[dict] = field(default_factory=list)

    def add(self, values: np.ndarray, target: int) -> int:
        """Accessor of points (n, 3), m, or of indices (n,)."""
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
    """JSON with its buffer inside."""
    tree, data = _tree(content)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode("ascii")
    return json.dumps(tree | {"buffers": [{"uri": uri, "byteLength": len(data)}]}, ensure_ascii=False, indent=1) + "\n"


def glb(content: Content) -> bytes:
    """One binary file."""
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
    found = []
    for each in content.photographs:
        pose = Rigid(each.target_from_camera.rotation @ GL_FROM_CV, each.target_from_camera.translation)
        extras = {"group": each.group, "target_from_camera_mm": each.target_from_camera.matrix().tolist()}
        found.append(node(name=each.name, camera=0, mesh=frustum, **_placed(pose), extras=extras))
    return found


def _lens(content: Content) -> dict:
    """glTF knows field of view alone: no distortion, principal point in the middle."""
    camera = content.camera
    own = {
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
        "extras": own,
    }


def _sigma(circle: Circle, pose: Rigid, factor: float) -> dict:
    """The ball of radius 1 m as the ellipsoid of σ in the face's axes, ``factor`` times as large."""
    sigma, axes = ellipsoid(circle, pose)
    turned = xyzw(Rigid(axes, np.zeros(3)))
    size = (factor * MM_M * sigma).tolist()
    return {"name": f"sigma of {circle.label}, times {factor:g}", "rotation": turned, "scale": size}


def _of_circle(circle: Circle) -> dict:
    own = {"label": str(circle.label), "xyz_mm": circle.xyz_mm.tolist(), "radius_mm": circle.radius_mm}
    return own if circle.covariance_mm2 is None else own | {"covariance_mm2": circle.covariance_mm2.tolist()}


def _placed(pose: Rigid) -> dict:
    return {"translation": metres(pose), "rotation": xyzw(pose)}


def _material(rgb: tuple[int, int, int]) -> dict:
    linear = [((v / 255 + 0.055) / 1.055) ** 2.4 if v > 10 else v / 255 / 12.92 for v in rgb]
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}}


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of radius 1, and corners of triangles (3t,)."""
    polar, turn = np.pi * np.arange(RINGS + 1) / RINGS, 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    p, t = (v.ravel() for v in np.meshgrid(polar, turn, indexing="ij"))
    points = np.column_stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)])
    ring, segment = (v.ravel() for v in np.meshgrid(np.arange(RINGS), np.arange(SEGMENTS), indexing="ij"))
    here, beside = ring * SEGMENTS + segment, ring * SEGMENTS + (segment + 1) % SEGMENTS
    quads = np.column_stack([here, here + SEGMENTS, beside, beside, here + SEGMENTS, beside + SEGMENTS])
    return points, quads.ravel()
