"""Results of requests."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from graspd.geometry import Pose, PoseLike
from graspd.picture import Picture, draw
from graspd.seen import DepthView


@dataclass(frozen=True)
class Grasp:
    """A grasp with its pre-grasp and retreat poses.

    In the grasp frame, z is the approach direction, the fingers close along ±y and the origin is at the finger base,
    unless the request's `Convention` selects another frame. A grasp rotated by 180° about z is the same grasp.
    """

    pose: Pose
    """``T_frame_grasp``, in the detection's `frame_id`."""
    width: float
    """Opening between the fingers, metres."""
    quality: float
    """Predicted probability of success, in [0, 1]."""
    pregrasp: Pose
    """Pre-grasp pose: the open hand approaches from here along its z axis."""
    retreat: Pose
    """Pose to which the hand moves after it has closed."""
    collides: bool | None
    """Whether the open hand would collide; None without ``CollisionCheck("flag")``."""
    object: int | None = None
    """Label of the object between the fingers, for views with `labels`; None: no object."""
    open_width: float | None = None
    """Largest opening with which the hand is free of collisions on its way to the grasp, metres: open it this far. None
    without a collision check, or if there is none."""


@dataclass(frozen=True)
class Score:
    """The score of a grasp of the caller."""

    quality: float
    """Predicted probability of success, in [0, 1]; 0 outside the volume. A model with an evaluator predicts it for the
    pose, a network alone for the best rotation at the position."""
    violations: tuple[str, ...]
    """Why it would not be among the detected grasps: QUALITY, WIDTH, REGION, APPROACH, HEIGHT, OBJECT, COLLISION; the
    number of a reason that only a newer server knows."""
    object: int | None
    """Label of the object between the fingers, for views with `labels`; None: no object."""
    open_width: float | None
    """As `Grasp.open_width`."""


@dataclass(frozen=True)
class Latency:
    """Duration of each stage in the server, seconds."""

    queue: float
    """Wait for conversion and fusion, and in the queue of the model."""
    preprocessing: float
    """Validation and conversion of the input."""
    fusion: float
    """Fusion of depth images or points into a volume."""
    inference: float
    """The network; for a planner without a network, the whole planner."""
    evaluation: float
    """The evaluator of the model: qualities of grasps, and search for better poses; 0 for models without one."""
    postprocessing: float
    """Decoding of the network's output to grasps, and the checks of each grasp."""
    total: float
    """From the decoded request to the reply."""


@dataclass(frozen=True)
class Dropped:
    """Number of voxels without a grasp, each counted under the first reason that applies. Planners without a network
    count grasp candidates instead of voxels."""

    below_threshold: int
    """Quality below the threshold."""
    mask: int
    """Inside an object, or too far from any observed surface."""
    width: int
    """Width outside the range of the gripper."""
    region: int
    """Outside the workspace or the region."""
    approach: int
    """Approach direction outside the cone."""
    height: int
    """A corner of the open hand below `min_height`."""
    object: int
    """Not on one of `Options.objects`."""
    collision: int
    """The open hand would collide; counted with ``CollisionCheck("filter")``."""
    suppressed: int
    """A neighbouring grasp has a higher quality."""
    over_limit: int
    """A grasp beyond `max_grasps` or `max_grasps_per_object`."""


@dataclass(frozen=True)
class GeometryWarning:
    """A sign that the geometry of a request is wrong, or that the network was not trained for it. The grasps are
    detected all the same."""

    code: str
    """One of NO_TABLE, TABLE_TILTED, TABLE_HEIGHT, MOSTLY_UNSEEN, VIEWS_DISAGREE, CAMERA_DISTANCE, CAMERA_ANGLE, DEPTH_SCALE,
    OBJECTS_LEFT_OUT and DEPTHS_CORRECTED; the number of a code that only a newer server knows."""
    message: str
    """What was found, and what to check."""
    figures: Mapping[str, float]
    """The measured figures. The name of a figure ends with its unit, or with ``_share`` for a fraction."""
    view: int | None
    """Index of the view, if the warning is about one view."""


@dataclass(frozen=True)
class FoundTable:
    """A table in a depth image or a point cloud, and the workspace over what stands on it."""

    workspace: Pose
    """``T_frame_task``: pose of the workspace's corner. z is the normal of the table, x points to the right of the
    image."""
    distance: float
    """Distance of the camera from the plane of the table, metres."""
    angle: float
    """Angle between the optical axis and the normal of the table, radians: 0 if the camera looks straight down."""
    share: float
    """Share of the image on the table, weighted towards its middle."""
    deviation: float
    """Root mean square distance of these pixels from the plane, metres."""
    tilt: float | None
    """Angle between the normal of the table and the vertical, radians; None if gravity is unknown."""
    extent: tuple[float, float]
    """Lengths of the workspace along x and y, metres."""
    objects: int
    """Number of objects that stand on the table. Objects that touch each other may count as one."""


@dataclass(frozen=True, repr=False)
class Detection:
    """The result of a request: a sequence of grasps, best first, with what else is in the reply."""

    grasps: tuple[Grasp, ...]
    """Best first."""
    frame_id: str
    """Name of the frame of the grasps: that of the volume or workspace."""
    stamp: int | None
    """Time stamp of the volume or workspace, nanoseconds since 1970."""
    model: str
    """Name of the model that found the grasps."""
    version: str
    """Version of the model."""
    latency: Latency
    dropped: Dropped | None
    """Set if `Options.explain` is set or there is no grasp."""
    request_id: str
    """The request id of the caller, or the one that the server generated; it is in the server's log."""
    warnings: tuple[GeometryWarning, ...] = ()
    """Signs that the geometry of the request is wrong, or that the network was not trained for it."""
    table: FoundTable | None = None
    """The table that was found, if the workspace has `find_table`."""
    depth_factors: tuple[float, ...] = ()
    """Factors by which the depths of the views were multiplied (`Workspace.correct_depth_scale`)."""

    def __len__(self) -> int:
        return len(self.grasps)

    def __iter__(self) -> Iterator[Grasp]:
        return iter(self.grasps)

    def __getitem__(self, index: int) -> Grasp:
        return self.grasps[index]

    def __repr__(self) -> str:
        best = f", the best with a quality of {self.grasps[0].quality:.2f}" if self.grasps else ""
        warnings = "".join(f", {warning.code}" for warning in self.warnings)
        seconds = f"{1e3 * self.latency.total:.0f} ms"
        return f"<Detection of {self.model} {self.version}: {counted(len(self), 'grasp')}{best}, {seconds}{warnings}>"

    def show(
        self, view: DepthView, frame_from_task: PoseLike | None = None, *, count: int = 10, finger_depth: float = 0.05
    ) -> Picture:
        """A picture of the best `count` grasps over a depth image of the request, which notebooks show and `Picture.save`
        writes. `frame_from_task`: the workspace's `pose`, for a view with `camera_from_task`. `finger_depth`: length of the
        fingers, metres. The grasps must have the default `Convention`."""
        hands = [(grasp.pose, grasp.width, grasp.quality) for grasp in self.grasps[:count]]
        return draw(reversed(hands), view, frame_from_task, finger_depth)

    def _repr_html_(self) -> str:
        columns = ["quality", "width (mm)", "position (m)", "quaternion xyzw", "object"]
        rows = [
            [
                f"{grasp.quality:.2f}",
                f"{1e3 * grasp.width:.0f}",
                ", ".join(f"{c:.3f}" for c in grasp.pose.position),
                ", ".join(f"{c:.3f}" for c in grasp.pose.quaternion),
                "" if grasp.object is None else str(grasp.object),
            ]
            for grasp in self.grasps[:SHOWN]
        ]
        more = f"<p>… {len(self) - SHOWN} more</p>" if len(self) > SHOWN else ""
        return f"<p>{html.escape(repr(self)[1:-1])}</p>{html_table(columns, rows)}{more}"


@dataclass(frozen=True, repr=False)
class Scores:
    """The scores of the caller's grasps, in their order, with what else is in the reply."""

    scores: tuple[Score, ...]
    """One for each grasp, in their order."""
    frame_id: str
    """Name of the frame of the grasps: that of the volume or workspace."""
    stamp: int | None
    """Time stamp of the volume or workspace, nanoseconds since 1970."""
    model: str
    """Name of the model that scored them."""
    version: str
    """Version of the model."""
    latency: Latency
    request_id: str
    """The request id of the caller, or the one that the server generated."""
    warnings: tuple[GeometryWarning, ...]
    """Signs that the geometry of the request is wrong."""
    table: FoundTable | None
    """The table that was found, if the workspace has `find_table`."""
    depth_factors: tuple[float, ...]
    """Factors by which the depths of the views were multiplied (`Workspace.correct_depth_scale`)."""

    def __len__(self) -> int:
        return len(self.scores)

    def __iter__(self) -> Iterator[Score]:
        return iter(self.scores)

    def __getitem__(self, index: int) -> Score:
        return self.scores[index]

    def __repr__(self) -> str:
        qualities = ", ".join(f"{score.quality:.2f}" for score in self.scores[:SHOWN])
        more = f", … {len(self) - SHOWN} more" if len(self) > SHOWN else ""
        return f"<Scores of {self.model} {self.version}: {qualities}{more}>"


SHOWN = 10
"""Rows and numbers that are shown of a result."""


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def html_table(columns: list[str], rows: list[list[str]]) -> str:
    def line(cell: str, texts: list[str]) -> str:
        return f"<tr>{''.join(f'<{cell}>{html.escape(text)}</{cell}>' for text in texts)}</tr>"

    return f"<table>{line('th', columns)}{''.join(line('td', row) for row in rows)}</table>"


@dataclass(frozen=True)
class Model:
    """A model that the server serves: a network with its decoding, or a planner without a network."""

    name: str
    version: str
    resolution: int
    """Voxels along an edge of its input volumes; 0: any."""
    voxel_size: float
    """Edge of a voxel of its input volumes, metres; 0: any."""
    threshold: float
    """Default of `Options.threshold`."""
    sha256: str
    """SHA-256 of the model file, hexadecimal; empty for planners without a file."""
    provenance: Mapping[str, str]
    """Origin of the weights."""
    provider: str
    """ONNX Runtime execution provider: cpu, openvino, cuda or tensorrt."""
    precision: str
    """Number format of the inference: fp32, bf16, fp16 or int8."""
    voxel_origin: str
    """Position of a network's grasp in its voxel: ``corner``, at index · `voxel_size`, or ``center``, half a
    voxel further. Empty for planners without a network."""
    camera_azimuth: float | None
    """Azimuth of the camera in the training data, degrees about the vertical axis through the middle of the volume,
    from x towards y; None: any. For depth images and point clouds the server rotates the workspace accordingly; volumes
    must be rotated by the caller."""
