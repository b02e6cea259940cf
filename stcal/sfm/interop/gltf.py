"""Export of a finished run for viewers: glTF 2.0."""

import base64
import json
import struct
from dataclasses import dataclass, field

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.io.static_transforms import metres, xyzw
from stcal.sfm.interop.export_content import BOARD_RGB, Circle, Content

EDGES = 48  # number of edges of a disc. Its triangles leave out 0.3 % of its area.
CAMERA_SHARE = 0.06  # depth of a camera's pyramid as a share of the scene's extent


MM_M = 1e-3
FLOAT, UNSIGNED = 5126, 5125
VERTICES, INDICES = 34962, 34963
LINES, TRIANGLES = 1, 4
NEAR_M = 0.01
RINGS, SEGMENTS = 8, 12  # numbers of rings and segments of the ball that shows σ
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
    factor = _exaggeration(content)
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
            points, triangles = _disc(circle.radius_mm * MM_M)
            parts = buffer.add(points, VERTICES), buffer.add(triangles.ravel(), INDICES)
            own = mesh(str(circle.label), parts, place)
            balls = [node(**_sigma(circle, pose, factor), mesh=grey)] if circle.covariance_mm2 is not None else []
            extras = {"label": str(circle.label), "xyz_mm": circle.xyz_mm.tolist(), "radius_mm": circle.radius_mm}
            if circle.covariance_mm2 is not None:
                extras["covariance_mm2"] = circle.covariance_mm2.tolist()
            circles.append(
                node(
                    name=content.circle_frame(circle.label),
                    mesh=own,
                    translation=(MM_M * (pose.inverse() @ circle.xyz_mm)).tolist(),
                    children=balls,
                    extras=extras,
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
    materials = []
    for rgb in (*(content.rgb[face] for face in content.faces), (40, 40, 40), BOARD_RGB):
        linear = [((v / 255 + 0.055) / 1.055) ** 2.4 if v > 10 else v / 255 / 12.92 for v in rgb]
        surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
        materials.append({"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}})
    tree = {
        "asset": {"version": "2.0", "generator": content.said()[0]},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [up]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    if content.photographs:
        tree["cameras"] = [_lens(content)]
    return tree, bytes(buffer.data)


def _cameras(content: Content, buffer: _Buffer, mesh, node) -> list[int]:
    camera, places = content.camera, [circle.xyz_mm for circle in content.circles]
    places += [photograph.target_from_camera.translation for photograph in content.photographs]
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    rays = np.column_stack([(corners - camera.centre) / camera.focal, np.ones(4)])  # without distortion
    shape = np.vstack([np.zeros(3), CAMERA_SHARE * np.ptp(np.array(places), axis=0).max() * rays])
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
    """Returns a glTF camera with the field of view, and as extras all intrinsics, which glTF does not support."""
    camera = content.camera
    return {
        "name": "camera",
        "type": "perspective",
        "perspective": {
            "yfov": 2 * float(np.arctan(camera.height / 2 / camera.focal[1])),
            "aspectRatio": float(camera.width / camera.focal[0] / (camera.height / camera.focal[1])),
            "znear": NEAR_M,
        },
        "extras": {
            "model": camera.colmap_model,
            "size_px": [camera.width, camera.height],
            "focal_px": camera.focal.tolist(),
            "centre_px": camera.centre.tolist(),
            "distortion": camera.distortion.tolist(),
        },
    }


def _sigma(circle: Circle, pose: Rigid, factor: float) -> dict:
    """Returns the node that turns the unit ball into the ellipsoid of σ in the face's axes, times ``factor``."""
    turn = np.array(pose.rotation)
    values, axes = np.linalg.eigh(turn.T @ np.array(circle.covariance_mm2) @ turn)
    turned = xyzw(Rigid(axes * [np.sign(np.linalg.det(axes)), 1, 1], np.zeros(3)))
    size = (factor * MM_M * np.sqrt(np.maximum(values, 0))).tolist()
    return {"name": f"sigma of {circle.label}, times {factor:g}", "rotation": turned, "scale": size}


def _disc(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (EDGES + 1, 3), the centre first, and triangles (EDGES, 3), counter-clockwise seen from +Z."""
    angle = 2 * np.pi * np.arange(EDGES) / EDGES
    rim = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(EDGES)])
    around = 1 + np.arange(EDGES)
    return np.vstack([np.zeros(3), rim]), np.column_stack([np.zeros(EDGES, int), around, 1 + around % EDGES])


def _exaggeration(content: Content) -> float:
    """Returns the factor with which σ is drawn, a power of ten. The median ball is no larger than the median circle."""
    known = [(float(np.linalg.norm(c.sigma_mm)), c.radius_mm) for c in content.circles if c.sigma_mm is not None]
    if not any(sigma for sigma, _ in known):
        return 1.0
    sigma, radius = np.median(known, axis=0)
    return 10.0 ** np.floor(np.log10(radius / sigma))


def _placed(pose: Rigid) -> dict:
    return {"translation": metres(pose), "rotation": xyzw(pose)}


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
