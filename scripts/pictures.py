"""The pictures of README.md and docs/: what is found in the sample photographs, the report's page, and the drawings and
first photographs of two tutorials.

.venv/bin/python scripts/pictures.py [NAME …] [--out FOLDER]

Calibrates `tests/data/sample`, whose photographs another program rendered, and writes `docs/pictures/`. All but `found`
need Chromium on the PATH, as pages and drawings are photographed in the browser. `box` and `cube` show simulated
photographs.
"""

import csv
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from PIL import Image

from scripts.runner import ROOT, SAMPLE, script
from stcal.sfm import run

FOUND_IN = "12/IMG_1001.jpg"
"""Three faces and the board, turned."""
MARGIN_PX = 45
HALF_WIDTH_PX = 760
PAGE_PX = (1280, 1240)
PAPER = 200
"""Grey value above which a drawing is paper."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def found(result: Path, out: Path) -> None:
    """A photograph, and beside it what was found there: the overlay of the run, cut to the circles."""
    photograph, overlay = Image.open(SAMPLE / "images" / FOUND_IN), Image.open(result / "overlays" / FOUND_IN)
    box = box_of_circles(result / "labels.csv", FOUND_IN, photograph.size)
    halves = [cut(image, box, photograph.width) for image in (photograph.convert("RGB"), overlay)]
    side_by_side(halves, out / "found.jpg")


def side_by_side(halves: Sequence[Image.Image], out: Path) -> None:
    """Two pictures of equal width."""
    both = Image.new("RGB", (2 * HALF_WIDTH_PX + 8, max(half.height for half in halves)), "white")
    for k, half in enumerate(halves):
        both.paste(half, (k * (HALF_WIDTH_PX + 8), (both.height - half.height) // 2))
    both.save(out, quality=88)


def box_of_circles(detections: Path, image: str, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """What holds all labelled circles of an image with a margin: left, top, right, bottom, px of the photograph."""
    with detections.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["image"] == image and row["label"]]
    x, y = ([float(row[key]) for row in rows] for key in ("x_px", "y_px"))
    first = (max(min(values) - MARGIN_PX, 0) for values in (x, y))
    return (*first, *(min(max(values) + MARGIN_PX, side) for values, side in zip((x, y), size, strict=True)))


def cut(image: Image.Image, box: tuple[float, float, float, float], width: int) -> Image.Image:
    """That part of an image, whatever its own size, of a photograph ``width`` px wide; ``HALF_WIDTH_PX`` wide."""
    scale = image.width / width
    height = round(HALF_WIDTH_PX * (box[3] - box[1]) / (box[2] - box[0]))
    scaled = [side * scale for side in box]
    return image.resize((HALF_WIDTH_PX, height), Image.Resampling.LANCZOS, box=scaled)


def report(result: Path, out: Path) -> None:
    """The first screen of the report."""
    photograph_page(result / "report.html", out / "report.png")


def drawn(out: Path, size: tuple[int, int], design: str, draw: str, simulate: str) -> None:
    """A drawing, shown ``size`` px large, and beside it what is found in the first of the simulated photographs."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        target = folder / "design" / "target.toml"
        board = ["--board", target.with_name("board.toml")] * ("--tags" not in design)
        for words in (
            ["design", target.parent, *design.split()],
            ["draw", target, "--out", folder / "drawing.svg", *draw.split()],
            ["simulate", folder / "data", "--target", target, *board, *simulate.split()],
            ["detect", folder / "data" / "images", "--target", target, *board, "--out", folder / "look"],
        ):
            subprocess.run([Path(sys.executable).with_name("stcal-sfm"), *words], check=True, capture_output=True)
        photograph_page(folder / "drawing.svg", folder / "drawing.png", size)
        drawing = Image.open(folder / "drawing.png").convert("L")
        drawing = drawing.crop(drawing.point(lambda grey: 255 * (grey < PAPER)).getbbox()).convert("RGB")
        height = round(HALF_WIDTH_PX * drawing.height / drawing.width)
        name = min(row["image"] for row in csv.DictReader((folder / "look" / "detections.csv").open(encoding="utf-8")))
        overlay = Image.open((folder / "look" / "overlays" / name).with_suffix(".jpg")).convert("RGB")
        width = Image.open(folder / "data" / "images" / name).width
        part = box_of_circles(folder / "look" / "detections.csv", name, (width, width))
        halves = [drawing.resize((HALF_WIDTH_PX, height), Image.Resampling.LANCZOS), cut(overlay, part, width)]
        side_by_side(halves, out)


def box(_: Path, out: Path) -> None:
    """Of the tutorial of a target of one's own."""
    faces = "--size 160,140,120 --faces front,right,top --images 6"
    drawn(out / "box.jpg", (1000, 640), faces, "", "--width 2016 --images 3 --one-board --seed 4")


def cube(_: Path, out: Path) -> None:
    """Of the tutorial of a cube of tags."""
    made = "--tags cube --size 45 --distance-mm 300 --width 900 --images 20"
    drawn(out / "cube.jpg", (1200, 1000), made, "--net", "--width 900 --images 3 --distance 300 --seed 5")


def photograph_page(page: Path, out: Path, size: tuple[int, int] = PAGE_PX) -> None:
    """A page as a browser shows it, in few colours.

    Raises
    ------
    SystemExit
        There is no browser.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"no browser on the PATH ({', '.join(BROWSERS)} were looked for); install Chromium")
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--screenshot={out}"]
    window = f"--window-size={size[0]},{size[1]}"
    subprocess.run([browser, *words, window, page.resolve().as_uri()], check=True, capture_output=True)
    Image.open(out).convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE).save(out, optimize=True)


PICTURES: dict[str, Callable[[Path, Path], None]] = {"found": found, "report": report, "box": box, "cube": cube}


@script({"names": list(PICTURES)}, out=ROOT / "docs" / "pictures")
def main(arguments) -> None:
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result"
        if {"found", "report"} & set(arguments.names):
            run(SAMPLE / "images", SAMPLE / "cameras.txt", result)
        for name in arguments.names:
            PICTURES[name](result, arguments.out)
