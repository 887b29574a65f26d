"""What comes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from graspd.geometry import Pose


@dataclass(frozen=True)
class Grasp:
    """A grasp, and the way there and away.

    z runs along the approach, the fingers close along ±y, the origin is at the finger base, unless `Convention` asked
    for another frame of the hand. Turned by 180° about z it is the same grasp.
    """

    pose: Pose
    """``T_frame_grasp``, in the detection's `frame_id`."""
    width: float
    """Opening between the fingers, metres."""
    quality: float
    """Predicted probability of success, [0, 1]."""
    pregrasp: Pose
    """Where the hand waits, open, before it approaches."""
    retreat: Pose
    """Where the hand goes with what it holds."""
    collides: bool | None
    """Whether the open hand would meet something, where ``CollisionCheck("flag")`` asked for that."""


@dataclass(frozen=True)
class Latency:
    """Where the time went in the server, seconds."""

    queue: float
    """Waiting for a session."""
    preprocessing: float
    """Checking and widening what was sent."""
    fusion: float
    """From depth images or points to a volume."""
    inference: float
    """The network; of a planner without one, all of its work."""
    postprocessing: float
    """From the network's output to the grasps."""
    total: float
    """From the decoded request to the reply."""


@dataclass(frozen=True)
class Dropped:
    """How many voxels hold no grasp, each counted once under the first reason that applied. Planners without a network
    count the places where the hand fits."""

    below_threshold: int
    """Of too little quality."""
    mask: int
    """Inside an object, or too far from any observed surface."""
    width: int
    """Of a width that the gripper cannot open to."""
    border: int
    """At the border of the cube."""
    region: int
    """Outside of the workspace or the region."""
    approach: int
    """From outside of the approach cone."""
    height: int
    """The hand would be lower than `min_height`."""
    collision: int
    """The open hand would meet what was observed, where ``CollisionCheck("filter")`` asked for that."""
    suppressed: int
    """Next to a better grasp."""
    over_limit: int
    """A grasp, but past `max_grasps`."""


@dataclass(frozen=True)
class Detection:
    """The answer to what was seen."""

    grasps: tuple[Grasp, ...]
    """Best first."""
    frame_id: str
    """The frame of the grasps: the volume's or the workspace's."""
    stamp: int | None
    """The volume's or the workspace's, nanoseconds since 1970."""
    model: str
    """The planner that answered."""
    version: str
    latency: Latency
    dropped: Dropped | None
    """Where `explain` asked for it, or there is no grasp."""
    request_id: str
    """The caller's, or the one by which the server's log knows the request."""


@dataclass(frozen=True)
class Model:
    """A planner that the server has: a network, or one without."""

    name: str
    version: str
    resolution: int
    """Voxels along an edge of the volumes it takes; 0 if it takes any."""
    voxel_size: float
    """Edge of their voxels, metres; 0 if it takes any."""
    threshold: float
    """Its own smallest quality of a grasp."""
    sha256: str
    """Of its file, hexadecimal; empty if it has none."""
    provenance: Mapping[str, str]
    """Where its weights come from."""
    provider: str
    """What runs it: cpu, openvino, cuda or tensorrt."""
    precision: str
    """In which numbers: fp32, bf16, fp16 or int8."""
    voxel_origin: str
    """Where in its voxel a network's grasp stands: ``corner``, at index · `voxel_size`, or ``center``, half a voxel
    further; empty if it is none."""
    camera_azimuth: float | None
    """Where the camera always stood in training, degrees about the vertical axis through the middle of the volume, from
    x towards y; None: anywhere. Depth images and points are fused in a cube that is turned so; a volume should be."""
