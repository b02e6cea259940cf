#!/usr/bin/env python
"""Calibrate simulated bodies of tags, and of tags beside circles, against their truth: from pixels alone.

No dot board and no camera file are used.

Each draw has its own faces (0.3 mm and 0.5° about the nominal ones), poses and noise. NEES: squared errors of each
face's pose against the reference face over its covariance, of 6, mean over faces and draws; 1 where σ are true.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from scripts.runner import executor_of, head, row, script
from stcal.boards.board_designs import CharucoDesign
from stcal.boards.target_file import printed_face
from stcal.design import TargetDesign
from stcal.errors import StcalError
from stcal.geometry.rigid import Rigid
from stcal.parallel import one_thread
from stcal.sfm import RunOptions, pipeline
from stcal.sfm.report.compare import FaceErrors, compare
from stcal.synthetic.body_scene import BodyOptions, body_camera, make_body_scene
from stcal.synthetic.dataset import write_dataset
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


@one_thread()
def draw(name: str, seed: int) -> list[FaceErrors] | str:
    """Returns the errors of one draw's faces, or why its run failed."""
    target, distance_mm, images = BODIES[name]
    options = BodyOptions(images=images, distance_mm=distance_mm, seed=seed, print_errors=1.0)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_dataset(folder / "set", make_body_scene(target, body_camera(WIDTH), options), workers=1)
        try:
            own = folder / "set/images", None, folder / "run", folder / "set/target.toml"
            pipeline.run(*own, options=RunOptions(workers=1))
            return list(compare(folder / "run", folder / "set/truth.json").faces.values())
        except StcalError as error:
            return str(error)


@script(draws=10, body="")
def main(arguments) -> None:
    head("body", "draws", "faces found", "error of a position, µm RMS", "of a rotation, mdeg RMS", "NEES")
    names = [name for name in BODIES if arguments.body in f"{name}, {BODIES[name][0].name}"]
    with executor_of() as pool:
        for name in names:
            answers = list(pool.map(draw, [name] * arguments.draws, range(arguments.draws)))
            good = [answer for answer in answers if not isinstance(answer, str)]
            for seed, answer in enumerate(answers):
                if isinstance(answer, str):
                    print(f"draw {seed}: {answer}", flush=True)
            judged = [face for faces in good for face in faces if face.normalised_error is not None]
            position, rotation, sigmas = (
                float(np.sqrt(np.mean([getattr(face, key) ** 2 for face in judged])))
                for key in ("translation_um", "rotation_mdeg", "normalised_error")
            )
            found = f"{sum(map(len, good))} of {len(BODIES[name][0].faces) * arguments.draws}"
            counts = f"{len(good)} of {arguments.draws}", found
            row(name, *counts, f"{position:.0f}", f"{rotation:.0f}", f"{sigmas**2:.2f}")
