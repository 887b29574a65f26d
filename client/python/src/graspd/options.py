"""What is asked of the grasps. Names are those of `grasp.v1`, so that the field that an `InvalidArgument` names is the
attribute to look at; what is in them is checked by the server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graspd.geometry import PoseLike, Vector


@dataclass(frozen=True)
class Box:
    """Along the axes of its frame, metres."""

    min: Vector
    max: Vector


@dataclass(frozen=True)
class Cone:
    """Directions of the grasps' frame."""

    axis: Vector
    """The direction in its middle, of any length: (0, 0, -1) is straight down where z points up."""
    angle: float
    """The largest angle to it, radians, above 0 and at most π."""


@dataclass(frozen=True)
class Gripper:
    """An open parallel-jaw hand. Metres, above 0 and at most 0.5."""

    max_opening: float
    """Between the fingers."""
    finger_depth: float
    """From the finger base to the fingertips. Panda: 0.05."""
    finger_width: float
    """Thickness of a finger along the closing axis. Panda: 0.0264."""
    finger_breadth: float
    """Breadth of the fingers across it. Panda: 0.021."""
    palm: Box | None = None
    """What lies behind the fingers, in the grasp frame (z along the approach, ±y the closing axis)."""


@dataclass(frozen=True)
class CollisionCheck:
    """Whether the open hand would meet what was observed, or the table, at the grasp or on its way there from the
    pre-grasp. Space that nothing observed is taken to be free."""

    mode: Literal["off", "flag", "filter"]
    """Nobody looks; each grasp says whether (`Grasp.collides`); those that would are dropped."""
    table_height: float | None = None
    """Of the table above the volume's bottom, metres; 0.05 where it is None. A negative one is no table."""


@dataclass(frozen=True)
class Convention:
    """Which frame of the hand the poses are of."""

    origin: Literal["finger_base", "tcp", "parent"] = "finger_base"
    """Between the fingers, where they begin; between the fingertips; the link that carries the hand."""
    closing_axis: Literal["y", "x"] = "y"
    parent_from_grasp: PoseLike | None = None
    """``T_parent_grasp``, for ``"parent"``: the finger base, closing along `closing_axis`, in the link."""


@dataclass(frozen=True)
class Retreat:
    """Where the hand goes with what it holds."""

    distance: float = 0.1
    """Metres."""
    direction: Vector | None = None
    """In the grasps' frame, of any length; back along the approach where it is None."""


@dataclass(frozen=True)
class Options:
    """What is asked of the grasps. The default leaves everything to the server."""

    model: str = ""
    """The planner: a network by its name, ``"gpd"`` or ``"shaf"``; the server's default where it is empty."""
    version: str = ""
    """Of the model; the newest where it is empty."""
    threshold: float | None = None
    """Smallest quality of a grasp, above 0 and at most 1; the model's own where it is None."""
    force: float | None = None
    """When nothing reaches `threshold`: return the best grasp alone, if its quality reaches this."""
    max_grasps: int = 0
    """At most this many, the best. 0: all."""
    explain: bool = False
    """Also say why the other voxels hold no grasp (`Detection.dropped`). An empty answer always does."""
    region: Box | None = None
    """Only grasps whose point between the fingertips lies here, in the grasps' frame."""
    approach: Cone | None = None
    """Only grasps that approach within this."""
    min_height: float | None = None
    """No corner of the open hand may be lower than this at the grasp, metres along z of the grasps' frame."""
    gripper: Gripper | None = None
    """The hand; the Panda's, with which the networks were trained, where it is None."""
    collision: CollisionCheck | None = None
    convention: Convention | None = None
    pregrasp_distance: float | None = None
    """How far before the grasp the pre-grasp is, metres back along the approach; 0.05 where it is None."""
    retreat: Retreat | None = None
