"""What each form of camera files holds: every lens is written, read back and compared, lenses of other programs are
fitted, and their files compared with OpenCV's projection, or the programs' formulas, of the numbers that stand in them.

.venv/bin/python scripts/studies/camera_formats.py
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np

from scripts.runner import head, row, script
from stcal.errors import InputError, InputNote
from stcal.geometry.camera import Camera, parameter_names
from stcal.io.cameras.difference import fit_lens
from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import WRITERS, read_lens
from tests.io import camera_files

WIDTH, HEIGHT = 1280, 961
LENSES = {
    "perspective": ("PINHOLE", []),
    "k1 k2 p1 p2": ("OPENCV", [-0.1, 0.03, 1e-3, -2e-3]),
    "k1 … k6": ("FULL_OPENCV", [-0.1, 0.03, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003]),
    "equidistant k1 … k4": ("OPENCV_FISHEYE", [0.02, -0.01, 0, 0, 3e-3, -1e-3]),
    "equidistant with prisms": ("THIN_PRISM_FISHEYE", [0.02, -0.01, 1e-3, -2e-3, 3e-3, -1e-3, 0, 0, 1e-3, 0, -1e-3]),
}
EXACT_PX = 1e-9
OPENCV = "image_width: {0}\nimage_height: {1}\n"
NARROW = (
    OPENCV + "camera_matrix: [812, {2}, 640, 0, 809, 478, 0, 0, 1]\ndistortion_coefficients: [-0.1, 0.03, 0.001, -0.002"
)
PRISMS = "0.02 -0.01 0.003 -0.002 0.001 -0.0003 0.001 -0.002 0.001 -0.0002 0.0005 0.0001"
FRAME = (
    "<projection>frame</projection><width>{0}</width><height>{1}</height><f>812</f><cx>0</cx><cy>0</cy><k1>-0.1</k1>"
)
TRIED = {
    ("COLMAP", "FOV"): "1 FOV {0} {1} 812 809 640 478 0.9",
    ("COLMAP", "DIVISION"): "1 DIVISION {0} {1} 812 809 640 478 -0.2",
    ("COLMAP", "EUCM"): "1 EUCM {0} {1} 812 809 640 478 0.6 1.1",
    ("COLMAP", "RAD_TAN_THIN_PRISM_FISHEYE"): "1 RAD_TAN_THIN_PRISM_FISHEYE {0} {1} 812 809 640 478 " + PRISMS,
    ("OpenCV", "thin prisms"): NARROW.replace("{2}", "0") + ", 0.01, 0, 0, 0, 0.001, -0.0002, -0.001, 0.0001]",
    ("OpenCV", "tilted sensor"): NARROW.replace("{2}", "0") + ", 0.01, 0, 0, 0, 0, 0, 0, 0, 0.002, -0.003]",
    ("OpenCV", "omnidir"): OPENCV + "camera_matrix: [920, 0, 641, 0, 921, 479, 0, 0, 1]\nxi: 1.2\n"
    "distortion_coefficients: [-0.31, 0.12, 0.0003, -0.0002]",
    ("OpenCV", "skew"): NARROW.replace("{2}", "0.5") + "]\ndistortion_model: plumb_bob",
    ("Metashape", "frame, p3, p4"): f"<calibration>{FRAME}<k2>0.03</k2><p1>0.001</p1><p2>-0.002</p2><p3>0.8</p3>"
    "<p4>-0.4</p4></calibration>",
    ("mrcal", "CAHVOR"): "{{'lensmodel': 'LENSMODEL_CAHVOR', 'imagersize': [{0}, {1}], "
    "'intrinsics': [812, 809, 640, 478, 0.01, -0.02, 0.002, -0.1, 0.03]}}",
    ("Kalibr", "omni, radtan"): "cam0:\n  camera_model: omni\n  intrinsics: [1.2, 1400, 1402, 640, 478]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [-0.2, 0.1, 0.001, -0.001]\n  resolution: [{0}, {1}]",
    ("Kalibr", "ds"): "cam0:\n  camera_model: ds\n  intrinsics: [-0.2, 0.55, 420, 421, 640, 478]\n"
    "  distortion_model: none\n  resolution: [{0}, {1}]",
}
"""Program, model, and the file of a lens of it."""


def camera_of(model: str, k: list[float]) -> Camera:
    camera = Camera(
        WIDTH, HEIGHT, [812.25, 809.5], [640.125, 478.0625], np.pad(k, (0, 12 - len(k))), "FISHEYE" in model
    )
    q = len(parameter_names(model))
    return Camera.of(camera, model, np.diag(np.full(q, 1e-4)))


def off_px(one: Camera, two: Camera) -> float:
    xy = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.5, 0.5, 11)), axis=-1).reshape(-1, 2)
    return float(np.abs(one.pixel_from_normalised(xy) - two.pixel_from_normalised(xy)).max())


def held(form: str, folder: Path) -> list[str]:
    """Cells of a form: what comes back exactly, what is refused, and what is lost."""
    back, refused, lost = [], [], set()
    for name, (model, k) in LENSES.items():
        camera = camera_of(model, k)
        try:
            made = WRITERS[form](camera, "cam0")
        except InputError:
            refused.append(name)
            continue
        path = folder / "camera"
        path.write_bytes(made if isinstance(made, bytes) else made.encode())
        read = read_lens(path)
        assert not isinstance(read, ForeignLens)
        worst = off_px(camera, read.sized(camera.width, camera.height))
        back.append(name if worst < EXACT_PX else f"{name} ({worst:.2g} px off)")
        if read.covariance is None:
            lost.add("σ and correlations of the parameters")
        if (read.width, read.height) != (WIDTH, HEIGHT):
            lost.add("the image's size")
    exactly = "all" if back == list(LENSES) else "; ".join(back)
    return [exactly, "; ".join(refused) or "–", "; ".join(sorted(lost)) or "–"]


@script()
def main(_) -> None:
    warnings.simplefilter("ignore", InputNote)
    head("`--form`", "read back exactly", "refused", "lost")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for form in WRITERS:
            row(f"`{form}`", *held(form, folder))
        print()
        head("program", "lens", "fitted", "px RMS", "px at most", "turned")
        for (program, name), text in TRIED.items():
            (folder / "camera").write_text(text.format(WIDTH, HEIGHT))
            lens = read_lens(folder / "camera")
            assert isinstance(lens, ForeignLens)
            found = fit_lens(lens, WIDTH, HEIGHT)
            turn = np.degrees(found.camera_from_lens.angle_rad())
            figures = f"{found.rms_px:.4f}", f"{found.most_px:.3f}", f"{turn:.2f}°" if turn else "–"
            row(program, name, found.camera.colmap_model, *figures)
        print()
        head("written by", "read as", "px off at most")
        for program, (text, wanted) in camera_files.FILES.items():
            (folder / "camera").write_text(text)
            lens = read_lens(folder / "camera")
            if isinstance(lens, ForeignLens):
                called, pixels = f"{lens.called}, fitted", lens.project(camera_files.RAYS)
            else:
                camera = lens.sized(lens.width or WIDTH, lens.height or HEIGHT)
                called, pixels = lens.colmap_model, camera.project(camera_files.RAYS)
            off = np.abs(pixels - wanted).max()
            row(program, called, f"{off:.2g}" if off > EXACT_PX else "less than 1e-9")
