"""Files found group by group, and decoded as the sensor gave them. Photographs: the camera that EXIF tells, beside
COLMAP's; HEIC; raw ones and mosaics of coloured pixels, which are refused."""

import io
import os
import struct
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image, ImageOps

import stcal
from stcal.errors import InputError
from stcal.io import decoding, images
from stcal.io.cameras.read import SIGMA_FOCAL, camera_of_photograph, is_photograph
from stcal.io.decoding import patterns_seen
from stcal.io.files import RUN_MARKER
from stcal.io.images import TOP_GROUP, common_size, decode, find_images, name_fault, size_fault, thumbnail
from tests.outcome import fails_with, refuses
from tests.shared import written


def encoded(suffix, image=None, params=()):
    image = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64) if image is None else image
    return cv2.imencode(suffix, image, list(params))[1].tobytes()


def test_groups_and_order(tmp_path):
    for name in ("b/2.JPG", "b/1.png", "a ä/x y.tiff", "top.bmp", "b/notes.txt", ".hidden", "b/.DS_Store"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "run" / RUN_MARKER).parent.mkdir(parents=True)
    (tmp_path / "run" / RUN_MARKER).write_text("{}")
    (tmp_path / "run" / "picture.jpg").write_bytes(b"x")
    files, skipped = find_images(tmp_path)
    assert [(f.group, f.name) for f in files] == [
        (TOP_GROUP, "top.bmp"),
        ("a ä", "a ä/x y.tiff"),
        ("b", "b/1.png"),
        ("b", "b/2.JPG"),
    ]
    assert [(s.name, s.reason) for s in skipped] == [("b/notes.txt", "not an image file")]
    one = tmp_path / "top.bmp"
    assert find_images(one) == ([images.ImageFile(one, "top.bmp", TOP_GROUP)], [])
    said = "E-IMAGES-FOLDER … notes.txt: not a folder, and not an image file; give a folder or an image"
    refuses(said, find_images, tmp_path / "b/notes.txt")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
def test_whole_files_are_read_and_truncated_ones_refused(suffix):
    data = encoded(suffix)
    assert decode(data, "x").shape == (48, 64)
    with pytest.raises(InputError, match=r"truncated|not readable"):
        decode(data[: len(data) * 2 // 3], "x")
    for other, code in ((b"", "E-IMAGE-EMPTY"), (b"text", "E-IMAGE-UNREADABLE")):
        refuses(code, decode, other, f"x{suffix}")


def test_sixteen_bit_and_colour_are_read_and_exif_orientation_ignored():
    deep = (np.arange(48 * 64, dtype=np.uint16) * 20).reshape(48, 64)
    np.testing.assert_array_equal(decode(encoded(".png", deep), "x"), deep)
    colour = np.dstack([np.full((48, 64), v, np.uint8) for v in (10, 20, 30)])
    # Rec. 601 luma: 0.114·10 + 0.587·20 + 0.299·30 = 21.85.
    assert abs(int(decode(encoded(".png", colour), "x")[0, 0]) - 22) <= 1
    data = encoded(".jpg")
    # A minimal APP1 segment with orientation 6 (turn by 90°), put behind the start of image.
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    np.testing.assert_array_equal(decode(turned, "x"), decode(data, "x"))
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (64, 48)


def test_a_damaged_image_is_told_from_whole_ones_in_other_threads():
    """Whole to its end marker, but its scan is not what an encoder would write; standard error stays as it was."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (200, 300), np.uint8), (0, 0), 3)
    whole, damaged, before = encoded(".jpg"), bytearray(encoded(".jpg", picture)), os.fstat(2)
    middle = len(damaged) // 2
    damaged[middle : middle + 300] = bytes(300)

    def fault(k: int) -> str:
        try:
            decode(bytes(damaged) if k % 5 == 0 else whole, str(k))
        except InputError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor(4) as pool:
        faults = list(pool.map(fault, range(100)))
    assert [k for k, text in enumerate(faults) if text] == list(range(0, 100, 5))
    assert all("damaged (Corrupt JPEG data" in text for text in faults if text)
    assert os.path.samestat(before, os.fstat(2))


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *((name, None) for name in ("12/IMG_1.jpg", "a b/c.d.png", "..a/b..jpg", "a\\b.jpg", "ä/ö.tif")),
        *((name, "leads out") for name in ("../x.jpg", "12/../x.jpg", "/x.jpg", "C:x.jpg", "C:\\x.jpg", "\\x.jpg")),
        *((name, "leads out") for name in ("..\\x.jpg", "12\\..\\..\\x.jpg", "\\\\host\\share\\x.jpg", "12/..")),
        *((name, "control character") for name in ("a\nb.jpg", "a\x1b[31m.jpg", "a\x7f.jpg", "a\x85.jpg", "a\0b")),
    ],
)
def test_names_stay_below_the_folder(name, fault):
    found = name_fault(name)
    assert found is None if fault is None else fault in found


@pytest.mark.parametrize("shape", [(1, 9000), (9000, 1), (1, 1), (2, 5000), (70_000, 1), (1, 70_000)])
def test_a_picture_of_one_row_or_column_has_a_thumbnail(shape):
    jpeg, scale = thumbnail(np.full(shape, 100, np.uint8))
    small = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    assert small.min() > 90
    assert 0 < scale <= 1


def portrait(grey: np.ndarray, orientation: int, stated: tuple[int, int] | None = None) -> bytes:
    """A lossless file whose EXIF has this orientation, and states width and height."""
    image, exif = Image.fromarray(grey), Image.Exif()
    exif[0x0112] = orientation
    if stated is not None:
        exif.get_ifd(0x8769)[0xA002], exif.get_ifd(0x8769)[0xA003] = stated
    stream = io.BytesIO()
    image.save(stream, "PNG", exif=exif)
    return stream.getvalue()


@pytest.mark.parametrize("orientation", [6, 8])
def test_an_image_with_sides_swapped_is_turned_as_its_exif_says(orientation):
    grey = np.random.default_rng(0).integers(0, 255, (60, 40), np.uint8)
    data = portrait(grey, orientation)
    wanted = np.array(ImageOps.exif_transpose(Image.open(io.BytesIO(data))))
    np.testing.assert_array_equal(decode(data, "a.png", (60, 40)), wanted)
    np.testing.assert_array_equal(decode(data, "a.png"), grey)
    np.testing.assert_array_equal(decode(data, "a.png", (40, 60)), grey)  # as the sensor gave it
    np.testing.assert_array_equal(decode(portrait(grey, orientation, (40, 60)), "a.png", (60, 40)), wanted)
    # the pixels were turned and the orientation was left as it was: nothing says which way
    np.testing.assert_array_equal(decode(portrait(grey, orientation, (60, 40)), "a.png", (60, 40)), grey)
    np.testing.assert_array_equal(decode(portrait(grey, 1), "a.png", (60, 40)), grey)


def test_most_images_state_the_size(tmp_path):
    sizes = [(40, 60), (60, 40), (60, 40), (60, 40), (50, 50)]
    for i, (width, height) in enumerate(sizes):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((height, width), np.uint8))
    files, _ = find_images(tmp_path)
    assert common_size(files) == ((60, 40), "1.png")
    halves = "1 of 40×60 px, first 0.png and 1 of 60×40 px, first 1.png … turn one half back"
    refuses(f"E-IMAGES-SIZES … {halves}", common_size, files[:2])
    refuses("E-IMAGES-SIZES … leave one size out", common_size, [files[0], files[4]])
    files[0].path.write_bytes(files[0].path.read_bytes()[:60])
    assert common_size(files[:2]) == ((60, 40), "1.png")  # the header of a file that cannot be read does not decide
    assert common_size(files[:1]) is None
    for size, swapped in (((40, 60), True), ((40, 50), False)):
        assert ("sides swapped" in size_fault("a.png", size, (60, 40), "the camera file").reason) == swapped


def tiff_of(grey: np.ndarray, white_is_zero: bool) -> bytes:
    """Values as they stand in the file; tag 262 says what they mean (TIFF 6.0, PhotometricInterpretation)."""
    stream = io.BytesIO()
    Image.fromarray(grey).save(stream, "TIFF")
    data = bytearray(stream.getvalue())
    (at,) = struct.unpack_from("<I", data, 4)
    for entry in range(at + 2, at + 2 + 12 * struct.unpack_from("<H", data, at)[0], 12):
        if struct.unpack_from("<H", data, entry)[0] == 262:
            struct.pack_into("<HHII", data, entry, 262, 3, 1, 0 if white_is_zero else 1)
    return bytes(data)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_white_is_zero(dtype):
    grey = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (30, 40), dtype)
    np.testing.assert_array_equal(decode(tiff_of(grey, False), "a.tif"), grey)
    np.testing.assert_array_equal(decode(tiff_of(grey, True), "a.tif"), np.iinfo(dtype).max - grey)


def test_photographs_of_other_kinds_are_named_with_what_to_do(tmp_path, monkeypatch):
    """As where the packages that read them are not installed."""
    monkeypatch.setattr(images, "SUFFIXES", images.USUAL)
    for name in ("a.HEIC", "b.dng", "c.txt"):
        (tmp_path / name).write_bytes(b"x")
    refuses("E-IMAGES-NONE … a.HEIC: a HEIC photograph … [heic]' … export it as JPEG", find_images, tmp_path)
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros((4, 4), np.uint8))
    reasons = {each.name: each.reason for each in find_images(tmp_path)[1]}
    assert "develop it to TIFF" in reasons["b.dng"]
    assert reasons["c.txt"] == "not an image file"


def exif_of(orientation: int = 1, **entries) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation] = "any", orientation
    exif.get_ifd(ExifTags.IFD.Exif).update({getattr(ExifTags.Base, name): v for name, v in entries.items()})
    return exif


def photograph(path, **entries):
    Image.new("L", (1200, 800)).save(path, exif=exif_of(**entries))
    return path


PLANE = {"FocalLength": 35.0, "FocalPlaneXResolution": 500.0, "FocalPlaneResolutionUnit": 3}
"""24 mm across 1200 px."""
BIGGER = PLANE | {"FocalPlaneXResolution": 2500.0, "ExifImageWidth": 6000, "ExifImageHeight": 4000}
ENTRIES = {
    "35 mm film": ({"FocalLengthIn35mmFilm": 28}, 28 / 36 * 1200),
    "pixels": (PLANE, 35 / 24 * 1200),
    "pixels of a larger image": (BIGGER, 35 / 24 * 1200),
    "inches": (PLANE | {"FocalPlaneXResolution": 1270.0, "FocalPlaneResolutionUnit": 2}, 35 / 24 * 1200),
}


@pytest.mark.parametrize("case", ENTRIES)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_focal_length_is_that_of_exif(tmp_path, case, suffix):
    entries, focal_px = ENTRIES[case]
    path = photograph(tmp_path / f"p{suffix}", **entries)
    assert is_photograph(path)
    camera, told = camera_of_photograph(path)
    np.testing.assert_allclose(camera.focal, focal_px, rtol=1e-4)
    np.testing.assert_array_equal(camera.centre, [599.5, 399.5])
    sigma = np.sqrt(np.diag(camera.covariance))
    np.testing.assert_allclose(sigma[:2], SIGMA_FOCAL * focal_px, rtol=1e-3)
    assert np.linalg.eigvalsh(camera.covariance).min() > 0
    assert ("sensor of 24×16 mm" in told) == ("FocalLength" in entries)
    if (case, suffix) == ("35 mm film", ".jpg"):
        by_colmap = pycolmap.infer_camera_from_image(path)
        assert by_colmap.has_prior_focal_length
        np.testing.assert_allclose(camera.focal, by_colmap.mean_focal_length(), rtol=1e-3)


def test_a_lens_is_loaded_from_a_photograph_too(tmp_path):
    path = photograph(tmp_path / "p.jpg", FocalLengthIn35mmFilm=28)
    found = stcal.load_lens(path)
    camera, told = camera_of_photograph(path)
    assert found.camera.same_as(camera)
    assert (found.told, found.fitted) == (told, None)
    stcal.save_camera(tmp_path / "c.txt", found.camera, "colmap")
    assert stcal.load_lens(tmp_path / "c.txt").camera.same_as(found.camera)
    refuses("E-FIELD-TYPE … size", stcal.load_lens, path, size="1200x800")


@pytest.mark.parametrize(
    ("entries", "content", "message"),
    [
        ({}, None, "E-CAMERA-EXIF"),
        ({"FocalLengthIn35mmFilm": 0}, None, "E-CAMERA-EXIF"),
        ({"FocalLength": 35.0}, None, "E-CAMERA-EXIF … 35 mm, but no size of its pixels"),
        ({"FocalLengthIn35mmFilm": 36, "DigitalZoomRatio": 2.0}, None, "E-CAMERA-EXIF … zoom of 2 … 1200 or 2400 px"),
        (None, b"\xff\xd8\xff\xe0\x00\x10JFIF", "E-CAMERA-UNREADABLE"),
    ],
)
def test_a_photograph_that_tells_nothing_is_refused(tmp_path, entries, content, message):
    path = tmp_path / "p.jpg"
    refuses(message, camera_of_photograph, written(path, content) if content else photograph(path, **entries))


HEIGHT, WIDTH = 96, 128
Y, X = np.mgrid[:HEIGHT, :WIDTH]
SCENE = (60 + 150 / (1 + np.exp((np.hypot(X - 40.3, Y - 30.7) - 15) * 1.5))).astype(np.uint8)
"""A bright disc left of and above the middle: a turned or mirrored image shows."""


def centre(image: np.ndarray) -> np.ndarray:
    """Centroid (x, y) of what is brighter than its surroundings."""
    weight = np.clip(image.astype(float) - np.median(image), 0, None)
    return np.array([(X * weight).sum(), (Y * weight).sum()]) / weight.sum()


def heic(**options) -> bytes:
    pillow_heif = pytest.importorskip("pillow_heif")
    stream = io.BytesIO()
    try:
        pillow_heif.from_pillow(Image.fromarray(np.dstack([SCENE] * 3))).save(stream, quality=95, **options)
    except RuntimeError as error:  # built without an encoder
        pytest.skip(str(error))
    return stream.getvalue()


def test_a_heic_photograph_is_read(tmp_path):
    """Told by its content where its name says otherwise; with the camera of its EXIF."""
    path = written(tmp_path / "a.HEIC", heic(exif=exif_of(FocalLengthIn35mmFilm=26).tobytes()))
    camera, _ = camera_of_photograph(path)
    np.testing.assert_allclose(camera.focal, 26 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT), rtol=1e-4)
    (file,), skipped = find_images(tmp_path)
    assert not skipped
    image = decode(file.read(), "a.jpg")
    assert np.abs(image.astype(int) - SCENE).mean() < 3  # JPEG of this quality: 2
    np.testing.assert_allclose(centre(image), centre(SCENE), atol=0.05)


def test_the_turn_of_the_container_is_undone():
    """Its decoder applies it, and the camera's pixels are wanted."""
    upright = decode(heic(), "a.heic")
    for orientation in (6, 8, 3):
        data = heic(exif=exif_of(orientation).tobytes())
        if not decoding.heic_turns(data):
            pytest.skip("this package writes no turn into the container")
        np.testing.assert_allclose(decode(data, "a.heic").astype(int), upright, atol=8)


def test_a_damaged_heic_photograph_is_refused_and_a_missing_package_named(monkeypatch):
    monkeypatch.setattr("PIL.ImageFile.LOAD_TRUNCATED_IMAGES", True)  # as WeasyPrint leaves it
    refuses("E-IMAGE-UNREADABLE … a.heic", decode, heic()[:400], "a.heic")
    monkeypatch.setattr(decoding, "find_spec", lambda _: None)
    with fails_with("E-IMAGE-EXTRA … pip install 'stereo-target-calibration["):
        decode(b"\0\0\0\x18ftypheic" + bytes(40), "a.heic")


@pytest.mark.parametrize("name", ["a.nef", "a.tif"])
def test_a_raw_photograph_is_refused(name):
    """Told by its suffix, or by the tag of a DNG, which OpenCV would read as the grey image that it is not."""
    stream = io.BytesIO()
    Image.fromarray(SCENE).save(stream, "TIFF", tiffinfo={decoding.DNG_VERSION: bytes([1, 4, 0, 0])})
    refuses(f"E-IMAGE-TYPE … {name} … TIFF or PNG", decode, stream.getvalue(), name)


ROW, COLUMN = np.mgrid[:240, :320]
GAIN = {"R": 0.55, "G": 1.0, "B": 0.7}  # sensitivities of a sensor without white balance


def scene(seed: int = 0) -> np.ndarray:
    """Grey discs with noise, 0 … 1."""
    rng = np.random.default_rng(seed)
    light = np.full(COLUMN.shape, 0.7)
    for _ in range(20):
        x, y, radius = rng.uniform(20, 300), rng.uniform(20, 220), rng.uniform(5, 15)
        light = np.minimum(light, 0.7 - 0.5 / (1 + np.exp((np.hypot(COLUMN - x, ROW - y) - radius) * 2)))
    return light + rng.normal(0, 0.005, COLUMN.shape)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_mosaic_is_refused(tmp_path, pattern):
    gain = np.array([GAIN[colour] for colour in pattern]).reshape(2, 2)
    mosaic = np.round(255 * scene() * np.tile(gain, (120, 160))).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), mosaic)
    refuses(f"E-IMAGE-MOSAIC … a.png … {pattern}", find_images, tmp_path)


@pytest.mark.parametrize("seed", range(4))
def test_other_images_are_no_mosaics(seed):
    light = scene(seed)
    stripes = np.where(seed % 2 == COLUMN % 2, 200, 60)
    board = np.where((COLUMN // 3 + ROW // 3) % 2, 255, 0)
    noise = np.random.default_rng(seed).integers(0, 255, light.shape)
    for image in (np.round(255 * light), noise, stripes, board, np.zeros((40, 50))):
        assert not patterns_seen(image.astype(np.uint8))
