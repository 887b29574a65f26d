"""Planners. Each proposes grasps for depth images, best first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from camera import Array, is_within_reach, points
from graspd import Client, DepthView, Options, Pose, Workspace
from hand import MAX_OPENING

FINGER_DEPTH = 0.05
"""Distance from the finger base to the fingertips, metres."""


@dataclass(frozen=True)
class Grasp:
    """A proposed grasp."""

    pose: Pose
    width: float
    quality: float


@dataclass(frozen=True)
class Plan:
    """The result of a planner."""

    grasps: list[Grasp]
    """Best first."""
    fusion: float = 0.0
    """Duration of the fusion of the images, seconds; 0 if the planner does not report it."""


class Planner(Protocol):
    """Proposes grasps in the task frame."""

    def plan(self, views: Sequence[DepthView]) -> Plan:
        """Proposes grasps for the depth images."""


class Served:
    """A running graspd. It gets the depth images."""

    def __init__(self, address: str, options: Options | None = None, workspace: Workspace = Workspace()) -> None:
        self.options = options
        self.workspace = workspace
        # GPD takes seconds on a busy machine.
        self.client = Client(address, timeout=60.0)

    def plan(self, views: Sequence[DepthView]) -> Plan:
        """Requests grasps. Raises `graspd.Error` if the server refuses or cannot be reached."""
        found = self.client.detect_from_depth(views, self.workspace, self.options)
        grasps = [Grasp(grasp.pose, grasp.width, grasp.quality) for grasp in found.grasps]
        return Plan(grasps, found.latency.fusion)


class Random:
    """Random grasps: at a random point of the observed surface, against its normal, with a random depth and yaw."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def plan(self, views: Sequence[DepthView]) -> Plan:
        """One grasp; none if no point of an object was observed."""
        positions, normals = graspable(views)
        if not len(positions):
            return Plan([])
        index = self.rng.integers(len(positions))
        z = -normals[index]
        depth = self.rng.uniform(-0.1, 1.1) * FINGER_DEPTH
        yaw = self.rng.uniform(0.0, math.pi)
        # The task frame's x axis, projected onto the plane normal to the approach and rotated about it by the yaw.
        x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9999 else np.array([0.0, 1.0, 0.0])
        y = np.cross(z, x) / np.linalg.norm(np.cross(z, x))
        x = np.cross(y, z)
        turned = math.cos(yaw) * x + math.sin(yaw) * y
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([turned, np.cross(z, turned), z])
        matrix[:3, 3] = positions[index] - depth * z
        return Plan([Grasp(Pose.from_matrix(matrix), MAX_OPENING, 0.5)])


def graspable(views: Sequence[DepthView]) -> tuple[Array, Array]:
    """Observed points of objects whose surface does not face down, and their normals.

    At most one point per voxel of 2.5 mm, as in the fine volume of VGN's code."""
    clouds = [surface(view) for view in views]
    positions = np.concatenate([cloud[0] for cloud in clouds])
    normals = np.concatenate([cloud[1] for cloud in clouds])
    keep = is_within_reach(positions) & (normals[:, 2] > -0.1)
    positions, normals = positions[keep], normals[keep]
    _, first = np.unique(np.floor(positions / 0.0025).astype(int), axis=0, return_index=True)
    return positions[first], normals[first]


def surface(view: DepthView) -> tuple[Array, Array]:
    """The point and the normal of every pixel whose neighbours at a distance of two pixels are on the same surface."""
    seen = points(view)
    across, down = seen[2:-2, 4:] - seen[2:-2, :-4], seen[4:, 2:-2] - seen[:-4, 2:-2]
    # At a larger distance there is an edge between the neighbours.
    smooth = (np.linalg.norm(across, axis=-1) < 0.02) & (np.linalg.norm(down, axis=-1) < 0.02)
    # Rows increase downwards and columns to the right, so the cross product points towards the camera.
    normals = np.cross(down, across)[smooth]
    return seen[2:-2, 2:-2][smooth], normals / np.linalg.norm(normals, axis=-1, keepdims=True)
