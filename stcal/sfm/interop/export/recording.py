"""A run as a recording of the Rerun viewer: photographs, what was found in them, cameras, target with its σ."""

from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.images import find_images
from stcal.io.poses.static import xyzw
from stcal.sfm.interop.export.content import BOARD_RGB, Content, ellipsoid, exaggeration
from stcal.sfm.interop.export.solids import camera_depth_mm

CORNER_PX = 0.5
"""Rerun counts pixels from the image's corner."""
MEDIA = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}
APPLICATION = "stcal"


def write_rrd(content: Content, path: Path) -> list[str]:
    """Write it; what it lacks is returned in lines.

    Photographs are in it as their files are, where those are JPEG or PNG. A step of the time ``photograph`` each.

    Raises
    ------
    InputError
        ``stcal[rerun]`` is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise InputError("E-EXTRA-MISSING", "Rerun: needs rerun-sdk; install stcal[rerun]") from error
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{APPLICATION}-{content.run.folder.name}")
    recording.save(path)
    factor = exaggeration(content)
    root = f"world/{_part(content.root)}"
    said = [*content.said(), f"ellipsoids: sigma, {factor:g} times as large"]
    said.append("cameras are drawn without their distortion; circles found are those of the photographs as they are")
    recording.log("about", rr.TextDocument("\n\n".join(said), media_type="text/markdown"), static=True)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for face, pose in content.faces.items():
        own = content.of_face(face)
        where = f"{root}/{_part(face)}"
        placed = rr.Transform3D(translation=pose.translation, quaternion=rr.Quaternion(xyzw=xyzw(pose)))
        recording.log(where, placed, rr.TransformAxes3D(20.0), static=True)
        centres = np.array([pose.inverse() @ circle.xyz_mm for circle in own]).reshape(-1, 3)
        names = [str(circle.label) for circle in own]
        flat = [[circle.radius_mm, circle.radius_mm, 0.0] for circle in own]
        shown = rr.Ellipsoids3D(
            centers=centres, half_sizes=flat, colors=content.rgb[face], labels=names, show_labels=False, fill_mode=3
        )
        recording.log(f"{where}/circles", shown, static=True)
        known = [(at, circle) for at, circle in zip(centres, own, strict=True) if circle.covariance_mm2 is not None]
        if known:
            parts = [ellipsoid(circle, pose) for _, circle in known]
            ellipsoids = rr.Ellipsoids3D(
                centers=[at for at, _ in known],
                half_sizes=[factor * sigma for sigma, _ in parts],
                quaternions=[rr.Quaternion(xyzw=xyzw(Rigid(axes, np.zeros(3)))) for _, axes in parts],
                colors=(40, 40, 40),
            )
            recording.log(f"{where}/sigma", ellipsoids, static=True)
    for group, dots in content.boards.items():
        recording.log(f"world/board/{_part(group)}", rr.Points3D(dots, colors=BOARD_RGB, radii=1.0), static=True)
    missing = _photographs(content, recording, rr)
    recording.flush()
    recording.disconnect()
    return missing


def _photographs(content: Content, recording, rr) -> list[str]:
    files = {}
    if content.run.images.is_dir():
        files = {each.name: each.path for each in find_images(content.run.images)[0]}
    camera, depth = content.camera, camera_depth_mm(content)
    found = {each.name: each for each in content.run.observations}
    absent, unread = [], []
    for place, photograph in enumerate(content.photographs):
        recording.set_time("photograph", sequence=place)
        where = f"world/cameras/{_part(photograph.name)}"
        pose = photograph.target_from_camera
        recording.log(where, rr.Transform3D(translation=pose.translation, quaternion=rr.Quaternion(xyzw=xyzw(pose))))
        lens = rr.Pinhole(
            focal_length=camera.focal,
            principal_point=camera.centre + CORNER_PX,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=depth,
        )
        recording.log(f"{where}/image", lens)
        own = found[photograph.name]
        colours = [content.rgb.get(label.plane, BOARD_RGB) for label in own.labels]
        spots = rr.Points2D(
            own.centre_px + CORNER_PX,
            colors=colours,
            labels=list(map(str, own.labels)),
            show_labels=False,
            radii=3.0,
        )
        recording.log(f"{where}/image/circles", spots)
        path = files.get(photograph.name)
        if path is None:
            absent.append(photograph.name)
        elif path.suffix.lower() not in MEDIA:
            unread.append(photograph.name)
        else:
            picture = rr.EncodedImage(contents=path.read_bytes(), media_type=MEDIA[path.suffix.lower()])
            recording.log(f"{where}/image", picture)
    lines = []
    if absent:
        lines.append(f"{len(absent)} photographs are no longer in {content.run.images}, {absent[0]} first: left out")
    if unread:
        lines.append(f"{len(unread)} photographs are neither JPEG nor PNG, {unread[0]} first: left out")
    return lines


def _part(name: str) -> str:
    """A part of an entity's path."""
    return "".join(c if c.isalnum() or c in "-_." else "\\" + c for c in name)
