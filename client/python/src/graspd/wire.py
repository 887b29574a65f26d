"""Conversion between the client's types and the messages of `grasp.v1`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeAlias, TypeVar

import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp
from grpc import StatusCode
from grpc_health.v1.health_pb2 import HealthCheckResponse
from numpy.typing import DTypeLike, NDArray

from graspd import errors
from graspd import grasp_pb2 as pb
from graspd.camera import Camera, intrinsic_matrix
from graspd.detection import Detection, Dropped, FoundTable, GeometryWarning, Grasp, Latency, Model, Score, Scores
from graspd.document import listed as shown
from graspd.document import short
from graspd.geometry import Pose, PoseLike, Vector
from graspd.options import Box, Candidate, CollisionCheck, Cone, Convention, Gripper, Options, Retreat
from graspd.png import png_file
from graspd.seen import CloudView, DepthView, Volume, Workspace, coordinates, unit_of

Observation: TypeAlias = Volume | NDArray[Any] | DepthView | CloudView | Iterable[DepthView | CloudView]
"""A volume, depth images or point clouds."""

Value = TypeVar("Value")
Message = TypeVar("Message")

WORKSPACE_SIZE = 0.3
"""Edge of the workspace of the published networks, metres."""

logger = logging.getLogger("graspd")

logged: set[str] = set()
"""Codes of the warnings that were logged."""

DTYPES = {
    np.dtype("<f4"): pb.DATA_TYPE_F32,
    np.dtype("<f2"): pb.DATA_TYPE_F16,
    np.dtype("u1"): pb.DATA_TYPE_U8,
}


def given(message: Callable[[Value], Message], value: Value | None) -> Message | None:
    """Converts an optional field."""
    return None if value is None else message(value)


def each(views: Any, kind: type[Value]) -> list[Value]:
    """The views of a request, of one kind."""
    if isinstance(views, kind):
        return [views]
    listed = list(views) if isinstance(views, Iterable) and not isinstance(views, (str, dict, np.ndarray)) else [views]
    for view in listed:
        if not isinstance(view, kind):
            raise TypeError(f"views is {short(views)}, must be a graspd.{kind.__name__} or several")
    return listed


def checked(name: str, value: Value, kind: type[Any]) -> Value:
    if not isinstance(value, kind):
        made = "a text" if kind is str else f"a graspd.{kind.__name__}"
        raise TypeError(f"{name} is {short(value)}, must be {made}")
    return value


def detect_request(volume: Volume | NDArray[Any], options: Options | None, request_id: str) -> pb.DetectGraspsRequest:
    return pb.DetectGraspsRequest(
        request_id=checked("request_id", request_id, str),
        volume=volume_message(volume),
        options=given(options_message, options),
    )


def depth_request(
    views: DepthView | Iterable[DepthView], workspace: Workspace, options: Options | None, request_id: str
) -> pb.DetectGraspsFromDepthRequest:
    listed = each(views, DepthView)
    note_absent(listed, options)
    return pb.DetectGraspsFromDepthRequest(
        request_id=checked("request_id", request_id, str),
        views=map(depth_message, listed),
        workspace=workspace_message(workspace),
        options=given(options_message, options),
    )


def cloud_request(
    views: CloudView | Iterable[CloudView], workspace: Workspace, options: Options | None, request_id: str
) -> pb.DetectGraspsFromCloudRequest:
    listed = each(views, CloudView)
    note_absent(listed, options)
    return pb.DetectGraspsFromCloudRequest(
        request_id=checked("request_id", request_id, str),
        views=map(cloud_message, listed),
        workspace=workspace_message(workspace),
        options=given(options_message, options),
    )


def score_request(
    observation: Observation,
    grasps: Iterable[PoseLike | Candidate | Grasp],
    workspace: Workspace,
    options: Options | None,
    request_id: str,
) -> pb.ScoreGraspsRequest:
    request = pb.ScoreGraspsRequest(
        request_id=checked("request_id", request_id, str),
        candidates=map(candidate_message, grasps),
        options=given(options_message, options),
    )
    if isinstance(observation, (Volume, np.ndarray)):
        request.volume.CopyFrom(volume_message(observation))
        return request
    views = [observation] if isinstance(observation, (DepthView, CloudView)) else list(observation)
    clouds = [view for view in views if isinstance(view, CloudView)]
    images = [view for view in views if isinstance(view, DepthView)]
    if clouds and images:
        raise ValueError("an observation is either depth images or point clouds, got both")
    if clouds:
        of_clouds = pb.CloudViews(views=map(cloud_message, clouds), workspace=workspace_message(workspace))
        request.clouds.CopyFrom(of_clouds)
    else:
        of_images = pb.DepthViews(views=map(depth_message, images), workspace=workspace_message(workspace))
        request.depth.CopyFrom(of_images)
    return request


def candidate_message(candidate: PoseLike | Candidate | Grasp) -> pb.Candidate:
    if isinstance(candidate, Grasp):
        candidate = Candidate(candidate.pose, candidate.width)
    elif not isinstance(candidate, Candidate):
        candidate = Candidate(candidate)
    return pb.Candidate(pose=pose_message(candidate.pose, "Candidate.pose"), width=candidate.width)


def track_request(
    views: DepthView | Iterable[DepthView],
    workspace: Workspace | None,
    half_life: float | None,
    options: Options | None,
    request_id: str,
    stamp: int | None,
) -> pb.TrackGraspsRequest:
    return pb.TrackGraspsRequest(
        half_life=half_life,
        request_id=checked("request_id", request_id, str),
        stamp=given(stamp_message, stamp),
        views=map(depth_message, each(views, DepthView)),
        workspace=given(workspace_message, workspace),
        options=given(options_message, options),
    )


def table_request(
    view: DepthView | CloudView, workspace: Workspace, table_height: float | None, request_id: str
) -> pb.FindTableRequest:
    checked("workspace", workspace, Workspace)
    return pb.FindTableRequest(
        request_id=checked("request_id", request_id, str),
        view=None if isinstance(view, CloudView) else depth_message(view),
        cloud=cloud_message(view) if isinstance(view, CloudView) else None,
        # The server refuses both with a search.
        workspace=workspace_message(replace(workspace, pose=None, correct_depth_scale=None)),
        table_height=table_height,
    )


def volume_message(volume: Volume | NDArray[Any]) -> pb.Volume:
    if not isinstance(volume, Volume):
        volume = Volume(volume)
    resolution = volume.values.shape[-1]
    values = encoded(volume.values, volume.dtype)
    return pb.Volume(
        data=values.tobytes(),
        dtype=DTYPES[values.dtype],
        resolution=resolution,
        voxel_size=WORKSPACE_SIZE / resolution if volume.voxel_size is None else volume.voxel_size,
        pose=pose_message(volume.pose, "Volume.pose"),
        frame_id=volume.frame_id,
        stamp=given(stamp_message, volume.stamp),
    )


def encoded(values: NDArray[Any], dtype: DTypeLike | None) -> NDArray[Any]:
    """The values as one of `DTYPES`."""
    own = values.dtype if values.dtype in DTYPES else np.dtype("<f4")
    target = own if dtype is None else np.dtype(dtype)
    if target not in DTYPES:
        raise ValueError(f"Volume.dtype is {target}, must be float32, float16 or uint8")
    if values.dtype == target:
        return values
    if values.dtype == np.uint8:
        return (values / 255).astype(target)
    if target != np.uint8:
        return values.astype(target)
    # Checked here: after rounding the server could not detect invalid values.
    if not (values.min() >= 0 and values.max() <= 1):
        raise ValueError(
            f"values of a volume with dtype uint8 must lie in [0, 1], got {values.min()} to {values.max()}"
        )
    # Values greater than 0 stay greater than 0, because 0 means unobserved.
    steps: NDArray[Any] = np.maximum(np.rint(values * 255), values > 0).astype(np.uint8)
    return steps


def note_absent(views: Sequence[DepthView | CloudView], options: Options | None) -> None:
    """Logs once that no label of the views is one of the wanted objects, as of a mask of 0 and 255."""
    labels = [np.asarray(view.labels) for view in views if view.labels is not None]
    wanted = [] if not isinstance(options, Options) else list(options.objects)
    if not (labels and wanted) or any(np.isin(one, wanted).any() for one in labels):
        return
    there = sorted({label.item() for one in labels for label in np.unique(one)} - {0})
    text = f"Options.objects is {wanted}, not in the labels of the views; labels there: {shown(there) or 'none but 0'}"
    if text not in logged:
        logged.add(text)
        logger.warning("%s", text)


def depth_message(view: DepthView) -> pb.DepthView:
    # A masked pixel has no reading.
    image = np.ma.filled(view.depth, 0) if np.ma.isMA(view.depth) else np.asarray(view.depth)
    height, width = image.shape[:2]
    image = image.reshape(height, width)
    labels = view.labels
    if isinstance(view.k, Camera):
        image = view.k.rectified(image)
        if labels is not None:
            labels = view.k.rectified(np.reshape(np.ma.filled(labels, 0), (height, width)))
    scale = view.k.depth_scale if isinstance(view.k, Camera) else None
    if scale is not None and scale != 1e-3 and np.issubdtype(image.dtype, np.integer):
        image = image * scale
    if np.issubdtype(image.dtype, np.integer):
        if image.size and not (0 <= image.min() and image.max() <= 65535):
            raise ValueError(
                f"integer depths are millimetres from 0 to 65535, got {image.min()} to {image.max()}; send other units "
                "as floats in metres"
            )
        unit, depth = pb.DEPTH_UNIT_U16_MILLIMETRES, image.astype("<u2", copy=False)
    elif np.issubdtype(image.dtype, np.floating):
        unit, depth = pb.DEPTH_UNIT_F32_METRES, image.astype("<f4", copy=False)
    else:
        raise ValueError(f"a depth image must be floats (metres) or integers (millimetres), got {image.dtype}")
    data = depth.tobytes()
    if view.png:
        if unit != pb.DEPTH_UNIT_U16_MILLIMETRES:
            raise ValueError(f"DepthView.png needs integer depths (millimetres), got {image.dtype}")
        unit, data = pb.DEPTH_UNIT_PNG_MILLIMETRES, png_file(depth)
    return pb.DepthView(
        data=data,
        unit=unit,
        labels=given(labels_message, labels),
        camera=pb.Camera(width=width, height=height, k=intrinsic_matrix(view.k).ravel().tolist()),
        camera_from_task=pose_message(view.camera_from_task, "camera_from_task"),
        frame_from_camera=pose_message(view.frame_from_camera, "frame_from_camera"),
    )


def labels_message(labels: Any) -> pb.Labels:
    labels = np.ma.filled(labels, 0) if np.ma.isMA(labels) else np.asarray(labels)
    if not (np.issubdtype(labels.dtype, np.number) or labels.dtype == bool):
        raise ValueError(f"labels must be whole numbers or truth values, got {labels.dtype}")
    if labels.dtype == np.float16:
        # 65535 is beyond its range.
        labels = labels.astype(np.float32)
    if np.issubdtype(labels.dtype, np.inexact) and not (labels == np.rint(labels)).all():
        raise ValueError(f"labels must be whole numbers or truth values, got {labels[labels != np.rint(labels)][0]}")
    if labels.size and not (0 <= labels.min() and labels.max() <= 65535):
        raise ValueError(f"labels must be from 0 to 65535, got {labels.min()} to {labels.max()}")
    if labels.size and labels.max() > 255:
        return pb.Labels(data=labels.astype("<u2").tobytes(), type=pb.LABEL_TYPE_U16)
    return pb.Labels(data=labels.astype("u1").tobytes(), type=pb.LABEL_TYPE_U8)


def cloud_message(view: CloudView) -> pb.CloudView:
    points = coordinates(view.points)
    scale = unit_of(view)
    if scale != 1:
        points = points * scale
    return pb.CloudView(
        labels=given(labels_message, view.labels),
        points=points.astype("<f4", copy=False).tobytes(),
        camera_position=vector_message(view.camera_position),
        frame_from_cloud=pose_message(view.frame_from_cloud, "frame_from_cloud"),
    )


def workspace_message(workspace: Workspace) -> pb.Workspace:
    checked("workspace", workspace, Workspace)
    return pb.Workspace(
        pose=pose_message(workspace.pose, "Workspace.pose"),
        size=workspace.size,
        frame_id=workspace.frame_id,
        stamp=given(stamp_message, workspace.stamp),
        find_table=workspace.find_table,
        gravity=None if workspace.gravity is None else vector_message(workspace.gravity),
        extent=given(extent_message, workspace.extent),
        correct_depth_scale=workspace.correct_depth_scale,
    )


def extent_message(extent: tuple[float, float]) -> pb.Extent:
    x, y = extent
    return pb.Extent(x=x, y=y)


def options_message(options: Options) -> pb.Options:
    checked("options", options, Options)
    return pb.Options(
        model=options.model,
        version=options.version,
        threshold=options.threshold,
        force=options.force,
        max_grasps=options.max_grasps,
        explain=options.explain,
        region=given(box_message, options.region),
        approach=given(cone_message, options.approach),
        min_height=options.min_height,
        gripper=given(gripper_message, options.gripper),
        collision=given(collision_message, options.collision),
        convention=given(convention_message, options.convention),
        pregrasp_distance=options.pregrasp_distance,
        retreat=given(retreat_message, options.retreat),
        region_pose=pose_message(options.region_pose, "Options.region_pose"),
        objects=options.objects,
        max_grasps_per_object=options.max_grasps_per_object,
        margin=options.margin,
        priority=f"PRIORITY_{options.priority.upper()}",
    )


def box_message(box: Box) -> pb.Box:
    return pb.Box(min=vector_message(box.min), max=vector_message(box.max))


def cone_message(cone: Cone) -> pb.Cone:
    return pb.Cone(axis=vector_message(cone.axis), angle=cone.angle)


def gripper_message(gripper: Gripper) -> pb.Gripper:
    return pb.Gripper(
        max_opening=gripper.max_opening,
        finger_depth=gripper.finger_depth,
        finger_width=gripper.finger_width,
        finger_breadth=gripper.finger_breadth,
        palm=given(box_message, gripper.palm),
    )


def collision_message(check: CollisionCheck) -> pb.CollisionCheck:
    return pb.CollisionCheck(
        mode=None if check.mode is None else f"MODE_{check.mode.upper()}",
        table_height=check.table_height,
        clearance=check.clearance,
        hidden=check.hidden,
    )


def convention_message(convention: Convention) -> pb.Convention:
    return pb.Convention(
        origin=f"ORIGIN_{convention.origin.upper()}",
        closing_axis=f"CLOSING_AXIS_{convention.closing_axis.upper()}",
        parent_from_grasp=pose_message(convention.parent_from_grasp, "Convention.parent_from_grasp"),
    )


def retreat_message(retreat: Retreat) -> pb.Retreat:
    direction = None if retreat.direction is None else vector_message(retreat.direction)
    return pb.Retreat(distance=retreat.distance, direction=direction)


def pose_message(pose: PoseLike | None, name: str = "pose") -> pb.Pose | None:
    if pose is None:
        return None
    try:
        pose = pose.normalised() if isinstance(pose, Pose) else Pose.from_matrix(pose)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: {error}") from None
    x, y, z, w = pose.quaternion
    return pb.Pose(position=vector_message(pose.position), orientation=pb.Quaternion(x=x, y=y, z=z, w=w))


def vector_message(vector: Vector) -> pb.Vector3:
    x, y, z = vector
    return pb.Vector3(x=x, y=y, z=z)


def stamp_message(nanoseconds: int) -> Timestamp:
    stamp = Timestamp()
    stamp.FromNanoseconds(nanoseconds)
    return stamp


def outcome(message: pb.DetectGraspsStreamResponse) -> Detection | errors.Error:
    return errors.from_reply(message) if message.HasField("error") else detection(message.response)


def detection(message: pb.DetectGraspsResponse) -> Detection:
    return Detection(
        grasps=tuple(map(grasp, message.grasps)),
        frame_id=message.frame_id,
        stamp=message.stamp.ToNanoseconds() if message.HasField("stamp") else None,
        model=message.model,
        version=message.version,
        latency=latency(message.latency),
        dropped=dropped(message.dropped) if message.HasField("dropped") else None,
        request_id=message.request_id,
        warnings=tuple(map(warning, message.warnings)),
        table=table(message.table) if message.HasField("table") else None,
        depth_factors=tuple(message.depth_factors),
    )


def scores(message: pb.ScoreGraspsResponse) -> Scores:
    return Scores(
        scores=tuple(map(score, message.scores)),
        frame_id=message.frame_id,
        stamp=message.stamp.ToNanoseconds() if message.HasField("stamp") else None,
        model=message.model,
        version=message.version,
        latency=latency(message.latency),
        request_id=message.request_id,
        warnings=tuple(map(warning, message.warnings)),
        table=table(message.table) if message.HasField("table") else None,
        depth_factors=tuple(message.depth_factors),
    )


def short_float(value: float) -> float:
    """A number without the digits that are noise of 32-bit floats."""
    return float(str(np.float32(value)))


def score(message: pb.Score) -> Score:
    names = (enum_name(pb.Score.Violation.Name, violation) for violation in message.violations)
    return Score(
        quality=short_float(message.quality),
        violations=tuple(name.removeprefix("VIOLATION_") for name in names),
        object=message.object if message.HasField("object") else None,
        open_width=message.open_width if message.HasField("open_width") else None,
    )


def enum_name(name: Callable[[Any], str], number: int) -> str:
    """The name of an enum's value; the number if a newer server has sent a value that this client does not know."""
    try:
        return name(number)
    except ValueError:
        return str(number)


def found_table(message: pb.FindTableResponse) -> FoundTable:
    return table(message.table)


def table(message: pb.FoundTable) -> FoundTable:
    return FoundTable(
        workspace=pose(message, "workspace"),
        distance=message.distance,
        angle=message.angle,
        share=message.share,
        deviation=message.deviation,
        tilt=message.tilt if message.HasField("tilt") else None,
        extent=(message.extent.x, message.extent.y),
        objects=message.objects,
    )


def warning(message: pb.GeometryWarning) -> GeometryWarning:
    code = enum_name(pb.GeometryWarning.Code.Name, message.code).removeprefix("CODE_")
    if code not in logged:
        logged.add(code)
        logger.warning("%s (logged once; see Detection.warnings)", message.message)
    return GeometryWarning(
        code=code,
        message=message.message,
        figures=dict(message.figures),
        view=message.view if message.HasField("view") else None,
    )


def grasp(message: pb.Grasp) -> Grasp:
    return Grasp(
        pose=pose(message, "pose"),
        width=short_float(message.width),
        quality=short_float(message.quality),
        pregrasp=pose(message, "pregrasp"),
        retreat=pose(message, "retreat"),
        collides=message.collides if message.HasField("collides") else None,
        object=message.object if message.HasField("object") else None,
        open_width=message.open_width if message.HasField("open_width") else None,
    )


def pose(message: Any, field: str) -> Pose:
    # Not the identity: a robot would move there.
    if not message.HasField(field):
        name = message.DESCRIPTOR.name
        raise errors.make(
            StatusCode.INTERNAL,
            f"invalid reply: {name}.{field} is absent; check that client and server have the same version",
        )
    found: pb.Pose = getattr(message, field)
    p, q = found.position, found.orientation
    return Pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def latency(message: pb.Latency) -> Latency:
    return Latency(
        queue=message.queue,
        preprocessing=message.preprocessing,
        fusion=message.fusion,
        inference=message.inference,
        evaluation=message.evaluation,
        postprocessing=message.postprocessing,
        total=message.total,
    )


def dropped(message: pb.Dropped) -> Dropped:
    return Dropped(
        below_threshold=message.below_threshold,
        mask=message.mask,
        width=message.width,
        region=message.region,
        approach=message.approach,
        height=message.height,
        object=message.object,
        suppressed=message.suppressed,
        collision=message.collision,
        over_limit=message.over_limit,
    )


def models(message: pb.ListModelsResponse) -> tuple[Model, ...]:
    return tuple(map(model, message.models))


def model(message: pb.Model) -> Model:
    return Model(
        name=message.name,
        version=message.version,
        resolution=message.resolution,
        voxel_size=message.voxel_size,
        threshold=message.threshold,
        sha256=message.sha256,
        provenance=dict(message.provenance),
        provider=message.provider,
        precision=message.precision,
        voxel_origin=message.voxel_origin,
        camera_azimuth=message.camera_azimuth if message.HasField("camera_azimuth") else None,
    )


def is_serving(message: HealthCheckResponse) -> bool:
    return bool(message.status == HealthCheckResponse.SERVING)
