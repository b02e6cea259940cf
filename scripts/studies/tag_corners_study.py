#!/usr/bin/env python
"""Measure the errors of tags' corners in photographs of simulated bodies against the truth, beside their stated σ.

Each row is a class of corners: by the width of a cell in its shorter direction, by tilt and by blur. Errors are of
single corners (RMS per coordinate), of the outward shift that the four edges of a tag share (mean, and RMS of a tag),
and NEES: squared errors over the stated covariance, of 2; 1 where σ are true.
"""

import argparse

import cv2
import numpy as np

from stcal.boards.dictionaries import cells_of
from stcal.boards.edges import corners_by_edges
from stcal.boards.faces import find_on_faces
from stcal.geometry.robust import robust_sigma
from stcal.synthetic.body import BodyOptions, body_camera, drawing_of, make_body_scene, render_body
from stcal.synthetic.designs import tag_cube, tag_dodecahedron
from stcal.synthetic.render import encode

WIDTH = 900
SETS = (
    (tag_cube(60.0), 300.0),
    (tag_cube(100.0), 400.0),
    (tag_cube(45.0), 420.0),
    (tag_dodecahedron(30.0), 520.0),
    (tag_dodecahedron(30.0), 330.0),
)
CELLS = (0.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 9.0, 14.0, 25.0)


def corner_errors(target, distance_mm: float, options: dict, jpeg: bool) -> list[tuple]:
    """Returns for each tag found: width of a cell, cosine of its tilt, errors (4, 2), covariances, outward shift."""
    scene = make_body_scene(target, body_camera(WIDTH), BodyOptions(distance_mm=distance_mm, **options))
    drawings = {face.id: drawing_of(face) for face in target.faces}
    boards = {face.id: face.printed for face in target.faces}
    rows = []
    for image in range(len(scene.camera_from_target)):
        grey = render_body(scene, image, drawings)
        if jpeg:
            decoded = cv2.imdecode(np.frombuffer(encode(grey, ".jpg", 95), np.uint8), cv2.IMREAD_GRAYSCALE)
            grey = np.asarray(decoded)
        views, _ = find_on_faces(grey, "image", boards, scene.camera)
        for face in target.faces:
            view = views.get(face.id)
            if view is None or view.covariance_px2 is None:
                continue
            pose = scene.camera_from_target[image] @ scene.target_from_face[face.id]
            truth = scene.camera.project(pose @ view.xyz_board).reshape(-1, 4, 2)
            error = view.xy_px.reshape(-1, 4, 2) - truth
            covariance = view.covariance_px2.reshape(-1, 4, 2, 2)
            out = corners_by_edges(truth)
            for k in range(len(truth)):
                corners = truth[k]
                side = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
                diagonal = corners[2:] - corners[:2]
                area = abs(diagonal[0, 0] * diagonal[1, 1] - diagonal[0, 1] * diagonal[1, 0]) / 2
                cell = area / side.max() / cells_of(face.printed.tags[view.ids[4 * k] // 4][0], 1)
                shape = np.linalg.svd(
                    np.stack(
                        [
                            corners[1] + corners[2] - corners[0] - corners[3],
                            corners[2] + corners[3] - corners[0] - corners[1],
                        ],
                        1,
                    ),
                    compute_uv=False,
                )
                shift = float((out[k] * error[k]).sum() / (out[k] ** 2).sum())
                rows.append((cell, shape[1] / shape[0], error[k], covariance[k], shift))
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--blurs", type=float, nargs="+", default=[0.5, 0.7, 1.1])
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--png", action="store_true", help="no JPEG")
    arguments = parser.parse_args()
    print(
        "| blur, px | cell, px | tilt | corners | error, px RMS | robust | stated | shift of edges: mean | RMS | "
        "NEES | robust NEES |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for blur in arguments.blurs:
        rows = []
        for target, distance in SETS:
            for seed in range(arguments.seeds):
                options = {
                    "images": arguments.images,
                    "seed": arguments.first_seed + seed,
                    "blur_px": blur,
                    "noise": arguments.noise,
                }
                rows += corner_errors(target, distance, options, not arguments.png)
        cell, cosine, shift = (np.array([row[i] for row in rows]) for i in (0, 1, 4))
        error, covariance = (np.array([row[i] for row in rows]) for i in (2, 3))
        square = np.einsum("nki,nkij,nkj->nk", error, np.linalg.inv(covariance), error) / 2
        for low, high in zip(CELLS, (*CELLS[1:], np.inf), strict=True):
            for tilt, less in (("< 45°", cosine >= np.sqrt(0.5)), ("more", cosine < np.sqrt(0.5))):
                own = (cell >= low) & (cell < high) & less
                if own.sum() < 5:
                    continue
                length = np.linalg.norm(error[own], axis=2).ravel()
                stated = np.sqrt(np.trace(covariance[own], axis1=2, axis2=3).mean() / 2)
                print(
                    f"| {blur} | {low} to {high} | {tilt} | {4 * own.sum()} | {np.sqrt((length**2).mean() / 2):.3f} | "
                    f"{robust_sigma(length, 2):.3f} | {stated:.3f} | {shift[own].mean():+.4f} | "
                    f"{np.sqrt((shift[own] ** 2).mean()):.3f} | {square[own].mean():.2f} | "
                    f"{robust_sigma(np.sqrt(2 * square[own].ravel()), 2) ** 2:.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
