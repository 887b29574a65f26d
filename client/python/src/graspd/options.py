"""Options of requests. The names are those of `grasp.v1`, so that the `field` of an `InvalidArgument` is the path of an
attribute. Values of a wrong type and unknown names raise `TypeError` and `ValueError`; the server validates the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np

from graspd.geometry import PoseLike, Vector


def check_choice(name: str, value: Any, *choices: str) -> None:
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, must be one of {', '.join(map(repr, choices))}")


def check_type(name: str, value: Any, kind: type, example: str) -> None:
    """Accepts None."""
    if not (value is None or isinstance(value, kind)):
        raise TypeError(f"{name} is {value!r}, must be a graspd.{kind.__name__}, such as {example}")


def check_count(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} is {value!r}, must be an integer")
    if not 0 <= int(value) < 2**32:
        raise ValueError(f"{name} is {value!r}, must be from 0 to {2**32 - 1}")


def check_text(name: str, value: Any) -> None:
    if not isinstance(value, str):
        raise TypeError(f"{name} is {value!r}, must be a text")


def check_truth(name: str, value: Any) -> None:
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} is {value!r}, must be True or False")


def check_not_negative(name: str, values: dict[str, Any]) -> None:
    """Accepts None among them."""
    check_numbers(name, values)
    for field, value in values.items():
        if value is not None and value < 0:
            raise ValueError(f"{name}.{field} is {value!r}, must not be negative")


def check_numbers(name: str, values: dict[str, Any]) -> None:
    """Accepts None among them."""
    for field, value in values.items():
        if value is not None and (isinstance(value, (bool, str)) or not isinstance(value, Real)):
            raise TypeError(f"{name}.{field} is {value!r}, must be a number")


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, metres."""

    min: Vector
    """Corner with the smallest coordinates."""
    max: Vector
    """Corner with the largest coordinates."""


@dataclass(frozen=True)
class Cone:
    """A cone of directions in the frame of the grasps."""

    axis: Vector
    """Axis of the cone, of any length. (0, 0, -1) is straight down if z points up."""
    angle: float
    """Half the opening angle, radians, greater than 0 and at most π."""


@dataclass(frozen=True)
class Gripper:
    """The shape of an open parallel-jaw hand. All lengths in metres, greater than 0 and at most 0.5."""

    max_opening: float
    """Largest distance between the fingers."""
    finger_depth: float
    """From the finger base to the fingertips. Panda: 0.05."""
    finger_width: float
    """Thickness of a finger along the closing axis. Panda: 0.0264."""
    finger_breadth: float
    """Breadth of a finger across the closing axis. Panda: 0.021."""
    palm: Box | None = None
    """Bounding box of the palm in the grasp frame (z along the approach, ±y along the closing axis)."""


@dataclass(frozen=True)
class CollisionCheck:
    """Checks whether the open hand would collide with the observed surface or the table, at the grasp or between
    pre-grasp and grasp."""

    mode: Literal["off", "flag", "filter"] | None = None
    """``off``: no check; ``flag``: set `Grasp.collides`; ``filter``: drop grasps that collide. None: ``filter`` for depth images
    and point clouds, ``off`` for a volume."""
    table_height: float | None = None
    """Height of the table above the bottom of the volume, metres; None: 0.05; negative: no table."""
    clearance: float | None = None
    """Smallest distance between the hand and the obstacles, metres; None: 0."""
    hidden: bool = False
    """Also treat as an obstacle what lies behind a surface in a view and was not measured by any view. Other unobserved
    space counts as free. Needs depth images or point clouds."""

    def __post_init__(self) -> None:
        check_numbers("CollisionCheck", {"table_height": self.table_height})
        check_not_negative("CollisionCheck", {"clearance": self.clearance})
        check_truth("CollisionCheck.hidden", self.hidden)
        if self.mode is not None:
            check_choice("CollisionCheck.mode", self.mode, "off", "flag", "filter")


@dataclass(frozen=True)
class Convention:
    """The frame of the hand that grasp poses refer to."""

    origin: Literal["finger_base", "tcp", "parent"] = "finger_base"
    """``finger_base``: midpoint between the finger bases; ``tcp``: midpoint between the fingertips; ``parent``: the
    link that carries the hand."""
    closing_axis: Literal["y", "x"] = "y"
    """Axis of the grasp frame along which the fingers close."""
    parent_from_grasp: PoseLike | None = None
    """``T_parent_grasp``, for ``"parent"``: pose of the finger base, closing along `closing_axis`, in the link."""

    def __post_init__(self) -> None:
        check_choice("Convention.origin", self.origin, "finger_base", "tcp", "parent")
        check_choice("Convention.closing_axis", self.closing_axis, "y", "x")


@dataclass(frozen=True)
class Retreat:
    """The motion of the hand after it has closed."""

    distance: float = 0.1
    """Metres."""
    direction: Vector | None = None
    """Direction in the frame of the grasps, of any length; None: back along the approach."""


@dataclass(frozen=True)
class Candidate:
    """A grasp of the caller, to be scored."""

    pose: PoseLike
    """``T_frame_grasp``, in the convention of the options."""
    width: float | None = None
    """Opening between the fingers when the object is held, metres; None: unknown."""


@dataclass(frozen=True)
class Options:
    """Options of a detection. The default uses the server's defaults."""

    model: str = ""
    """Name of a network, ``"gpd"`` or ``"shaf"``; empty: the server's default model."""
    version: str = ""
    """Version of the model; empty: the newest."""
    threshold: float | None = None
    """Smallest quality of a grasp, greater than 0 and at most 1; None: the model's threshold."""
    force: float | None = None
    """If no grasp reaches `threshold`, return the best grasp if its quality is at least this."""
    max_grasps: int = 0
    """Return at most this many grasps, best first. 0: no limit."""
    explain: bool = False
    """Also report dropped voxels by reason (`Detection.dropped`). Results without grasps always report them."""
    region: Box | None = None
    """Only grasps whose point between the fingertips lies in this box, in the frame of the grasps."""
    approach: Cone | None = None
    """Only grasps whose approach direction lies in this cone."""
    min_height: float | None = None
    """Smallest z of any corner of the open hand at the grasp, in the frame of the grasps, metres."""
    gripper: Gripper | None = None
    """Shape of the hand; None: the Panda hand, with which the networks were trained."""
    collision: CollisionCheck | None = None
    """Collision check of the open hand; None: that of `CollisionCheck()`."""
    convention: Convention | None = None
    """Frame of the hand that the poses refer to; None: the finger base, closing along y."""
    pregrasp_distance: float | None = None
    """Distance of the pre-grasp from the grasp, back along the approach, metres; None: 0.05."""
    retreat: Retreat | None = None
    """Motion of the hand after it has closed; None: 0.1 m back along the approach."""
    region_pose: PoseLike | None = None
    """Pose of the frame of `region` in the frame of the grasps, for a box in any orientation; None: identity."""
    objects: Sequence[int] = ()
    """Only grasps on objects with these labels, for views with `labels`; the other objects remain obstacles. Empty:
    grasps on all surfaces."""
    max_grasps_per_object: int = 0
    """Return at most this many grasps on one object, for views with `labels`. 0: no limit."""
    margin: float | None = None
    """Smallest distance of the point between the fingertips from the sides of the cube, metres; None: 0."""
    priority: Literal["normal", "batch"] = "normal"
    """``batch``: for offline processing; normal requests are processed first."""

    def __post_init__(self) -> None:
        check_count("Options.max_grasps", self.max_grasps)
        check_count("Options.max_grasps_per_object", self.max_grasps_per_object)
        if isinstance(self.objects, (int, str)):
            raise TypeError(f"Options.objects is {self.objects!r}, must be a list of labels")
        for label in self.objects:
            check_count("Options.objects", label)
        check_text("Options.model", self.model)
        check_text("Options.version", self.version)
        check_truth("Options.explain", self.explain)
        check_numbers("Options", {"min_height": self.min_height})
        names = ["threshold", "force", "pregrasp_distance", "margin"]
        check_not_negative("Options", {name: getattr(self, name) for name in names})
        check_choice("Options.priority", self.priority, "normal", "batch")
        check_type("Options.collision", self.collision, CollisionCheck, 'CollisionCheck("filter")')
        check_type("Options.convention", self.convention, Convention, 'Convention("tcp")')
        check_type("Options.gripper", self.gripper, Gripper, "Gripper(0.08, 0.05, 0.0264, 0.021)")
        check_type("Options.region", self.region, Box, "Box((0, 0, 0), (0.3, 0.3, 0.3))")
        check_type("Options.approach", self.approach, Cone, "Cone((0, 0, -1), 0.8)")
        check_type("Options.retreat", self.retreat, Retreat, "Retreat(0.1)")
