"""Calls and goals, from the request to the answer: their number is limited, and each ends with a detection or an error."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, TimeoutError
from dataclasses import dataclass
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger

from graspd_ros.detector import Detector, Query
from graspd_ros.refusal import Refusal
from graspd_ros.results import Results

POLL = 0.02
"""Pause between two checks for a cancellation, seconds."""


@dataclass
class Counts:
    """Numbers of calls since the start of the node."""

    running: int = 0
    succeeded: int = 0
    cancelled: int = 0
    failed: int = 0
    error: str = ""
    """Error of the last call."""


class Calls:
    """`answer` is called in the executor's threads, and blocks until the task in the event loop ends."""

    def __init__(
        self,
        limit: int,
        loop: asyncio.AbstractEventLoop,
        detector: Detector,
        results: Results,
        values: Callable[[], dict[str, Any]],
        logger: RcutilsLogger,
    ) -> None:
        self.counts = Counts()
        self._limit = limit
        self._loop = loop
        self._detector = detector
        self._results = results
        self._values = values
        self._logger = logger
        self._lock = threading.Lock()
        self._running: set[Future] = set()
        self._is_stopping = False

    def answer(
        self,
        request: Any,
        answer: Any,
        report: Callable[[str], None] = lambda stage: None,
        is_cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        """Fills the answer to a request of the service or the action, whose fields are the same."""
        try:
            query = Query(request.frame_id, request.workspace, request.options, self._values())
            task = self._start(query, report)
            try:
                answer.detection = result(task, is_cancelled)
            finally:
                self._end(task)
            self._results.publish(answer.detection, query.options)
        except CancelledError:
            answer.error, answer.message = "CANCELLED", "cancelled by the client"
            if self._is_stopping:
                answer.error, answer.message = stopping()
        except Refusal as refusal:
            answer.error, answer.message = refusal.error, refusal.message
        except Exception as error:  # otherwise the client would wait for ever
            answer.error, answer.message = "INTERNAL", f"error of the node, please report it: {error!r}"
        self._count(answer)

    def finish(self) -> None:
        """Ends all calls with an error."""
        with self._lock:
            self._is_stopping = True
            running = list(self._running)
        for task in running:
            task.cancel()
        while self._running:
            time.sleep(POLL)

    def _start(self, query: Query, report: Callable[[str], None]) -> Future:
        with self._lock:
            if self._is_stopping:
                raise Refusal(*stopping())
            if len(self._running) >= self._limit:
                text = f"{self._limit} requests are running: wait for one, or raise the parameter max_goals"
                raise Refusal("RESOURCE_EXHAUSTED", text)
            task = asyncio.run_coroutine_threadsafe(self._detector.detect(query, report), self._loop)
            self._running.add(task)
            self.counts.running = len(self._running)
        return task

    def _end(self, task: Future) -> None:
        with self._lock:
            self._running.discard(task)
            self.counts.running = len(self._running)

    def _count(self, answer: Any) -> None:
        text = f"{answer.error}: {answer.message}" if answer.error else ""
        is_cancelled = answer.error == "CANCELLED"
        with self._lock:
            self.counts.error = "" if is_cancelled else text
            self.counts.succeeded += not text
            self.counts.cancelled += is_cancelled
            self.counts.failed += bool(text) and not is_cancelled
        if text:
            self._logger.warning(text)


def result(task: Future, is_cancelled: Callable[[], bool]) -> Any:
    while True:
        try:
            return task.result(POLL)
        except TimeoutError:
            if task.done():
                raise
            if is_cancelled():
                task.cancel()


def stopping() -> tuple[str, str]:
    return "SHUTTING_DOWN", "the node is shutting down"
