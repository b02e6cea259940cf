"""What tests share: the data sets beside the repository, and a calibration without pixels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid, Similarity
from stcal.sfm.adjust import adjust
from stcal.sfm.chain import chain_faces
from stcal.sfm.faces import faces_of_group
from stcal.sfm.joint import adjust_jointly
from stcal.sfm.metric import find_scale
from stcal.sfm.model import GroupModel
from stcal.sfm.observations import ImageObservations
from stcal.sfm.refine import eccentricity_px
from stcal.sfm.uncertainty import calibrated_target
from stcal.synthetic.observe import image_circles
from stcal.synthetic.scene import Scene, SceneOptions, make_scene

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data():
    """The folder of shared data sets; tests that ask for it are skipped without it."""
    if not SHARED.is_dir():
        pytest.skip("the shared data sets are not beside the repository")
    return SHARED


@pytest.fixture(scope="session")
def scene():
    """The reference target in four groups of five views, half-size camera."""
    return make_scene(SceneOptions(seed=3, width=2592, height=1728, images_per_group=5))


class LabelsOnly:
    """Observations and models of a scene, straight from the geometry."""

    SIGMA_PX = 0.005

    def observations(self, scene: Scene, noise_px: float, rng) -> list[ImageObservations]:
        """Ellipse centres of everything that must be found, with noise."""
        images = []
        for name, group in scene.groups.items():
            for i in range(len(group.camera_from_target)):
                seen = image_circles(scene, name, i)
                keep = [k for k, must in enumerate(seen.must_find) if must]
                from_ellipse = self._ellipse_centres(scene, seen, keep)
                centre_px = from_ellipse + rng.normal(0, noise_px, from_ellipse.shape) if noise_px else from_ellipse
                n = len(keep)
                images.append(
                    ImageObservations(
                        f"{name}/{i}",
                        name,
                        tuple(seen.labels[k] for k in keep),
                        centre_px,
                        scene.camera.normalised_from_pixel(centre_px),
                        np.tile(0.01 * np.eye(2), (n, 1, 1)),
                        np.tile(max(noise_px, self.SIGMA_PX) ** 2 * np.eye(2), (n, 1, 1)),
                    )
                )
        return images

    @staticmethod
    def _ellipse_centres(scene, seen, keep):
        from stcal.geometry.conic import circle_image_offset

        return scene.camera.project(
            circle_image_offset(
                np.asarray(seen.xyz_camera)[keep],
                np.asarray(seen.normal_camera)[keep],
                np.asarray(seen.radius_mm)[keep],
            )
        )

    def models(self, scene: Scene, observations: list[ImageObservations], unit_mm: float = 1.0) -> list[GroupModel]:
        """Models at the true geometry, in a world turned and scaled against the target frame."""
        world_from_target = Similarity(1 / unit_mm, Rigid.exp([0.3, -0.2, 0.5, 40, -30, 900]))
        models = []
        for name, group in scene.groups.items():
            images = [o for o in observations if o.group == name]
            labels = sorted({label for o in images for label in o.labels})
            index = {label: k for k, label in enumerate(labels)}
            board = dict(zip(scene.board.labels(), group.board_circles_target, strict=True))
            xyz = np.array([scene.circles_target[k] if k in scene.circles_target else board[k] for k in labels])
            rows = [(i, index[label], k) for i, o in enumerate(images) for k, label in enumerate(o.labels)]
            image_index, point_index, keypoint = np.array(rows).T
            model = GroupModel(
                name,
                tuple(o.name for o in images),
                tuple(group.camera_from_target),
                tuple(labels),
                xyz,
                image_index,
                point_index,
                keypoint,
                np.concatenate([o.centre_px for o in images]),
                np.zeros((len(rows), 2)),
                np.concatenate([o.covariance_px2 for o in images]),
            )
            models.append(model.moved(world_from_target))
        return models

    def calibrate(self, scene: Scene, noise_px: float, seed: int, solve: str = "joint"):
        """Chain or joint calibration from labels; returns (CalibratedTarget, JointResult or None)."""
        target, board, camera = scene.target, scene.board, scene.camera
        radius = target.radius_of() | board.radius_of()
        observations = self.observations(scene, noise_px, np.random.default_rng(seed))
        models, faces, scales = [], [], {}
        for start in self.models(scene, observations):
            model = replace(start, shift_px=eccentricity_px(start, camera, radius, 1.0))
            model = adjust(model, camera)
            scales[model.group] = find_scale(model, board).mm_per_unit
            faces += faces_of_group(model, scales[model.group], camera, target, "plane")[0]
            models.append(model)
        chained = chain_faces(faces, target, target.faces[0].id)
        if solve == "chain":
            return chained, None
        metric = [
            m.moved(Similarity(1.0, chained.target_from_group[m.group]) @ Similarity(scales[m.group], Rigid()))
            for m in models
        ]
        joint = adjust_jointly(metric, board, camera)
        return calibrated_target(joint, chained, target, "plane"), joint


@pytest.fixture(scope="session")
def labels_only():
    return LabelsOnly()
