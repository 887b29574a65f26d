"""Publishes the state of the server, the images and the requests on /diagnostics."""

from __future__ import annotations

import asyncio
import time

import graspd
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from graspd_ros.calls import Counts
from graspd_ros.images import Images

PERIOD = 1.0
"""Seconds."""


class Diagnostics:
    def __init__(self, node: Node, client: graspd.aio.Client, address: str, images: Images, counts: Counts) -> None:
        self._node = node
        self._client = client
        self._address = address
        self._images = images
        self._counts = counts
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    async def run(self) -> None:
        count, start = self._images.count, time.monotonic()
        while True:
            server = await self._server()
            await asyncio.sleep(PERIOD)
            now = time.monotonic()
            rate = (self._images.count - count) / (now - start)
            count, start = self._images.count, now
            array = DiagnosticArray(status=[server, self._image_status(rate), self._request_status()])
            array.header.stamp = self._node.get_clock().now().to_msg()
            self._publisher.publish(array)

    async def _server(self) -> DiagnosticStatus:
        try:
            is_ready = await self._client.health()
        except graspd.Error as error:
            return self._status("server", DiagnosticStatus.ERROR, f"not available: {error.message}")
        level = DiagnosticStatus.OK if is_ready else DiagnosticStatus.WARN
        return self._status("server", level, "ready" if is_ready else "not ready: see its log")

    def _image_status(self, rate: float) -> DiagnosticStatus:
        level = DiagnosticStatus.OK if rate else DiagnosticStatus.WARN
        text = f"{rate:.1f} per second" if rate else f"none on {self._images.topics.input}"
        return self._status("images", level, text, rate=f"{rate:.1f}", topic=self._images.topics.input)

    def _request_status(self) -> DiagnosticStatus:
        counts = self._counts
        level = DiagnosticStatus.WARN if counts.error else DiagnosticStatus.OK
        numbers = {name: str(getattr(counts, name)) for name in ["running", "succeeded", "cancelled", "failed"]}
        return self._status("requests", level, counts.error or "no error", **numbers)

    def _status(self, name: str, level: bytes, text: str, **values: str) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=level,
            name=f"{self._node.get_name()}: {name}",
            message=text,
            hardware_id=self._address,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
