#!/usr/bin/env python3
"""Time, memory, database size and accuracy of mapping against the number of images; labels simulated, no pixels.

Every size is run in a process of its own: graph, database, mapping, refinement, joint adjustment and writing of the
final database. Centres carry 0.02 px noise and one label in ten is missing. Prints a Markdown table.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from stcal.sfm.calibration import calibrate
from stcal.sfm.database import write_database
from stcal.sfm.graph import image_graph
from stcal.sfm.observations import ImageObservations
from stcal.sfm.pipeline import RunOptions, solve_groups
from stcal.synthetic.observe import simulate_centres
from stcal.synthetic.scene import Scene, SceneOptions, make_scene

NOISE_PX = 0.02
MISSING = 0.1
SIZES = (40, 80, 160, 300, 1000, 2000)
ALL_UP_TO = 300


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
            images.append(ImageObservations(name, group, labels, xy, normalised, np.zeros((n, 2, 2)), covariance))
    return images


def measure(count: int, kind: str) -> dict:
    """One run over ``count`` images in all."""
    groups = 4
    scene = make_scene(SceneOptions(seed=5, images_per_group=count // groups))
    observations = observe(scene)
    options = RunOptions(graph=kind).settled(scene.target)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    marks = [("start", time.perf_counter())]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        (out / "cache").mkdir()
        graph = image_graph(observations, scene.board, kind)
        marks.append(("graph", time.perf_counter()))
        arguments = (scene.camera, scene.colmap_model, scene.target, scene.board, options)
        solutions = solve_groups(observations, graph, out, *arguments, lambda *_: None)
        marks.append(("map", time.perf_counter()))
        result = calibrate([s.model for s in solutions], scene.camera, scene.target, scene.board, options)
        marks.append(("adjust", time.perf_counter()))
        database = out / "database.db"
        write_database(database, scene.camera, scene.colmap_model, observations, graph.pairs)
        marks.append(("write", time.perf_counter()))
        size = database.stat().st_size
    error = [
        np.linalg.norm(pose.translation - scene.target_from_face[face].translation)
        for face, pose in result.target.target_from_face.items()
    ]
    seconds = {name: at - before for (name, at), (_, before) in zip(marks[1:], marks[:-1], strict=True)}
    return {
        "images": len(observations),
        "kind": kind,
        "mapped": sum(len(s.model.images) for s in solutions),
        "pairs": len(graph.pairs),
        "seconds": seconds,
        "ms_per_image": 1e3 * sum(seconds.values()) / len(observations),
        "memory_mib": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024,
        "database_mib": size / 2**20,
        "worst_face_um": 1e3 * float(max(error)),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES, help="images in all, multiples of 4")
    parser.add_argument("--one", nargs=2, metavar=("COUNT", "KIND"), help="measure one size in this process, as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(int(arguments.one[0]), arguments.one[1])))
        return
    print(
        "| images | pairs | mapped | pairs matched | ms an image | graph + map + adjust + write, s | memory, MiB | "
        "database, MiB | worst face, µm |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for count in arguments.sizes:
        for kind in ("all", "sparse"):
            if kind == "all" and count > ALL_UP_TO:
                continue
            command = [sys.executable, __file__, "--one", str(count), kind]
            answer = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            parts = " + ".join(f"{s:.2f}" for s in answer["seconds"].values())
            print(
                f"| {answer['images']} | {kind} | {answer['mapped']} | {answer['pairs']} | "
                f"{answer['ms_per_image']:.1f} | {parts} | {answer['memory_mib']:.0f} | "
                f"{answer['database_mib']:.1f} | {answer['worst_face_um']:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
