"""From a request to grasps: the next image, its transform, the call of graspd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import graspd
from graspd_msgs.action import DetectGrasps
from graspd_msgs.msg import Detection, Options, Workspace
from std_msgs.msg import Header

from graspd_ros import messages, parameters
from graspd_ros.images import Images, Seen
from graspd_ros.refusal import Refusal
from graspd_ros.transforms import Transforms

STAGE = DetectGrasps.Feedback
PLACE = {"frame_id", "pose"}
"""The fields that place the workspace: a request that sets one of them replaces both parameters."""


class Query:
    """A request. What it does not set has the values of the parameters."""

    def __init__(self, frame_id: str, workspace: Workspace, options: Options, values: dict[str, Any]) -> None:
        self.values = values
        self.frame_id = frame_id or values["frame_id"]
        default, own = parameters.workspace(values), messages.workspace(workspace)
        if workspace.find_table or own.keys() & PLACE:
            default = {name: value for name, value in default.items() if name not in PLACE}
        self.workspace = {**default, **own}
        try:
            self.options = graspd.Options(**{**parameters.options(values), **messages.options(options)})
        except ValueError as error:
            raise Refusal("INVALID_ARGUMENT", str(error)) from None


class Detector:
    """Its methods run in the event loop of the client."""

    def __init__(self, client: graspd.aio.Client, address: str, images: Images, transforms: Transforms) -> None:
        self._client = client
        self._address = address
        self._images = images
        self._transforms = transforms

    async def detect(self, query: Query, report: Callable[[str], None]) -> Detection:
        report(STAGE.WAITING_FOR_IMAGE)
        seen = await self._images.next(query.values["image_timeout"], query.values["image_age"])
        report(STAGE.LOOKING_UP_TRANSFORM)
        view = await self.view(query, seen)
        workspace = await self.workspace(query, seen)
        report(STAGE.DETECTING)
        call = self._client.detect_from_cloud if seen.is_cloud else self._client.detect_from_depth
        found = await self.answer(call(view, workspace, query.options))
        return message(query, seen, found)

    async def view(self, query: Query, seen: Seen) -> graspd.DepthView | graspd.CloudView:
        timeout, stamp = query.values["transform_timeout"], seen.stamp
        frame, camera = query.frame_id or seen.frame_id, query.values["camera_frame_id"] or seen.frame_id
        if not seen.is_cloud:
            return seen.depth_view(await self._transforms.lookup(frame, camera, stamp, timeout))
        frame_from_cloud = await self._transforms.lookup(frame, seen.frame_id, stamp, timeout)
        cloud_from_camera = await self._transforms.lookup(seen.frame_id, camera, stamp, timeout)
        return seen.cloud_view(frame_from_cloud, cloud_from_camera[:3, 3])

    async def workspace(self, query: Query, seen: Seen) -> graspd.Workspace:
        """The workspace in the frame of the grasps. Without a frame and a pose of its own, graspd finds the table."""
        frame = query.frame_id or seen.frame_id
        fields = {name: value for name, value in query.workspace.items() if name not in PLACE}
        if not query.workspace.keys() & PLACE:
            return graspd.Workspace(find_table=True, frame_id=frame, **fields)
        own_frame, timeout = query.workspace.get("frame_id", frame), query.values["transform_timeout"]
        pose = query.workspace.get("pose", graspd.Pose())
        corner = await self._transforms.lookup(frame, own_frame, seen.stamp, timeout) @ pose.matrix()
        fields.pop("gravity", None)  # used only to find the table
        return graspd.Workspace(corner, frame_id=frame, **fields)

    async def answer(self, call: Any) -> Any:
        """The result of a call; its errors as a `Refusal`."""
        try:
            return await call
        except graspd.Unavailable as error:
            text = f"graspd at {self._address} (parameter address) is not available: {error.message}"
            raise Refusal(error.code.name, text) from None
        except graspd.Error as error:
            raise Refusal(error.code.name, error.message) from None
        except (TypeError, ValueError) as error:
            raise Refusal("INVALID_ARGUMENT", str(error)) from None


def message(query: Query, seen: Seen, found: graspd.Detection) -> Detection:
    header = Header(stamp=seen.message.header.stamp, frame_id=query.frame_id or seen.frame_id)
    return messages.detection_message(header, found)
