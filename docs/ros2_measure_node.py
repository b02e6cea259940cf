#!/usr/bin/env python3
"""ROS 2 node: poses of the stereo target in the images of a topic, from `stcal-sfm measure --serve`.

An example to copy; it needs rclpy and the service, not stcal. Parameters: `url` of the service, `sequence` by which it
follows the target from image to image. It reads `image_raw` (mono8 or mono16) and publishes `target_pose`, the target
in the camera's optical frame, with its covariance; images without a pose are logged with the reason.
"""

import json
import urllib.error
import urllib.request

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

DEEPEST = {"mono8": 255, "mono16": 65535}
UNITS = [1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3]
"""stcal has rotations before translations, rad and mm; ROS the other way round, m and rad."""


def pgm(image) -> bytes:
    """The image as a file, without compression: it is on its way within the machine only."""
    wide = 2 if image.encoding == "mono16" else 1
    raw = bytes(image.data)
    rows = [raw[i * image.step : i * image.step + image.width * wide] for i in range(image.height)]
    pixels = b"".join(rows)
    if wide == 2 and not image.is_bigendian:  # PGM has the larger byte first
        swapped = bytearray(pixels)
        swapped[0::2], swapped[1::2] = pixels[1::2], pixels[0::2]
        pixels = bytes(swapped)
    return b"P5 %d %d %d\n" % (image.width, image.height, DEEPEST[image.encoding]) + pixels


def quaternion(r) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation matrix, by its largest component (Shepperd 1978)."""
    trace = r[0][0] + r[1][1] + r[2][2]
    squares = [1 + 2 * r[i][i] - trace for i in range(3)] + [1 + trace]
    k = squares.index(max(squares))
    q = [0.0] * 4
    q[k] = squares[k] ** 0.5 / 2
    for i in range(3):
        j, m = (i + 1) % 3, (i + 2) % 3
        if k == 3:
            q[i] = (r[m][j] - r[j][m]) / (4 * q[3])
        elif i == k:
            q[3] = (r[m][j] - r[j][m]) / (4 * q[k])
        else:
            q[i] = (r[i][k] + r[k][i]) / (4 * q[k])
    return tuple(q)


class MeasureNode(Node):
    """Sends each image to the service and publishes what comes back."""

    def __init__(self):
        super().__init__("stcal_measure")
        self.url = self.declare_parameter("url", "http://127.0.0.1:8765").value
        self.sequence = self.declare_parameter("sequence", "ros").value
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "target_pose", 10)
        self.create_subscription(Image, "image_raw", self.measure, qos_profile_sensor_data)

    def measure(self, image) -> None:
        """Of one image; a queue of the topic's depth drops those that come too fast."""
        if image.encoding not in DEEPEST:
            self.get_logger().error(f"encoding {image.encoding}: mono8 or mono16 needed")
            return
        request = urllib.request.Request(f"{self.url}/measure?sequence={self.sequence}", data=pgm(image))
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                own = json.load(answer)["images"][0]
        except urllib.error.HTTPError as error:
            content = json.load(error)
            reason = content.get("error") or content["left_out"][0]["reason"]
            self.get_logger().warning(f"no pose: {reason}")
            return
        except OSError as error:
            self.get_logger().error(f"{self.url}: {error}; start `stcal-sfm measure --serve`")
            return
        if own["status"] == "ambiguous" or own["fit"] == "failed":
            self.get_logger().warning(f"pose is {own['status']}, fit {own['fit']}")
        message = PoseWithCovarianceStamped()
        message.header = image.header
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        matrix = own["camera_from_target"]
        place.x, place.y, place.z = (row[3] / 1e3 for row in matrix[:3])
        turn.x, turn.y, turn.z, turn.w = quaternion(matrix)
        order = [3, 4, 5, 0, 1, 2]
        message.pose.covariance = [own["covariance"][i][j] * UNITS[i] * UNITS[j] for i in order for j in order]
        self.poses.publish(message)


def main() -> None:
    """Spin until interrupted."""
    rclpy.init()
    node = MeasureNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


if __name__ == "__main__":
    main()
