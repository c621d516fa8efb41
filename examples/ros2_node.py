#!/usr/bin/env python3
"""A ROS 2 node that measures with the service: colour, depth and camera info to 3D.

    cucumbervision serve                                     # somewhere, in its own Python
    ros2 run realsense2_camera realsense2_camera_node --ros-args -p align_depth.enable:=true
    python3 examples/ros2_node.py --ros-args -p url:=http://127.0.0.1:8600

It needs ROS 2 with vision_msgs, NumPy and OpenCV, and nothing of this package: Python 3.10 will do.
It sends one frame at a time, always the newest; the others are dropped. It publishes, in the
coordinates of the colour camera:

    ~/detections  vision_msgs/Detection3DArray: each fruit's box, x along the axis to the stem end;
                  the hypothesis' pose is the place to cut with its covariance
    ~/cuts        geometry_msgs/PoseArray: the places to cut, x along the peduncle
    ~/tubes       visualization_msgs/MarkerArray: each fruit's tube
    ~/fruit       std_msgs/String: the service's reply as JSON
"""

from __future__ import annotations

import io
import json
import os
import secrets
import threading
import urllib.request
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

_COLORS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_DEPTHS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}  # REP 118
_LENSES = ("plumb_bob", "rational_polynomial")
_ASIDE_RAD = 0.26  # what a peduncle turns aside
_TIMEOUT_S = 60.0


def pixels(image: Any, kind: str, channels: int) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image without row padding."""
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    used = np.ascontiguousarray(rows[:, : image.width * channels * dtype.itemsize])
    return used.view(dtype).reshape(image.height, image.width, channels)


def arrays_of(color: Any, depth: Any, info: Any) -> dict[str, np.ndarray]:
    """Return colour, depth in metres and the camera's matrix, without the lens' distortion.

    Parameters
    ----------
    color, depth, info
        Image, Image aligned to it, and colour's CameraInfo with up to 8 coefficients.

    Raises
    ------
    ValueError
        If an encoding or lens model is not supported.
    """
    if color.encoding not in _COLORS or depth.encoding not in _DEPTHS:
        raise ValueError(
            f"colour {color.encoding} with depth {depth.encoding} is not supported; "
            "publish rgb8 and 16UC1 or 32FC1"
        )
    rgb = pixels(color, "u1", _COLORS[color.encoding])[..., :3]
    if color.encoding.startswith("bgr"):
        rgb = rgb[..., ::-1]
    kind, unit_m = _DEPTHS[depth.encoding]
    depth_m = (pixels(depth, kind, 1)[..., 0] * np.float32(unit_m)).astype(np.float32)
    depth_m = np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0)
    matrix, lens = np.array(info.k, np.float64).reshape(3, 3), np.array(info.d, np.float64)
    rgb = np.ascontiguousarray(rgb)
    if lens.any():
        if info.distortion_model not in _LENSES:
            raise ValueError(
                f"the lens model {info.distortion_model} is not supported; "
                "publish rectified pictures (image_proc)"
            )
        size = (info.width, info.height)
        u, v = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, size, cv2.CV_32FC1)
        rgb = cv2.remap(rgb, u, v, cv2.INTER_LINEAR)
        depth_m = cv2.remap(depth_m, u, v, cv2.INTER_NEAREST)  # no mean of fruit and background
    return {"color": rgb, "depth": depth_m, "matrix": matrix}


def ask(url: str, arrays: dict[str, np.ndarray], token: str = "") -> dict[str, Any]:
    """Return the service's reply to one frame.

    Raises
    ------
    OSError, ValueError
        If it does not answer, refuses, or could not measure the frame.
    """
    border, depth = secrets.token_hex(16), io.BytesIO()
    np.save(depth, arrays["depth"])
    color = cv2.imencode(".png", arrays["color"][..., ::-1])[1].tobytes()
    matrix = json.dumps(arrays["matrix"].tolist()).encode()
    body, head = b"", 'Content-Disposition: form-data; name="files"; filename='
    for name, data in (("color.png", color), ("depth.npy", depth.getvalue()), ("K.json", matrix)):
        body += f'--{border}\r\n{head}"{name}"\r\n\r\n'.encode() + data + b"\r\n"
    request = urllib.request.Request(f"{url}/measure", body + f"--{border}--\r\n".encode())
    request.add_header("Content-Type", f"multipart/form-data; boundary={border}")
    if token:
        request.add_header("Authorization", f"Bearer {token}")
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
        reply: dict[str, Any] = json.load(answer)
    if reply["failures"]:
        raise ValueError(reply["failures"][0]["message"])
    return reply


def posed_fruit(reply: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the fruit of a reply that have a pose."""
    return [one for capture in reply["captures"] for one in capture["fruit"] if one["pose"]]


def pose_at(msgs: Any, place_m: Any, direction: Any) -> Any:
    """Return a geometry_msgs/Pose there, its x axis along a unit vector."""
    x, y, z = (float(value) for value in direction)
    # The rotation that takes (1, 0, 0) there; half a turn about z where it is the opposite.
    quaternion = np.array([0.0, -z, y, 1.0 + x]) if x > -0.999999 else np.array([0.0, 0, 1, 0])
    quaternion = quaternion / np.linalg.norm(quaternion)
    pose = msgs.Pose()
    pose.position.x, pose.position.y, pose.position.z = (float(value) for value in place_m)
    for name, value in zip("xyzw", quaternion.tolist(), strict=True):
        setattr(pose.orientation, name, value)
    return pose


def detections(msgs: Any, header: Any, reply: dict[str, Any]) -> Any:
    """Return the fruit of a reply as a vision_msgs/Detection3DArray."""
    found = msgs.Detection3DArray(header=header)
    for fruit in posed_fruit(reply):
        pose = fruit["pose"]
        axis, radius = np.array(pose["axis_m"]), np.array(pose["radius_m"])
        run = (axis[0] - axis[-1]) / np.linalg.norm(axis[0] - axis[-1])
        along = (axis - axis.mean(axis=0)) @ run
        across = np.linalg.norm(axis - axis.mean(axis=0) - along[:, None] * run, axis=1)
        one = msgs.Detection3D(header=header, id=str(fruit.get("track", fruit["fruit"])))
        middle = axis.mean(axis=0) + (along.max() + along.min()) / 2 * run
        one.bbox.center = pose_at(msgs, middle, run)
        one.bbox.size.x = float(np.ptp(along))
        one.bbox.size.y = one.bbox.size.z = float(2 * (across + radius).max())
        result = msgs.ObjectHypothesisWithPose()
        result.hypothesis.class_id = fruit["label"]
        result.hypothesis.score = float(fruit["score"])
        if pose["cut_m"] is not None:
            direction = np.array(pose["direction"])
            turn = np.outer(direction, direction)
            covariance = np.zeros((6, 6))
            covariance[:3, :3] = pose["cut_covariance_m2"]
            # About its own axis nothing is known.
            covariance[3:, 3:] = _ASIDE_RAD**2 * (np.eye(3) - turn) + np.pi**2 / 3 * turn
            result.pose.pose = pose_at(msgs, pose["cut_m"], direction)
            result.pose.covariance = covariance.ravel().tolist()
            one.results.append(result)
        found.detections.append(one)
    return found


def cuts(msgs: Any, header: Any, reply: dict[str, Any]) -> Any:
    """Return the places to cut of a reply as a geometry_msgs/PoseArray."""
    found = msgs.PoseArray(header=header)
    for pose in (fruit["pose"] for fruit in posed_fruit(reply)):
        if pose["cut_m"] is not None:
            found.poses.append(pose_at(msgs, pose["cut_m"], pose["direction"]))
    return found


def tubes(msgs: Any, header: Any, reply: dict[str, Any]) -> Any:
    """Return the fruit of a reply as a visualization_msgs/MarkerArray, what was shown removed."""
    found = msgs.MarkerArray()
    found.markers.append(msgs.Marker(header=header, action=msgs.Marker.DELETEALL))
    for number, fruit in enumerate(posed_fruit(reply)):
        pose = fruit["pose"]
        one = msgs.Marker(header=header, ns="fruit", id=number, type=msgs.Marker.SPHERE_LIST)
        one.pose.orientation.w = 1.0
        one.scale.x = one.scale.y = one.scale.z = 2 * float(np.mean(pose["radius_m"]))
        one.color.g, one.color.a = 0.6, 0.6
        for x, y, z in pose["axis_m"]:
            one.points.append(msgs.Point(x=float(x), y=float(y), z=float(z)))
        found.markers.append(one)
    return found


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


def messages() -> SimpleNamespace:
    """Return the message types that are published."""
    from geometry_msgs.msg import Point, Pose, PoseArray
    from std_msgs.msg import String
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose
    from visualization_msgs.msg import Marker, MarkerArray

    return SimpleNamespace(
        Point=Point,
        Pose=Pose,
        PoseArray=PoseArray,
        String=String,
        Detection3D=Detection3D,
        Detection3DArray=Detection3DArray,
        ObjectHypothesisWithPose=ObjectHypothesisWithPose,
        Marker=Marker,
        MarkerArray=MarkerArray,
    )


def main() -> None:
    """Run the node."""
    import message_filters
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image

    rclpy.init()
    node, msgs = Node("cucumbervision"), messages()
    node.declare_parameter("url", "http://127.0.0.1:8600")
    node.declare_parameter("camera", "/camera/camera")
    camera = node.get_parameter("camera").value
    url, token = node.get_parameter("url").value, os.environ.get("CUCUMBERVISION_TOKEN", "")
    published = [
        (node.create_publisher(msgs.Detection3DArray, "~/detections", 10), detections),
        (node.create_publisher(msgs.PoseArray, "~/cuts", 10), cuts),
        (node.create_publisher(msgs.MarkerArray, "~/tubes", 10), tubes),
    ]
    text = node.create_publisher(msgs.String, "~/fruit", 10)

    def measure(given: tuple[Any, Any, Any]) -> None:
        try:
            reply = ask(url, arrays_of(*given), token)
        except (OSError, ValueError) as error:
            node.get_logger().warning(str(error))
            return
        for publisher, made in published:
            publisher.publish(made(msgs, given[0].header, reply))
        text.publish(msgs.String(data=json.dumps(reply)))

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
    together.registerCallback(lambda *given: newest.give(given))
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
