"""What the camera saw last: a depth image with its CameraInfo, or a point cloud, and the labels of the same stamp."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import graspd
from numpy.typing import NDArray
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from graspd_ros import camera
from graspd_ros.refusal import Refusal
from graspd_ros.transforms import nanoseconds

KEPT = 30
"""Maximum number of images that wait for their labels, and of labels that wait for their images."""


@dataclass(frozen=True)
class Seen:
    """The messages of one moment."""

    message: Image | PointCloud2
    info: CameraInfo | None
    """None: a point cloud."""
    labels: Image | None
    arrived: float
    """`time.monotonic()`."""
    topics: Topics

    @property
    def frame_id(self) -> str:
        return self.message.header.frame_id

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        return nanoseconds(self.message.header.stamp)

    @property
    def is_cloud(self) -> bool:
        return self.info is None

    def depth_view(self, frame_from_camera: NDArray) -> graspd.DepthView:
        depth = camera.depth(self.message, self.topics.input)
        k = camera.intrinsics(self.info, self.message, self.topics.info)
        return graspd.DepthView(depth, k, frame_from_camera=frame_from_camera, labels=self._labels())

    def cloud_view(self, frame_from_cloud: NDArray, camera_position: NDArray) -> graspd.CloudView:
        points = camera.points(self.message, self.topics.input)
        return graspd.CloudView(points, camera_position, frame_from_cloud, self._labels())

    def _labels(self) -> NDArray | None:
        if self.labels is None:
            return None
        sizes = [(message.width, message.height) for message in (self.labels, self.message)]
        if sizes[0] != sizes[1]:
            own, needed = (f"{width} × {height} pixels" for width, height in sizes)
            text = f"the labels on {self.topics.labels} have {own}, must have {needed}, as the input"
            raise Refusal("INVALID_IMAGE", text)
        return camera.labels(self.labels, self.topics.labels)


@dataclass(frozen=True)
class Topics:
    """Names after remapping; empty: not subscribed."""

    input: str
    info: str
    labels: str


class Images:
    """Subscribes to the topics of the camera. Its other methods are called in `loop`."""

    def __init__(
        self, node: Node, group: CallbackGroup, loop: asyncio.AbstractEventLoop, kind: str, labels: bool
    ) -> None:
        self._node = node
        self._loop = loop
        self._group = group
        self.count = 0
        """Number of images or clouds that arrived."""
        self._latest: Seen | None = None
        self._info: CameraInfo | None = None
        # By stamp, until their counterparts arrive.
        self._messages: dict[int, Image | PointCloud2] = {}
        self._labels: dict[int, Image] = {}
        self._next: asyncio.Future[Seen] | None = None
        is_depth = kind == "depth"
        self.topics = Topics(
            input=self._subscribe(*((Image, "depth/image") if is_depth else (PointCloud2, "points")), self._add),
            info=self._subscribe(CameraInfo, "depth/camera_info", self._add_info) if is_depth else "",
            labels=self._subscribe(Image, "labels", self._add_labels) if labels else "",
        )

    def _subscribe(self, kind: type, topic: str, add: Callable[[Any], None]) -> str:
        """Returns the name of the topic after remapping."""
        self._node.create_subscription(
            kind,
            topic,
            lambda message: self._loop.call_soon_threadsafe(add, message),
            qos_profile_sensor_data,
            callback_group=self._group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        return self._node.resolve_topic_name(topic)

    async def next(self, timeout: float, age: float = 0.0) -> Seen:
        """The next image, or one that arrived up to `age` seconds ago."""
        if self._latest is not None and time.monotonic() - self._latest.arrived <= age:
            return self._latest
        if self._next is None:
            self._next = self._loop.create_future()
        count = self.count
        try:
            # Shielded: others may wait for the same image.
            return await asyncio.wait_for(asyncio.shield(self._next), timeout)
        except asyncio.TimeoutError:
            raise Refusal("NO_IMAGE", f"{self._silence(self.count > count)} within {timeout} s") from None

    def _silence(self, has_image: bool) -> str:
        """What did not arrive, and why."""
        if not has_image:
            return self._missing("image" if self.topics.info else "point cloud", self.topics.input)
        if self.topics.info and self._info is None:
            return self._missing("CameraInfo", self.topics.info)
        return f"no labels on {self.topics.labels} with the stamp of an image on {self.topics.input}"

    def _missing(self, what: str, topic: str) -> str:
        publishers = self._node.count_publishers(topic)
        hint = "check the camera and the network" if publishers else "start the camera, or remap the topic"
        return f"no {what} on {topic} (publishers: {publishers}; {hint})"

    def _add(self, message: Image | PointCloud2) -> None:
        self.count += 1
        self._keep(self._messages, message)

    def _add_labels(self, labels: Image) -> None:
        self._keep(self._labels, labels)

    def _add_info(self, info: CameraInfo) -> None:
        # Later messages replace it: the focal length of some cameras changes.
        self._info = info
        for stamp in list(self._messages)[-1:]:
            self._pair(stamp)

    def _keep(self, messages: dict[int, Any], message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        messages[stamp] = message
        while len(messages) > KEPT:
            del messages[next(iter(messages))]
        self._pair(stamp)

    def _pair(self, stamp: int) -> None:
        message, labels = self._messages.get(stamp), self._labels.get(stamp)
        has_info, has_labels = self._info is not None, labels is not None
        if message is not None and (has_info or not self.topics.info) and (has_labels or not self.topics.labels):
            del self._messages[stamp]
            self._labels.pop(stamp, None)
            self._complete(message, labels)

    def _complete(self, message: Image | PointCloud2, labels: Image | None) -> None:
        self._latest = Seen(message, self._info, labels, time.monotonic(), self.topics)
        waiting, self._next = self._next, None
        if waiting is not None and not waiting.done():
            waiting.set_result(self._latest)
