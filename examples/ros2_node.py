#!/usr/bin/env python3
"""A ROS 2 node that measures with the service: colour, aligned depth and camera info to JSON.

    cucumbervision serve                                     # somewhere, in its own Python
    ros2 run realsense2_camera realsense2_camera_node --ros-args -p align_depth.enable:=true
    python3 examples/ros2_node.py --ros-args -p url:=http://127.0.0.1:8600

It needs ROS 2 (rclpy, message_filters, sensor_msgs, std_msgs) and this package; the networks run
in the service. It sends one frame at a time, always the newest; the others are dropped.
`capture_of` needs no ROS.
"""

from __future__ import annotations

import json
import os
import threading
from typing import Any

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.geometry.camera import Distortion
from cucumbervision.service.client import Client

_COLORS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_DEPTHS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}  # REP 118


def pixels(image: Any, kind: str, channels: int) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image without row padding."""
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    used = np.ascontiguousarray(rows[:, : image.width * channels * dtype.itemsize])
    return used.view(dtype).reshape(image.height, image.width, channels)


def capture_of(color: Any, depth: Any, info: Any) -> Capture:
    """Return the capture of three messages: Image, Image aligned to it, and colour's CameraInfo.

    Raises
    ------
    CaptureError
        If an encoding or lens model is not supported, or the pictures differ in size.
    """
    frame, stamp = color.header.frame_id, color.header.stamp
    if color.encoding not in _COLORS or depth.encoding not in _DEPTHS:
        raise CaptureError(
            f"colour {color.encoding} with depth {depth.encoding} is not supported",
            source=frame,
            remedy="publish rgb8 and 16UC1 or 32FC1",
        )
    rgb = pixels(color, "u1", _COLORS[color.encoding])[..., :3]
    if color.encoding.startswith("bgr"):
        rgb = rgb[..., ::-1]
    kind, unit_m = _DEPTHS[depth.encoding]
    depth_m = (pixels(depth, kind, 1)[..., 0] * np.float32(unit_m)).astype(np.float32)
    seconds = stamp.sec + stamp.nanosec / 1e9
    return Capture(
        np.ascontiguousarray(rgb),
        np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0),
        intrinsics_of(info),
        f"frame_{stamp.sec}_{stamp.nanosec:09d}",
        timestamp_s=seconds or None,
        source=frame,
        provenance={"reader": "ros2", "frame_id": frame},
    )


def intrinsics_of(info: Any) -> Intrinsics:
    """Return the colour intrinsics of a sensor_msgs/CameraInfo.

    Raises
    ------
    CaptureError
        If its lens model is not supported.
    """
    matrix = np.array(info.k, np.float64).reshape(3, 3)
    lens = [float(value) for value in info.d]
    if not any(lens):
        return Intrinsics.from_matrix(matrix, info.width, info.height)
    if info.distortion_model != "plumb_bob" or len(lens) != 5:
        raise CaptureError(
            f"the lens model {info.distortion_model} is not supported",
            source=info.header.frame_id,
            remedy="publish rectified pictures (image_proc)",
        )
    k1, k2, p1, p2, k3 = lens
    return Intrinsics(
        info.width,
        info.height,
        matrix[0, 0],
        matrix[1, 1],
        matrix[0, 2],
        matrix[1, 2],
        distortion=Distortion.BROWN_CONRADY,
        coefficients=(k1, k2, p1, p2, k3),
    )


class Newest:
    """Processes the newest item in a thread; older ones are dropped."""

    def __init__(self, work: Any) -> None:
        self._work, self._given = work, None
        self._changed = threading.Condition()
        threading.Thread(target=self._run, daemon=True).start()

    def give(self, one: Any) -> None:
        """Replace the newest item."""
        with self._changed:
            self._given = one
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._given is None:
                    self._changed.wait()
                one, self._given = self._given, None
            self._work(one)


def main() -> None:
    """Run the node."""
    import message_filters
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import String

    rclpy.init()
    node = Node("cucumbervision")
    node.declare_parameter("url", "http://127.0.0.1:8600")
    node.declare_parameter("camera", "/camera/camera")
    camera = node.get_parameter("camera").value
    url = node.get_parameter("url").value
    client = Client(url, os.environ.get("CUCUMBERVISION_TOKEN", ""))
    rows = node.create_publisher(String, "~/fruit", 10)

    def measure(messages: tuple[Any, Any, Any]) -> None:
        try:
            reply = client.measure(capture_of(*messages))
        except CucumberVisionError as error:
            node.get_logger().warning(str(error))
            return
        header = messages[0].header
        stamp = {"sec": header.stamp.sec, "nanosec": header.stamp.nanosec}
        reply["header"] = {"frame_id": header.frame_id, "stamp": stamp}
        rows.publish(String(data=json.dumps(reply)))

    newest = Newest(measure)
    topics = (
        (Image, f"{camera}/color/image_raw"),
        (Image, f"{camera}/aligned_depth_to_color/image_raw"),
        (CameraInfo, f"{camera}/color/camera_info"),
    )
    subscribed = [
        message_filters.Subscriber(node, kind, topic, qos_profile=qos_profile_sensor_data)
        for kind, topic in topics
    ]
    together = message_filters.ApproximateTimeSynchronizer(subscribed, queue_size=5, slop=0.02)
    together.registerCallback(lambda *messages: newest.give(messages))
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
