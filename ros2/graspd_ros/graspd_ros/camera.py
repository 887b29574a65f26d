"""Images, intrinsics and points from the messages of a camera."""

from __future__ import annotations

import numpy as np
from graspd import Camera
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from graspd_ros.refusal import Refusal

DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
LABELS = {"8UC1": "u1", "mono8": "u1", "16UC1": "u2", "mono16": "u2", "32SC1": "i4"}


def depth(image: Image, topic: str) -> NDArray:
    """The depths of an image: integers are millimetres, floats metres."""
    needed = "16UC1 (millimetres) or 32FC1 (metres)"
    return pixels(image, DEPTHS, topic, f"{needed}: remap depth/image to the depth image, not to a colour or compressed one")


def labels(image: Image, topic: str) -> NDArray:
    return pixels(image, LABELS, topic, "8UC1, 16UC1 or 32SC1: one label for each pixel, 0 for no object")


def pixels(image: Image, types: dict[str, str], topic: str, needed: str) -> NDArray:
    if image.encoding not in types:
        raise Refusal("INVALID_IMAGE", f"the encoding on {topic} is {image.encoding!r}, must be {needed}")
    kind = np.dtype(types[image.encoding]).newbyteorder(">" if image.is_bigendian else "<")
    # Rows may be padded.
    if image.step < image.width * kind.itemsize or len(image.data) != image.step * image.height or not image.data:
        raise Refusal(
            "INVALID_IMAGE",
            f"the image on {topic} has {len(image.data)} bytes, must have {image.height} rows of {image.step} bytes, each "
            f"for {image.width} pixels of {kind.itemsize} bytes",
        )
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    return rows[:, : image.width * kind.itemsize].copy().view(kind)


def intrinsics(info: CameraInfo, image: Image, topic: str) -> Camera:
    """The camera of a rectified image, with the matrix `p`; or that of the lens, if the driver leaves `p` empty."""
    try:
        camera = Camera.from_info(info, rectified=bool(info.p[0]))
        camera.check_size(image.width, image.height)
    except ValueError as error:
        raise Refusal(
            "INVALID_IMAGE", f"the CameraInfo on {topic}: {error}; remap depth/camera_info to that of the depth image"
        ) from None
    return camera


def points(cloud: PointCloud2, topic: str) -> NDArray:
    """A structured array [row][column] with x, y and z."""
    offsets = {field.name: field.offset for field in cloud.fields if field.datatype == PointField.FLOAT32}
    if not {"x", "y", "z"} <= set(offsets):
        names = ", ".join(field.name for field in cloud.fields)
        raise Refusal("INVALID_IMAGE", f"the fields on {topic} are {names or 'empty'}, must include x, y and z as FLOAT32")
    size = cloud.point_step * cloud.width
    if cloud.row_step < size or len(cloud.data) != cloud.row_step * cloud.height or not cloud.data:
        raise Refusal(
            "INVALID_IMAGE",
            f"the cloud on {topic} has {len(cloud.data)} bytes, must have {cloud.height} rows of {cloud.row_step} bytes, "
            f"each for {cloud.width} points of {cloud.point_step} bytes",
        )
    kind = np.dtype({
        "names": ["x", "y", "z"],
        "formats": [">f4" if cloud.is_bigendian else "<f4"] * 3,
        "offsets": [offsets[axis] for axis in "xyz"],
        "itemsize": cloud.point_step,
    })
    rows = np.frombuffer(cloud.data, np.uint8).reshape(cloud.height, cloud.row_step)
    return rows[:, :size].copy().view(kind)
