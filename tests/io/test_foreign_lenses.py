"""Lenses that no model here holds: their projections as other programs have them, and what a fit is worth."""

import sqlite3

import cv2
import numpy as np
import pycolmap
import pytest

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.difference import compare_cameras, fit_lens
from stcal.io.cameras.foreign_lenses import COLMAP_FOREIGN, ForeignLens
from stcal.io.cameras.read import read_camera, read_lens
from tests.io.camera_files import colmap, project
from tests.outcome import refuses
from tests.shared import written

WIDTH, HEIGHT = 1280, 961
COLMAP = {
    "FOV": [0.9],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, -0.01, 3e-3, -2e-3, 1e-3, -3e-4, 1e-3, -2e-3, 1e-3, -2e-4, 5e-4, 1e-4],
    "SIMPLE_DIVISION": [-0.2],
    "DIVISION": [-0.2],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.6, 1.1],
}
"""What follows the principal point."""
TILTED = [-0.1, 0.03, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003, 1e-3, -2e-4, -1e-3, 1e-4, 0.02, -0.03]
KALIBR = "cam0:\n  camera_model: {}\n  intrinsics: {}\n  distortion_model: {}\n  distortion_coeffs: {}\n"


def rays() -> np.ndarray:
    """(50, 3), the axis first."""
    xy = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 2))
    xy[0] = 0
    return np.column_stack([xy, np.ones(50)])


def colmap_params(model: str) -> list[float]:
    focal = [812.25] if model.startswith("SIMPLE_") else [812.25, 809.5]
    return [*focal, 640.625, 478.5, *COLMAP[model]]


def lens_of(tmp_path, model: str):
    line = " ".join(map(repr, colmap_params(model)))
    return read_lens(written(tmp_path / "cameras.txt", f"7 {model} {WIDTH} {HEIGHT} {line}\n"))


@pytest.mark.parametrize("model", COLMAP_FOREIGN)
def test_colmap_projects_the_same(tmp_path, model):
    wanted = colmap(model, colmap_params(model), rays())
    np.testing.assert_allclose(project(lens_of(tmp_path, model), rays()), wanted, atol=1e-10)
    assert int(pycolmap.CameraModelId.__members__[model]) == COLMAP_FOREIGN[model][0]


@pytest.mark.parametrize("model", ["FOV", "OPENCV"])
def test_the_camera_of_a_database_is_read(tmp_path, model):
    path = tmp_path / "database.db"
    params = colmap_params("FOV") if model == "FOV" else [812.25, 809.5, 640.625, 478.5, -0.1, 0.03, 1e-3, -2e-3]
    cameras = [pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params) for _ in range(2)]
    with pycolmap.Database.open(path) as database:
        for camera in cameras:
            database.write_camera(camera)
    before = path.read_bytes()
    refuses("E-CAMERA-SEVERAL … 2 cameras, 1 needed … 1, 2 … --name", read_lens, path)
    wanted = colmap(model, params, rays())
    np.testing.assert_allclose(project(read_lens(path, "2"), rays()), wanted, atol=1e-10)
    assert path.read_bytes() == before


def test_a_database_of_something_else_is_refused_and_a_lens_that_none_of_ours_is_like_says_so(tmp_path):
    """A double sphere of 220°: the image reaches beyond what a model here sees."""
    path = tmp_path / "other.db"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE cameras (camera_id, model, width, height, params)")
    refuses("E-CAMERA-NONE", read_lens, path)
    with sqlite3.connect(path) as database:
        database.execute("INSERT INTO cameras VALUES (1, 4, 10, 10, 'words')")
    refuses("E-CAMERA-UNREADABLE", read_lens, path)
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE cameras")
    refuses("E-CAMERA-UNREADABLE … no such table: cameras", read_lens, path)
    text = KALIBR.format("ds", [-0.2, 0.6, 200.0, 200.0, 640, 478], "none", [])
    assert fit_lens(read_lens(written(tmp_path / "chain.yaml", text)), WIDTH, HEIGHT).share < 0.5
    lens_of(tmp_path, "FOV")  # and other commands ask for the conversion
    refuses("E-CAMERA-MODEL … COLMAP's FOV", read_camera, tmp_path / "cameras.txt")


@pytest.mark.parametrize("count", [12, 14])
def test_opencv_projects_the_same(tmp_path, count):
    matrix = [812.25, 0, 640.125, 0, 809.5, 478.0625, 0, 0, 1]
    text = f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_matrix: {matrix}\n"
    lens = read_lens(written(tmp_path / "c.yaml", f"{text}distortion_coefficients: {TILTED[:count]}\n"))
    k = np.reshape(matrix, (3, 3))
    wanted = cv2.projectPoints(rays(), np.zeros(3), np.zeros(3), k, np.array(TILTED[:count]))[0].reshape(-1, 2)
    np.testing.assert_allclose(lens.project(rays()), wanted, atol=1e-10)
    assert ("tilted" in lens.called) == (count == 14)


def kalibr(tmp_path, lens: str, shape: list[float], distortion: str = "none", k: tuple[float, ...] = ()) -> ForeignLens:
    text = KALIBR.format(lens, [*shape, 400.5, 402.0, 640, 478], distortion, list(k))
    return read_lens(written(tmp_path / "chain.yaml", text))


def test_kalibrs_lenses_project_by_their_papers(tmp_path):
    """Mei & Rives 2007: ξ = 0 is perspective, ξ = 1 stereographic; double sphere with α = ½, ξ = 0 is stereographic
    too, and with α = 0 Mei's of ξ; the enhanced unified lens is COLMAP's EUCM."""
    r = rays()
    focal, centre = np.array([400.5, 402.0]), np.array([640.0, 478.0])
    angle, side = np.arctan(np.hypot(*r[:, :2].T)), r[:, :2] / np.maximum(np.hypot(*r[:, :2].T), 1e-15)[:, None]
    stereographic = np.tan(angle / 2)[:, None] * side
    np.testing.assert_allclose(kalibr(tmp_path, "omni", [0.0]).project(r), centre + focal * r[:, :2], atol=1e-10)
    np.testing.assert_allclose(kalibr(tmp_path, "omni", [1.0]).project(r), centre + focal * stereographic, atol=1e-10)
    np.testing.assert_allclose(
        kalibr(tmp_path, "ds", [0.0, 0.5]).project(r), centre + 2 * focal * stereographic, atol=1e-10
    )
    omni, sphere = kalibr(tmp_path, "omni", [0.3]), kalibr(tmp_path, "ds", [0.3, 0.0])
    np.testing.assert_allclose(sphere.project(r), omni.project(r), atol=1e-10)
    wanted = colmap("EUCM", [*focal, *centre + 0.5, 0.6, 1.1], r)
    np.testing.assert_allclose(kalibr(tmp_path, "eucm", [0.6, 1.1]).project(r), wanted, atol=1e-10)


@pytest.mark.parametrize(
    ("distortion", "k", "model", "params"),
    [
        ("radtan", (-0.2, 0.05, 1e-3, -2e-3), "OPENCV", (-0.2, 0.05, 1e-3, -2e-3)),
        ("equidistant", (-0.01, 0.02, -3e-3, 4e-4), "OPENCV_FISHEYE", (-0.01, 0.02, -3e-3, 4e-4)),
        ("fov", (0.9,), "FOV", (0.9,)),
    ],
)
def test_kalibrs_distortions_are_colmaps(tmp_path, distortion, k, model, params):
    wanted = colmap(model, [400.5, 402.0, 640.5, 478.5, *params], rays())
    np.testing.assert_allclose(kalibr(tmp_path, "omni", [0.0], distortion, k).project(rays()), wanted, atol=1e-10)


MRCAL = {
    2: [[1113.4803160427805, 983.9378017015669], [1554.5433686283736, 314.9491916110986],
        [56.08894951279456, 1323.6188180048284]],
    3: [[1114.99498397871, 985.0624887742252], [1549.7328831186853, 311.58902073923093],
        [56.72249785371844, 1322.0796389340078]],
}  # fmt: skip
"""``mrcal.project`` (2.2) of three rays, by the spline's order."""


@pytest.mark.parametrize("order", MRCAL)
def test_mrcals_splines_project_as_mrcal_does(tmp_path, order):
    numbers = [1200, 1205, 999.5, 749.5, *np.round(0.02 * np.sin(np.arange(176)), 6).tolist()]
    name = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order={order}_Nx=11_Ny=8_fov_x_deg=120"
    text = f"{{'lensmodel': '{name}', 'intrinsics': {numbers}, 'imagersize': [2000, 1500]}}"
    path = written(tmp_path / "c.cameramodel", text)
    found = read_lens(path).project(np.array([[0.1, 0.2, 1], [0.5, -0.4, 1], [-1, 0.6, 1]]))
    np.testing.assert_allclose(found, MRCAL[order], atol=1e-9)
    refuses("E-CAMERA-COEFFICIENTS … 179 … 11 … 8 … 180", read_lens, written(path, text.replace("1205,", "")))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "most_px"), [("FOV", 1e-4), ("RAD_TAN_THIN_PRISM_FISHEYE", 0.1), ("DIVISION", 1e-4), ("EUCM", 1e-3)]
)
def test_a_fit_is_off_by_no_more_than_it_says(tmp_path, model, most_px):
    """The models differ in form; how near they come was measured."""
    lens = lens_of(tmp_path, model)
    found = fit_lens(lens, WIDTH, HEIGHT)
    xy = np.random.default_rng(2).uniform(-1.5, 1.5, (4000, 2))
    fresh = np.column_stack([xy, np.ones(len(xy))])
    pixels = lens.project(fresh)
    inside = ((pixels > 0) & (pixels < [WIDTH - 1, HEIGHT - 1])).all(axis=1)
    off = np.linalg.norm(found.camera.project(fresh[inside]) - pixels[inside], axis=1)
    assert inside.sum() > 300
    assert off.max() <= 1.05 * found.most_px + 1e-6
    assert found.most_px < most_px
    assert found.share == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 FOV 9 9 1 1 1 1", "E-CAMERA-COEFFICIENTS … 4 … FOV … 5"),
        ("1 FOV 9 9 -1 1 1 1 1", "E-CAMERA-FOCAL … -1 … 1"),
        ("1 FOV 9 9 9 9 1 1 nan", "E-CAMERA-NOT-FINITE"),
        ("1 EQUIRECTANGULAR 9 9 9 9", "E-CAMERA-MODEL … EQUIRECTANGULAR"),
        ("1 PINHOLE 9 9 1 1 1 1\n1 PINHOLE 9 9 1 1 1 1", "E-CAMERA-REPEATED"),
        (KALIBR.format("omni", [1, 2, 3], "none", []), "E-CAMERA-COEFFICIENTS … omni … none … 5 … 0"),
        (KALIBR.format("ds", [0, 0, -1, 1, 1, 1], "none", []), "E-CAMERA-FOCAL"),
    ],
)  # fmt: skip
def test_a_wrong_lens_is_named(tmp_path, text, message):
    refuses(message, read_lens, written(tmp_path / "camera", text))


CAHVOR = (4842.918, 4842.771, 1970.528, 1085.302, -0.001, 0.002, -0.637, -0.002, 0.016)


def cahvor_file(path, numbers):
    text = f"{{'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': {list(numbers)}, 'imagersize': [4000, 2200]}}"
    return read_lens(written(path, text))


def test_cahvor_projects_as_mrcal_does_and_about_the_axis_of_the_image_as_opencv(tmp_path):
    """Numbers of mrcal's own test of projections, test/test-projections.py, px."""
    lens = cahvor_file(tmp_path / "a.cameramodel", CAHVOR)
    assert isinstance(lens, ForeignLens)
    rays = np.array([[1.0, 2.0, 10.0], [-1.1, 0.3, 1.0], [-0.9, -1.5, 1.0]])
    told = [[2143.17840406, 1442.93419919], [-92.63813066, 1653.09646897], [-249.83199315, -2606.46477164]]
    assert lens.project(rays) == pytest.approx(np.array(told), abs=1e-6)
    refuses("E-CAMERA-COEFFICIENTS … 8 … LENSMODEL_CAHVOR", cahvor_file, tmp_path / "a.cameramodel", CAHVOR[:8])
    lens = cahvor_file(tmp_path / "a.cameramodel", (*CAHVOR[:4], 0, 0, 0.01, -0.1, 0.02))
    assert isinstance(lens, CameraModel)
    assert lens.focal == pytest.approx([1.01 * CAHVOR[0], 1.01 * CAHVOR[1]])
    assert lens.distortion[:4] == pytest.approx([-0.1 / 1.01, 0.02 / 1.01, 0, 0])
    # … and as the formula goes on when the axis is turned by hardly anything
    near = cahvor_file(tmp_path / "b.cameramodel", (*CAHVOR[:4], 1e-12, 0, 0.01, -0.1, 0.02))
    turned = np.array([[0.3, -0.2, 1.0], [-0.1, 0.25, 1.0]])
    assert isinstance(near, ForeignLens)
    assert near.project(turned) == pytest.approx(lens.sized(4000, 2200).project(turned), abs=1e-6)


def turned_lens(angle_deg, region=None) -> tuple[ForeignLens, Camera, Rigid]:
    """A supported camera behind a turn that no supported model holds."""
    camera = Camera(WIDTH, HEIGHT, [812.0, 809.0], [640.0, 478.0], np.pad([-0.1, 0.03, 1e-3, -2e-3], (0, 8)))
    turn = Rigid.exp([*np.radians(angle_deg), 0, 0, 0])

    def project(rays: np.ndarray) -> np.ndarray:
        xy = camera.project(turn @ rays)
        return xy if region is None else np.where(inside(region, xy)[:, None], xy, xy + 3000)

    return ForeignLens("a turned lens", project, WIDTH, HEIGHT, region), camera, turn


def inside(polygon: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    contour = np.rint(polygon * 1024).astype(np.int32)
    return np.array([cv2.pointPolygonTest(contour, (x * 1024, y * 1024), False) > 0 for x, y in pixels.tolist()])


@pytest.mark.slow
def test_a_fit_turns_the_camera_where_the_lens_was_determined_which_is_compared_by_its_own_projection():
    """Not by the model that is fitted to it, which is a pixel off."""
    lens, camera, turn = turned_lens([2.0, -3.0, 1.0])
    found = fit_lens(lens, WIDTH, HEIGHT)
    assert found.rms_px < 1e-3
    np.testing.assert_allclose(found.camera_from_lens.rotation, turn.rotation, atol=1e-5)
    np.testing.assert_allclose(found.camera.centre, camera.centre, atol=0.1)
    straight = fit_lens(ForeignLens("", camera.project, WIDTH, HEIGHT), WIDTH, HEIGHT)
    assert straight.camera_from_lens.angle_rad() == 0
    lens, camera, turn = turned_lens([1.0, 2.0, 0.0], REGION)  # beyond the region it is 3000 px off
    pixels = np.random.default_rng(0).uniform([0, 0], [WIDTH, HEIGHT], (500, 2))
    np.testing.assert_array_equal(lens.determined(pixels), inside(REGION, pixels))
    fitted = fit_lens(lens, WIDTH, HEIGHT)
    assert fitted.rms_px < 1e-2
    np.testing.assert_allclose(fitted.camera_from_lens.rotation, turn.rotation, atol=1e-3)
    pixels = np.random.default_rng(0).uniform([300, 200], [900, 600], (50, 2))
    np.testing.assert_allclose(lens.project(fitted.rays(pixels)), pixels, atol=1e-6)
    for one, two in ((fitted, camera), (camera, fitted)):
        found = compare_cameras(one, two)
        assert np.nanmax(found.lengths()) < 1e-5
        assert 0.3 < np.isnan(found.lengths()).mean() < 0.8
    np.testing.assert_allclose(found.second_from_first.inverse().rotation, turn.rotation, atol=1e-7)
    longer = Camera(WIDTH, HEIGHT, camera.focal * 1.001, camera.centre, camera.distortion)
    # a thousandth of the way from the middle, of which a turn and the offset of the region take a part
    assert 0.2 < np.nanmax(compare_cameras(fitted, longer).lengths()) < 0.7


REGION = np.array([[200.0, 100], [1000, 150], [1100, 800], [640, 700], [150, 850]])


def test_mrcals_region_is_read_and_a_projection_beyond_all_numbers_is_no_pixel_and_no_warning(tmp_path, recwarn):
    text = (
        "{'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [812, 809, 640, 478, 0.01, -0.02, 0.002, -0.1, 0.03], "
        f"'valid_intrinsics_region': {REGION.tolist()}, 'imagersize': [{WIDTH}, {HEIGHT}]}}"
    )
    path = written(tmp_path / "c.cameramodel", text)
    np.testing.assert_array_equal(read_lens(path).region, REGION)
    wrong = written(path, text.replace(str(REGION.tolist()), "[1, 2, 3]"))
    refuses("E-CAMERA-CONTENT … valid_intrinsics_region", read_lens, wrong)
    lens = ForeignLens("too strong", lambda rays: 1e308 * rays[:, :2] * 10, 10, 10)
    assert not np.isfinite(lens.project(np.ones((2, 3)))).any()
    assert not recwarn.list
