"""Tracking: while the parameter `track` is set, each image is added to a volume that the server keeps."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import graspd
from graspd_msgs.msg import Options, Workspace
from rclpy.impl.rcutils_logger import RcutilsLogger

from graspd_ros import parameters
from graspd_ros.detector import Detector, Query, message
from graspd_ros.images import Images
from graspd_ros.refusal import Refusal
from graspd_ros.results import Results

PAUSE = 1.0
"""Pause after a failure, seconds; also the interval at which `track` is read while it is not set."""


class Tracker:
    def __init__(
        self,
        client: graspd.aio.Client,
        detector: Detector,
        images: Images,
        results: Results,
        values: Callable[[], dict[str, Any]],
        logger: RcutilsLogger,
    ) -> None:
        self._client = client
        self._detector = detector
        self._images = images
        self._results = results
        self._values = values
        self._logger = logger
        self._failure = ""

    async def run(self) -> None:
        while True:
            if self._values()["track"]:
                try:
                    await self._track()
                except Refusal as refusal:
                    self._failed(refusal)
            await asyncio.sleep(PAUSE)

    async def _track(self) -> None:
        """Tracks until `track` is unset or a call fails. Images that arrive while the server computes are skipped."""
        query = self._query()
        seen = await self._images.next(query.values["image_timeout"])
        workspace = await self._detector.workspace(query, seen)
        async with self._client.track(workspace, half_life=parameters.number(query.values, "half_life")) as tracking:
            table = None
            while query.values["track"]:
                try:
                    view = await self._detector.view(query, seen)
                except Refusal as refusal:  # of this image: the volume stays
                    self._failed(refusal)
                else:
                    found = await self._detector.answer(tracking.add(view, query.options, stamp=seen.stamp))
                    # Only the first reply has the table, which is found in the first image.
                    table = found.table or table
                    found = replace(found, table=table)
                    self._results.publish(message(query, seen, found), query.options)
                    self._failure = ""
                seen = await self._images.next(query.values["image_timeout"])
                query = self._query()

    def _failed(self, refusal: Refusal) -> None:
        """Reports a failure once, not with every image."""
        if refusal.error != self._failure:
            self._logger.warning(f"tracking: {refusal}")
        self._failure = refusal.error

    def _query(self) -> Query:
        return Query("", Workspace(), Options(), self._values())
