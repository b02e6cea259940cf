"""Agisoft Metashape's cameras: a single lens (``<calibration>``), or all sensors of exported cameras, with covariances.

The principal point is relative to the middle of the image; ``b1`` is the horizontal minus the vertical focal length;
``p1`` and ``p2`` are OpenCV's p2 and p1 (Metashape Professional's user manual, appendix D). An adjusted calibration has
a ``<covariance>`` of its adjusted parameters, in the units of the parameters.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import CovarianceRows, require_covariance
from stcal.geometry.camera import COLMAP_PIXEL_ORIGIN, FISHEYE, PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.io.cameras.camera_model import CameraModel, camera_from_opencv
from stcal.io.cameras.foreign_lenses import ForeignLens, one_of, refused, require_finite, without_matrix
from stcal.io.cameras.keys import pass_over, require_known

NAMES = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
MORE_NAMES = ("p3", "p4")
"""Parameters of Metashape up to version 1.8, and of PhotoScan, that later ones have not."""
OTHER_KEYS = ("projection", "width", "height", "resolution")
HARMLESS = ("date", "class", "type", "filmcamera", "sensorid")
ROOTS = ("document", "chunk", "sensors", "sensor")  # root elements of files with sensors
KINDS = ("frame", "fisheye", "equidistant_fisheye")
HELD_PX = 1e-3
"""σ of a parameter that was held fixed, as its effect at the image's corner, px; 0 would be singular."""
OWN = {"f": "fy", "p1": "p2", "p2": "p1"} | {name: name for name in ("cx", "cy", "k1", "k2", "k3", "k4")}
"""OpenCV's names of Metashape's parameters; ``b1`` and ``f`` together are fx."""


def is_metashape(text: str) -> bool:
    """Return True if a text is XML with an element of Metashape around it; ParseError if it is broken XML."""
    return text.lstrip().startswith("<") and ElementTree.fromstring(text).tag in ("calibration", *ROOTS)


def from_calibration(root: ElementTree.Element) -> CameraModel | ForeignLens:
    """Return the camera of a ``<calibration>``; a foreign lens with b2, p3, p4, or of a frame camera with k4."""
    texts: dict[str, str] = {}
    for child in root:
        if child.tag in texts:
            raise InputError("E-CAMERA-REPEATED", f"{child.tag[:40]} twice; leave one in")
        texts[child.tag] = (child.text or "").strip()
    kind = texts.get("projection", root.get("type", "frame"))
    if kind not in KINDS:
        raise InputError("E-CAMERA-MODEL", f"projection {kind}; frame and fisheye are read")
    names = (*NAMES, *MORE_NAMES)
    unread = {key: text for key, text in (texts | root.attrib).items() if key not in (*names, *OTHER_KEYS)}
    require_known(unread, HARMLESS)
    v = {name: float(texts.get(name, 0) or 0) for name in names}
    size = root.find("resolution")
    stated = texts if size is None else size.attrib
    width, height = float(stated["width"]), float(stated["height"])
    centre = width / 2 + v["cx"] - COLMAP_PIXEL_ORIGIN, height / 2 + v["cy"] - COLMAP_PIXEL_ORIGIN
    distortion = np.array([v["k1"], v["k2"], v["p2"], v["p1"], v["k3"], v["k4"]])
    lens = [v["f"] + v["b1"], v["f"], *centre]
    if v["b2"] or v["p3"] or v["p4"] or (v["k4"] and kind == "frame"):
        return _foreign(v, lens, kind, width, height)
    if kind == "frame":
        return camera_from_opencv(lens, distortion[:5], False, width, height)
    return camera_from_opencv(lens, distortion, True, width, height, tangential=True)


def _foreign(v: Mapping[str, float], lens, kind: str, width: float, height: float) -> ForeignLens:
    """Return the lens by Metashape's formula (PhotoScan's manual, version 1.2, appendix C, with ``p3`` and ``p4``)."""
    camera_from_opencv(lens, np.array([v["k1"], v["k2"], 0, 0]), False, width, height)  # refuses impossible values
    require_finite([v[name] for name in (*NAMES, *MORE_NAMES)])
    ideal = without_matrix(np.zeros(12), kind != "frame")

    def distorted(rays: np.ndarray) -> np.ndarray:
        x, y = ideal(rays[:, :2] / rays[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + r2 * (v["k1"] + r2 * (v["k2"] + r2 * (v["k3"] + r2 * v["k4"])))
        grown = 1 + r2 * (v["p3"] + r2 * v["p4"])
        across = v["p1"] * (r2 + 2 * x * x) + 2 * v["p2"] * x * y
        up = v["p2"] * (r2 + 2 * y * y) + 2 * v["p1"] * x * y
        return np.column_stack([x * radial + across * grown, y * radial + up * grown])

    own = ", ".join(f"{name} = {v[name]:g}" for name in ("b2", "k4", "p3", "p4") if v[name])
    return ForeignLens.of(f"Metashape's lens with {own}", lens, distorted, (width, height), v["b2"])


def from_metashape(text: str, choice: str) -> CameraModel | ForeignLens:
    """Return the lens of a ``<calibration>``, or a sensor of exported cameras or ``doc.xml``, with covariance."""
    root, sensors = ElementTree.fromstring(text), {}
    if root.tag == "calibration":
        return from_calibration(root)
    for number, sensor in enumerate(root.iter("sensor")):
        calibrations = sensor.findall("calibration")
        adjusted = [item for item in calibrations if item.get("class", "adjusted") == "adjusted"] or calibrations
        if adjusted:
            name = sensor.get("label") or sensor.get("id") or str(number)
            sensors[name if name not in sensors else f"{name} {number}"] = (adjusted[-1], sensor.find("covariance"))
    if not sensors:
        raise InputError("E-CAMERA-NONE", "no sensor with a calibration; export the cameras after alignment")
    chosen, covariance = sensors[one_of(list(sensors), choice)]
    pass_over(["poses of the photographs"] if root.find(".//camera/transform") is not None else [])
    camera = from_calibration(chosen)
    if covariance is None:
        return camera
    if isinstance(camera, ForeignLens):
        pass_over(["σ and correlations of the parameters"])
        return camera
    return _with_covariance(camera, covariance)


def _with_covariance(camera: CameraModel, stated: ElementTree.Element) -> CameraModel:
    names = (stated.findtext("params") or "").split()
    try:
        matrix = np.array((stated.findtext("coeffs") or "").split(), float)
        if not names or set(names) - set(NAMES) or len(set(names)) < len(names) or len(matrix) != len(names) ** 2:
            raise InputError("E-CAMERA-COVARIANCE", f"{len(names)} parameters, {len(matrix)} numbers")
        matrix = matrix.reshape(len(names), -1)
        require_covariance(matrix, len(names), CovarianceRows(tuple(names)))
    except (InputError, ValueError) as error:
        raise InputError("E-CAMERA-COVARIANCE", f"<covariance>: {error}; export the cameras again") from error
    if "b2" in names:
        raise InputError("E-CAMERA-MODEL", "b2 was adjusted, but OpenCV's model does not have it; fit without it")
    camera = replace(camera, colmap_model=_model(camera.colmap_model, names))
    by_theirs = np.linalg.pinv(_theirs_by_ours())[:, [NAMES.index(name) for name in names]]
    basis = intrinsic_basis(camera.colmap_model)
    to_model = np.linalg.pinv(basis)
    covariance = to_model @ by_theirs @ matrix @ by_theirs.T @ to_model.T
    adjusted = to_model @ by_theirs
    held = np.array([not row.any() for row in adjusted])
    if not {"f", "b1"} <= set(names) and basis[:2].any(axis=0).sum() == 2:
        held[0] = True
    held_sigma = (to_model @ np.diag(_edge(camera)) @ to_model.T).diagonal()
    return replace(camera, covariance=covariance + np.diag(np.where(held, held_sigma**2, 0.0)))


def _model(colmap_model: str, names: list[str]) -> str:
    adjusted = set(names)
    if FISHEYE in colmap_model:
        return "THIN_PRISM_FISHEYE" if {"p1", "p2"} & adjusted else colmap_model
    if {"k3", "k4"} & adjusted:
        return "FULL_OPENCV"
    return "OPENCV" if {"k1", "k2", "p1", "p2"} & adjusted and colmap_model != "FULL_OPENCV" else colmap_model


def _theirs_by_ours() -> np.ndarray:
    """Return the derivative (11, 16) of :data:`NAMES` by :data:`PARAMETER_NAMES`."""
    rows = np.array([[float(OWN.get(theirs) == ours) for ours in PARAMETER_NAMES] for theirs in NAMES])
    rows[NAMES.index("b1"), :2] = [1, -1]
    return rows


def _edge(camera: CameraModel) -> np.ndarray:
    """Return the change of each parameter (16,) that moves the corner of the image by :data:`HELD_PX`."""
    width, height = camera.width or 2 * camera.centre[0], camera.height or 2 * camera.centre[1]
    focal = float(camera.focal.mean())
    reach = np.hypot(width, height) / 2 / focal
    powers = np.array([3, 5, 2, 2, 7, 9, 11, 13, 2, 4, 2, 4])
    if FISHEYE not in camera.colmap_model:
        powers[5:8] = [3, 5, 7]  # k4, k5, k6 are in the denominator
    return HELD_PX * np.concatenate([[1 / reach] * 2, [1.0] * 2, reach ** -powers.astype(float) / focal])


def _values(camera: Camera, form: str) -> dict[str, float]:
    k1, k2, p1, p2, k3, k4, *rest = camera.distortion.tolist()
    if any(rest) or (k4 and not camera.fisheye):
        raise refused(camera, form, "k4 to k6 and prisms")
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    centre = cx + COLMAP_PIXEL_ORIGIN - camera.width / 2, cy + COLMAP_PIXEL_ORIGIN - camera.height / 2
    return dict(zip(NAMES, (fy, *centre, fx - fy, 0.0, k1, k2, k3, k4, p2, p1), strict=True))


def calibration(camera: Camera) -> str:
    """Return the text of a ``<calibration>`` : the lens only; refuse one that Metashape has no model for."""
    root = ElementTree.Element("calibration")
    parts = {"projection": _kind(camera), "width": camera.width, "height": camera.height}
    for tag, value in (parts | _values(camera, "metashape")).items():
        ElementTree.SubElement(root, tag).text = str(value) if tag in parts else repr(float(value))
    return _text(root)


def cameras(camera: Camera, name: str) -> str:
    """Return the text of exported cameras with one sensor and no image; errors as :func:`calibration`."""
    values = _values(camera, "metashape-cameras")
    size = {"width": str(camera.width), "height": str(camera.height)}
    root = ElementTree.Element("document", version="1.5.0")
    chunk = ElementTree.SubElement(root, "chunk", label="stcal", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id="1")
    sensor = ElementTree.SubElement(sensors, "sensor", id="0", label=name, type=_kind(camera))
    ElementTree.SubElement(sensor, "resolution", size)
    element = ElementTree.SubElement(sensor, "calibration", {"type": _kind(camera), "class": "adjusted"})
    ElementTree.SubElement(element, "resolution", size)
    for tag, value in values.items():
        ElementTree.SubElement(element, tag).text = repr(float(value))
    if camera.covariance is not None:
        rows = _theirs_by_ours()
        if not camera.fisheye:
            rows[NAMES.index("k4")] = 0  # OpenCV's k4 is another parameter
        by_model = rows @ intrinsic_basis(camera.colmap_model)
        present = np.flatnonzero(by_model.any(axis=1))
        matrix = by_model[present] @ camera.covariance @ by_model[present].T
        stated = ElementTree.SubElement(sensor, "covariance")
        ElementTree.SubElement(stated, "params").text = " ".join(NAMES[i] for i in present)
        ElementTree.SubElement(stated, "coeffs").text = " ".join(map(repr, matrix.ravel().tolist()))
    return _text(root)


def without_sigma(camera: Camera) -> list[str]:
    """Return the parameters, all of them 0, for whose σ Metashape has no place."""
    rational = not camera.fisheye and camera.colmap_model == "FULL_OPENCV"
    prisms = camera.colmap_model == "THIN_PRISM_FISHEYE"
    return ["σ of k4, k5 and k6"] * rational + ["σ of the thin prisms"] * prisms


def _kind(camera: Camera) -> str:
    return "fisheye" if camera.fisheye else "frame"


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'
