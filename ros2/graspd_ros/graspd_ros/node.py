"""The node: ROS on one side, graspd on the other.

The executor's threads run the callbacks of ROS. Everything else runs in the event loop of the client, in a thread of its
own, so that a request is cancelled, by its client or at the end, by cancelling its task.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, TimeoutError
from typing import Any

import graspd
import rclpy
from graspd_msgs import action, srv
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from graspd_ros import parameters
from graspd_ros.detector import Detector, Query
from graspd_ros.diagnostics import Counts, Diagnostics
from graspd_ros.images import Images
from graspd_ros.parameters import Parameters
from graspd_ros.refusal import Refusal
from graspd_ros.results import Results
from graspd_ros.tracking import Tracker
from graspd_ros.transforms import Transforms

SPARE_THREADS = 4
"""For images, transforms, cancellation and refusals while all other threads wait for the answers to requests."""
POLL = 0.02
"""Between two looks for the cancellation of a goal, seconds."""
GRACE = 0.2
"""For the transport of the last results, which ROS does not confirm, seconds."""


class GraspNode:
    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        self._parameters = Parameters(node)
        values = self._parameters.values()
        self._limit = int(values["max_goals"])
        self._lock = threading.Lock()
        self._running: set[Future] = set()
        self._is_stopping = False
        self._counts = Counts()

        self._loop = asyncio.new_event_loop()
        address = values["address"]
        client = graspd.aio.Client(**parameters.address(values))
        images = Images(node, MutuallyExclusiveCallbackGroup(), self._loop, values["input"], values["labels"])
        self._results = Results(node)
        self._detector = Detector(client, address, images, Transforms(node, MutuallyExclusiveCallbackGroup()))
        tracker = Tracker(client, self._detector, images, self._results, self._parameters.values, self._warn)
        diagnostics = Diagnostics(node, client, address, images, self._counts)
        self._background = [self._loop.create_task(each.run()) for each in (tracker, diagnostics)]
        self._thread = threading.Thread(target=self._loop.run_forever, name="graspd client")
        self._thread.start()

        # rclpy does not support an action server in several threads; its goals have tasks of their own.
        self._action = ActionServer(
            node,
            action.DetectGrasps,
            "~/detect_grasps",
            self._execute,
            callback_group=MutuallyExclusiveCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            result_timeout=60,
        )
        self._service = node.create_service(
            srv.DetectGrasps, "~/detect_grasps", self._serve, callback_group=ReentrantCallbackGroup()
        )

    @property
    def threads(self) -> int:
        return self._limit + SPARE_THREADS

    def finish(self) -> None:
        """Ends all requests with an error, and the client."""
        with self._lock:
            self._is_stopping = True
            running = list(self._running)
        for task in running:
            task.cancel()
        while self._running:
            time.sleep(POLL)
        time.sleep(GRACE)
        for task in self._background:
            self._loop.call_soon_threadsafe(task.cancel)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _serve(self, request: srv.DetectGrasps.Request, response: srv.DetectGrasps.Response) -> srv.DetectGrasps.Response:
        self._answer(request, response, lambda stage: None, lambda: False)
        return response

    def _execute(self, goal: ServerGoalHandle) -> action.DetectGrasps.Result:
        result = action.DetectGrasps.Result()

        def report(stage: str) -> None:
            goal.publish_feedback(action.DetectGrasps.Feedback(stage=stage))

        self._answer(goal.request, result, report, lambda: goal.is_cancel_requested)
        if not result.error:
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _answer(self, request: Any, answer: Any, report: Callable[[str], None], is_cancelled: Callable[[], bool]) -> None:
        """Fills the answer, which always has an error or a detection."""
        try:
            query = Query(request.frame_id, request.workspace, request.options, self._parameters.values())
            task = self._start(query, report)
            try:
                answer.detection, options = result(task, is_cancelled)
            finally:
                self._end(task)
            self._results.publish(answer.detection, options)
        except CancelledError:
            answer.error, answer.message = "CANCELLED", "cancelled by the client"
            if self._is_stopping:
                answer.error, answer.message = "SHUTTING_DOWN", "the node is shutting down"
        except Refusal as refusal:
            answer.error, answer.message = refusal.error, refusal.message
        except Exception as error:  # a request never ends without an answer
            self._logger.error(f"internal error: {error!r}")
            answer.error, answer.message = "INTERNAL", f"error of the node: {error!r}"
        self._count(answer)

    def _start(self, query: Query, report: Callable[[str], None]) -> Future:
        with self._lock:
            if self._is_stopping:
                raise Refusal("SHUTTING_DOWN", "the node is shutting down")
            if len(self._running) >= self._limit:
                raise Refusal(
                    "RESOURCE_EXHAUSTED", f"{self._limit} requests are running: wait for one, or raise the parameter max_goals"
                )
            task = asyncio.run_coroutine_threadsafe(self._detector.detect(query, report), self._loop)
            self._running.add(task)
            self._counts.running = len(self._running)
        return task

    def _end(self, task: Future) -> None:
        with self._lock:
            self._running.discard(task)
            self._counts.running = len(self._running)

    def _count(self, answer: Any) -> None:
        with self._lock:
            counts = self._counts
            counts.failed_last = answer.error not in ("", "CANCELLED")
            if counts.failed_last:
                counts.failed += 1
                counts.last_error = f"{answer.error}: {answer.message}"
            elif answer.error:
                counts.cancelled += 1
            else:
                counts.succeeded += 1
        if answer.error:
            self._warn(f"{answer.error}: {answer.message}")

    def _warn(self, text: str) -> None:
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


def main() -> None:
    # Not rclpy's handlers, which end the communication before running goals have their results.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    node = rclpy.create_node("graspd")
    try:
        grasps = GraspNode(node)
    except Refusal as refusal:
        sys.exit(f"graspd_node: {refusal.message}")
    executor = MultiThreadedExecutor(grasps.threads)
    executor.add_node(node)
    failures: list[BaseException] = []

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            pass
        except BaseException as failure:
            failures.append(failure)
        stopped.set()

    spinning = threading.Thread(target=spin, name="executor")
    spinning.start()
    stopped.wait()
    grasps.finish()
    executor.shutdown()
    spinning.join()
    node.destroy_node()
    rclpy.try_shutdown()
    if failures:
        raise failures[0]
