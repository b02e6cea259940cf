#!/usr/bin/env python3
"""Time, memory, database size and accuracy of mapping against the number of images; labels simulated, no pixels.

Every size is run in a process of its own: graph, database, mapping, refinement, joint adjustment, checks and writing of
the final database. Centres carry 0.02 px noise and one label in ten is missing. Prints a Markdown table.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from scripts.runner import face_errors, head, row, script
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.checks.significance import Evidence
from stcal.sfm.checks.suite import run_checks
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.detect.labelling import LabelledImage
from stcal.sfm.mapping.database import write_database
from stcal.sfm.mapping.pairs import image_graph
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.stages import Groups, Task, map_groups
from stcal.sfm.runs.transaction import RunFolder
from stcal.synthetic.scene import Scene, SceneOptions, image_circles, make_scene
from tests.support.areas import simulate_centres

NOISE_PX = 0.02
MISSING = 0.1
SIZES = (40, 80, 160, 300, 1000, 2000, 10_000)
ALL_UP_TO = 300
GROUPS = 4


def observe(scene: Scene) -> list[ImageObservations]:
    """Labelled ellipse centres of every image of the scene."""
    rng = np.random.default_rng(0)
    images = []
    for group in scene.groups:
        for i in range(len(scene.groups[group].camera_from_target)):
            centres = simulate_centres(scene, group, i, NOISE_PX, rng)
            labels = tuple(label for label in centres if rng.random() > MISSING)
            xy, n = np.array([centres[label] for label in labels]), len(labels)
            covariance = np.tile(NOISE_PX**2 * np.eye(2), (n, 1, 1))
            normalised = scene.camera.normalised_from_pixel(xy)
            name = f"{group}/{i:04d}"
            shape = ellipse_shapes(scene, group, i)
            shapes = np.array([shape[label] for label in labels])
            images.append(ImageObservations(name, group, labels, xy, normalised, shapes, covariance))
    return images


def ellipse_shapes(scene: Scene, group: str, image: int) -> dict[str, np.ndarray]:
    """By label: a root of the ellipse's shape matrix, (2, 2), in normalised coordinates, for the check of the radii.

    From the dual conic r²(I − n·nᵀ) − C·Cᵀ (Hartley & Zisserman, sec. 8.3).
    """
    seen = image_circles(scene, group, image)
    n, c = seen.normal_camera, seen.xyz_camera
    flat = np.eye(3) - n[:, :, None] * n[:, None]
    dual = seen.radius_mm[:, None, None] ** 2 * flat - c[:, :, None] * c[:, None]
    dual /= dual[:, 2:, 2:]
    middle = dual[:, :2, 2:]
    root = np.linalg.cholesky(middle * middle.swapaxes(1, 2) - dual[:, :2, :2])
    return dict(zip(seen.labels, root, strict=True))


def measure(count: int, kind: str) -> dict:
    """One run over ``count`` images in all."""
    scene = make_scene(SceneOptions(seed=5, images_per_group=count // GROUPS))
    observations = observe(scene)
    options = RunOptions().settled(scene.target)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    marks, processor = [("start", time.perf_counter())], time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        graph = image_graph(observations, scene.board, kind)
        marks.append(("graph", time.perf_counter()))
        labelled = tuple(LabelledImage(image, ()) for image in observations)
        names = tuple(sorted(scene.groups))
        groups = Groups(labelled, names, graph, scene.camera, scene.board, options, False, ())
        task = Task(([], []), RunFolder(out, out, out), scene.target, scene.board, options, lambda *_: None)
        solutions = map_groups(task, groups).solutions
        marks.append(("map", time.perf_counter()))
        adjustment = options.adjustment(scene.target)
        result = calibrate([s.model for s in solutions], scene.camera, scene.target, scene.board, adjustment)
        marks.append(("adjust", time.perf_counter()))
        # as a run gives it, but for the blur of the edges, which needs pixels
        outliers = tuple(o for s in solutions for o in s.outliers)
        given = scene.camera, scene.target, scene.board, adjustment, result, None, {}
        checks = run_checks(Evidence(tuple(s.model for s in solutions), outliers, tuple(observations), *given))
        marks.append(("check", time.perf_counter()))
        database = out / "database.db"
        write_database(database, scene.camera, observations, graph.pairs)
        marks.append(("write", time.perf_counter()))
        size = database.stat().st_size
    error = [np.linalg.norm(each[3:]) for each in face_errors(result.target, scene.target_from_face).values()]
    processor = time.process_time() - processor
    seconds = {name: at - before for (name, at), (_, before) in zip(marks[1:], marks[:-1], strict=True)}
    return {
        "images": len(observations),
        "kind": kind,
        "mapped": sum(len(s.model.images) for s in solutions),
        "pairs": len(graph.pairs),
        "seconds": seconds,
        "not_passed": [c.key for c in checks if c.verdict not in ("passed", "not possible")],
        "ms_per_image": 1e3 * sum(seconds.values()) / len(observations),
        "cpu_ms_per_image": 1e3 * processor / len(observations),
        "memory_mib": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024,
        "database_mib": size / 2**20,
        "worst_face_um": 1e3 * float(max(error)),
    }


@script(sizes=list(SIZES), one=["none", "all"], limited=True)
def main(arguments) -> None:
    if arguments.one[0] != "none":
        print(json.dumps(measure(int(arguments.one[0]), arguments.one[1])))
        return
    counts = "images", "pairs", "mapped", "pairs matched", "ms an image"
    sizes = "memory, MiB", "database, MiB", "worst face, µm"
    head(*counts, "graph + map + adjust + check + write, s", "total, s", *sizes)
    for count in arguments.sizes:
        for kind in ("all", "sparse"):
            if kind == "all" and count > ALL_UP_TO:
                continue
            command = [sys.executable, __file__, "--one", str(count), kind]
            answer = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            counts = answer["images"], kind, answer["mapped"], answer["pairs"], f"{answer['ms_per_image']:.1f}"
            parts = " + ".join(f"{s:.2f}" for s in answer["seconds"].values())
            sizes = f"{answer['memory_mib']:.0f}", f"{answer['database_mib']:.1f}", f"{answer['worst_face_um']:.2f}"
            row(*counts, parts, f"{sum(answer['seconds'].values()):.1f}", *sizes)
