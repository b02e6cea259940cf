#!/usr/bin/env python
"""Calibrate simulated bodies of tags, and of tags beside circles, against their truth: from pixels alone.

No dot board and no camera file are used.

Each draw has its own faces (0.3 mm and 0.5° about the nominal ones), poses and noise. NEES: squared errors of each
face's pose against the reference face over its covariance, of 6, mean over faces and draws; 1 where σ are true.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.boards.design import CharucoDesign
from stcal.boards.target import printed_face
from stcal.design import TargetDesign
from stcal.errors import StcalError
from stcal.geometry.rigid import Rigid
from stcal.sfm import pipeline
from stcal.sfm.report.compare import compare
from stcal.synthetic.body import BodyOptions, body_camera, make_body_scene, write_body
from stcal.synthetic.designs import second_design, tag_cube, tag_dodecahedron


def mixed_cube() -> TargetDesign:
    """A cube of 100 mm with circles on two faces, a ChArUco board on one and tags on three, mm."""
    faces = list(tag_cube(100.0, size_sigma_mm=0.04).faces)
    board = CharucoDesign(8, 8, 9.2, 6.8, "DICT_6X6_250", first_id=100)
    charuco = printed_face("4", board, 0.02, 0.02)
    outwards = Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    for k, face, turn in (
        (1, second_design()[0].faces[0], outwards),
        (2, second_design()[0].faces[1], outwards),
        (3, charuco, Rigid()),
    ):
        middle = np.append((face.xy_mm.min(0) + face.xy_mm.max(0)) / 2, 0.0)
        pose = faces[k].rough_target_from_face
        assert pose is not None
        faces[k] = replace(face, rough_target_from_face=pose @ turn @ Rigid(np.eye(3), -middle))
    return TargetDesign("mixed cube", "dark", tuple(faces))


BODIES = {
    "cube of 60 mm, tags of about 100 px": (tag_cube(60.0), 300.0, 16),
    "dodecahedron of 30 mm edges, tags of about 35 px": (tag_dodecahedron(30.0), 520.0, 24),
    "cube of 100 mm, circles, ChArUco and tags": (mixed_cube(), 400.0, 20),
}
WIDTH = 900


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument(
        "--body", default="", help="only bodies whose name has this word, such as mixed or dodecahedron"
    )
    arguments = parser.parse_args()
    print("| body | draws | faces found | error of a position, µm RMS | of a rotation, mdeg RMS | NEES |")
    print("|---|---|---|---|---|---|")
    for name, (target, distance_mm, images) in BODIES.items():
        if arguments.body not in f"{name}, {target.name}":
            continue
        position, rotation, normalised, found, lost = [], [], [], 0, 0
        for seed in range(arguments.draws):
            scene = make_body_scene(
                target,
                body_camera(WIDTH),
                BodyOptions(images=images, distance_mm=distance_mm, seed=seed, print_errors=1.0),
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
