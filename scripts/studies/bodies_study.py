#!/usr/bin/env python
"""Calibrate simulated bodies of tags from pixels, without a board and without a camera file, against their truth.

Each draw has its own faces (0.3 mm and 0.5° about the nominal ones), poses and noise. NEES: squared errors of each
face's pose against the reference face over its covariance, of 6, mean over faces and draws; 1 where σ are true.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from stcal.errors import StcalError
from stcal.sfm import pipeline
from stcal.sfm.report.compare import compare
from stcal.synthetic.body import BodyOptions, body_camera, make_body_scene, write_body
from stcal.synthetic.designs import tag_cube, tag_dodecahedron

BODIES = {
    "cube of 60 mm, tags of about 100 px": (tag_cube(60.0), 300.0, 16),
    "dodecahedron of 30 mm edges, tags of about 35 px": (tag_dodecahedron(30.0), 520.0, 24),
}
WIDTH = 900


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10)
    arguments = parser.parse_args()
    print("| body | draws | faces found | error of a position, µm RMS | of a rotation, mdeg RMS | NEES |")
    print("|---|---|---|---|---|---|")
    for name, (target, distance_mm, images) in BODIES.items():
        position, rotation, normalised, found, lost = [], [], [], 0, 0
        for seed in range(arguments.draws):
            scene = make_body_scene(
                target, body_camera(WIDTH), BodyOptions(images=images, distance_mm=distance_mm, seed=seed)
            )
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                write_body(folder / "set", scene)
                try:
                    pipeline.run(folder / "set/images", None, folder / "run", folder / "set/target.toml")
                    errors = compare(folder / "run", folder / "set/truth.json")
                except StcalError as error:
                    print(f"draw {seed}: {error}", flush=True)
                    lost += 1
                    continue
            found += len(errors.faces)
            of_faces = [face for face in errors.faces.values() if face.normalised_error is not None]
            position += [face.translation_um for face in of_faces]
            rotation += [face.rotation_mdeg for face in of_faces]
            normalised += [face.normalised_error for face in of_faces]
        wanted = len(target.faces) * arguments.draws
        rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (position, rotation)]
        nees = float(np.mean(np.square(normalised)))
        print(
            f"| {name} | {arguments.draws - lost} of {arguments.draws} | {found} of {wanted} | {rms[0]:.0f} | "
            f"{rms[1]:.0f} | {nees:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
