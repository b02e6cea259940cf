"""The example node of docs/ against the service, with stand-ins for ROS's classes."""

import importlib.util
import json
import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.io.cameras.read import read_camera
from stcal.sfm.measurement.serve import MeasureServer, MeasureService, ServeOptions, Setting
from stcal.sfm.measurement.target import read_target

NODE = Path(__file__).resolve().parents[3] / "docs" / "ros2_measure_node.py"


class FakeNode:
    """Parameters, a log and what was published."""

    url = ""

    def __init__(self, name):
        self.log, self.published = [], []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.url if name == "url" else default)

    def create_publisher(self, *_):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, *_):
        pass

    def get_logger(self):
        return SimpleNamespace(error=self.log.append, warning=self.log.append)


def message():
    pose = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    return SimpleNamespace(header=None, pose=SimpleNamespace(pose=pose, covariance=None))


@pytest.fixture
def node_module(monkeypatch):
    parts = {
        "rclpy": {},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": message},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": object},
    }
    for name, content in parts.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("ros2_measure_node", NODE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def server(small_run, small_scene):
    target = read_target(small_run / "faces.json", small_scene.target)
    object.__setattr__(target, "design", small_scene.target)
    service = MeasureService(Setting(target, read_camera(small_run / "inputs/cameras.txt")), 1)
    with MeasureServer(service, ServeOptions(port=0)) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield running
        running.shutdown()
    service.close()


def ros_image(pixels, encoding, pad=16):
    """With padded rows, as drivers have them; 16 bit with the smaller byte first."""
    rows = pixels.astype("<u2" if encoding == "mono16" else np.uint8).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, pad)))
    height, width = pixels.shape
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="camera_optical_frame"),
        encoding=encoding,
        height=height,
        width=width,
        step=padded.shape[1],
        is_bigendian=0,
        data=padded.tobytes(),
    )


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["mono8", "mono16"])
def test_poses_are_published(node_module, server, small_dataset, encoding):
    FakeNode.url = server.url
    path = next(iter(sorted((small_dataset / "images" / "12").iterdir())))
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    node = node_module.MeasureNode()
    node.measure(ros_image(grey if encoding == "mono8" else grey.astype(np.uint16) * 257, encoding))
    assert node.log == []
    (published,) = node.published
    own = server.service.answer(path.read_bytes(), path.name)
    (wanted,) = json.loads(own.text)["images"]
    matrix, covariance = np.array(wanted["camera_from_target"]), np.array(wanted["covariance"])
    assert published.header.frame_id == "camera_optical_frame"
    pose = published.pose.pose
    place = [pose.position.x, pose.position.y, pose.position.z]
    np.testing.assert_allclose(1e3 * np.array(place), matrix[:3, 3], atol=0.05)  # 16 bit have other grey values
    turn = Rotation.from_quat([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    np.testing.assert_allclose(turn.as_matrix(), matrix[:3, :3], atol=1e-4)
    found = np.array(published.pose.covariance).reshape(6, 6)
    if encoding == "mono8":
        np.testing.assert_allclose(found[:3, :3], 1e-6 * covariance[3:, 3:], rtol=0.3)
        np.testing.assert_allclose(found[3:, 3:], covariance[:3, :3], rtol=0.3)


@pytest.mark.slow
def test_reasons_are_logged(node_module, server):
    FakeNode.url = server.url
    node = node_module.MeasureNode()
    node.measure(ros_image(np.full((48, 64), 90), "mono8"))
    node.measure(SimpleNamespace(encoding="rgb8"))
    FakeNode.url = "http://127.0.0.1:9"
    other = node_module.MeasureNode()
    other.measure(ros_image(np.full((48, 64), 90), "mono8"))
    assert "64×48 px, camera" in node.log[0]
    assert node.log[1] == "encoding rgb8: mono8 or mono16 needed"
    assert "start `stcal-sfm measure --serve`" in other.log[0]
    assert node.published == other.published == []


def test_quaternions_of_all_branches(node_module):
    for turn in Rotation.random(50, random_state=1):
        x, y, z, w = node_module.quaternion(turn.as_matrix().tolist())
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), turn.as_matrix(), atol=1e-12)
