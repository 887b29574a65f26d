"""The node: ROS on one side, graspd on the other.

The executor's threads run the callbacks of ROS. Everything else runs in the event loop of the client, in a thread of its
own, so that a request is cancelled, by its client or at the end, by cancelling its task.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import threading
import time

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
from graspd_ros.calls import Calls
from graspd_ros.detector import Detector
from graspd_ros.diagnostics import Diagnostics
from graspd_ros.images import Images
from graspd_ros.parameters import Parameters
from graspd_ros.refusal import Refusal
from graspd_ros.results import Results
from graspd_ros.tracking import Tracker
from graspd_ros.transforms import Transforms

SPARE_THREADS = 4
"""For images, transforms, cancellation and refusals while all other threads wait for the answers to requests."""
RESULTS_KEPT = 60
"""How long the results of goals can be requested, seconds."""
GRACE = 0.2
"""Time for ROS to deliver the last results, which it does not confirm, seconds."""


class GraspNode:
    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        settings = Parameters(node)
        values = settings.values()
        self.threads = int(values["max_goals"]) + SPARE_THREADS

        self._loop = asyncio.new_event_loop()
        self._client = graspd.aio.Client(**parameters.connection(values))
        images = Images(node, MutuallyExclusiveCallbackGroup(), self._loop, values["input"], values["labels"])
        transforms = Transforms(node, MutuallyExclusiveCallbackGroup())
        detector = Detector(self._client, values["address"], images, transforms)
        results = Results(node)
        self._calls = Calls(int(values["max_goals"]), self._loop, detector, results, settings.values, self._logger)
        tracker = Tracker(self._client, detector, images, results, settings.values, self._logger)
        diagnostics = Diagnostics(node, self._client, values["address"], images, self._calls.counts)
        self._background = [self._loop.create_task(each.run()) for each in (tracker, diagnostics)]
        for task in self._background:
            task.add_done_callback(self._ended)
        self._thread = threading.Thread(target=self._loop.run_forever, name="graspd client")
        self._thread.start()

        # An action server of rclpy must not run in several threads at the same time; its goals are tasks of their own.
        self._action = ActionServer(
            node,
            action.DetectGrasps,
            "~/detect_grasps",
            self._execute,
            callback_group=MutuallyExclusiveCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            result_timeout=RESULTS_KEPT,
        )
        self._service = node.create_service(
            srv.DetectGrasps, "~/detect_grasps", self._serve, callback_group=ReentrantCallbackGroup()
        )

    def finish(self) -> None:
        """Ends all requests, then the client."""
        self._calls.finish()
        time.sleep(GRACE)
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    async def _close(self) -> None:
        for task in self._background:
            task.cancel()
        await asyncio.gather(*self._background, return_exceptions=True)
        await self._client.close()

    def _ended(self, task: asyncio.Task) -> None:
        if not task.cancelled():
            self._logger.fatal(f"internal error, please report it: {task.exception()!r}")
            stop()

    def _serve(self, request: srv.DetectGrasps.Request, response: srv.DetectGrasps.Response) -> srv.DetectGrasps.Response:
        self._calls.answer(request, response)
        return response

    def _execute(self, goal: ServerGoalHandle) -> action.DetectGrasps.Result:
        result = action.DetectGrasps.Result()

        def report(stage: str) -> None:
            goal.publish_feedback(action.DetectGrasps.Feedback(stage=stage))

        self._calls.answer(goal.request, result, report, lambda: goal.is_cancel_requested)
        if not result.error:
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result


def stop() -> None:
    """Ends the node as a signal does."""
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    # Not rclpy's handlers, which end the communication before running goals have their results. Blocked in all threads,
    # the signals wait for `sigwait`.
    signals = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("graspd")
    try:
        grasps = GraspNode(node)
    except (OSError, Refusal) as refusal:
        sys.exit(f"graspd_node: {refusal}")
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
            stop()

    spinning = threading.Thread(target=spin, name="executor")
    spinning.start()
    signal.sigwait(signals)
    grasps.finish()
    executor.shutdown()
    spinning.join()
    node.destroy_node()
    rclpy.try_shutdown()
    if failures:
        raise failures[0]
