"""A table with objects in PyBullet, and the execution of grasps with the benchmark's protocol.

Lengths are in metres. Poses are `graspd.Pose` in the task frame: its origin is a corner of the cube of 0.3 m, z is up,
and the table is at z = 0.05.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet  # type: ignore[import-not-found]
from graspd import Pose
from hand import MAX_OPENING, STEPS_PER_SECOND, Hand
from pybullet_utils.bullet_client import BulletClient  # type: ignore[import-untyped]

HAND = Path(__file__).resolve().parent.parent / "hand/hand.urdf"
"""URDF of the Panda hand."""

SIZE = 0.3
TABLE_HEIGHT = 0.05
TABLE_FRICTION = 0.5
SOLVER_ITERATIONS = 150

REST_SPEED = 0.01
"""Largest velocity norm of a body at rest, m/s and rad/s together."""
REST_CHUNK = 60
"""Steps between two checks for rest."""

PREGRASP_DISTANCE = 0.05
LIFT = 0.1
STEEPEST_LIFT_BACK = math.pi / 3
"""Largest angle between an approach and straight down for a lift back along the approach; otherwise straight up."""
EMPTY_OPENING = 0.1 * MAX_OPENING
"""Largest opening of an empty grasp."""
LEAST_RISE = 0.03
"""Smallest rise of an object that is in the air."""
WIDEST_OPENING = MAX_OPENING + 0.005
"""With a larger opening, a finger is jammed beyond the end of its range."""


@dataclass(frozen=True)
class Attempt:
    """The result of a grasp."""

    outcome: str
    """`lifted`, `blocked_at_pregrasp`, `blocked_on_approach`, `closed_on_nothing` or `lost_in_lift`.

    If contacts are allowed, the hand closes at the first contact of its approach. A failure is then
    `blocked_at_pregrasp` if the contact was in the first 2 mm."""
    opening: float
    """Distance between the fingers at the end."""
    rise: float
    """Height by which the held object rose; 0 without a held object."""
    object: str | None
    """Name of the held object; None without a held object."""
    touched: bool
    """Whether there was a contact during the approach."""
    short_by: float
    """Distance from the grasp at which the approach ended; 0 without a contact."""

    @property
    def success(self) -> bool:
        """VGN's check: after the lift the hand touches an object and is not closed."""
        return self.outcome == "lifted"

    @property
    def rose(self) -> bool:
        """Whether a success has its object in the air. VGN's check also accepts a jammed finger that lifts nothing."""
        return self.success and self.rise > LEAST_RISE and self.opening < WIDEST_OPENING


class World:
    """A table, initially empty."""

    def __init__(self, hand: str | Path = HAND) -> None:
        """`hand` is the URDF of a hand with the frames and the order of joints of `sim/hand/hand.urdf`."""
        self.hand = existing(hand)
        self.bullet = BulletClient(pybullet.DIRECT)
        self.clear()

    def close(self) -> None:
        """Ends the simulation."""
        self.bullet.disconnect()

    def clear(self) -> None:
        """Removes all objects."""
        self.bullet.resetSimulation()
        self.bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / STEPS_PER_SECOND, numSolverIterations=SOLVER_ITERATIONS
        )
        self.bullet.setGravity(0, 0, -9.81)
        self.objects: dict[int, str] = {}
        """The objects on the table: Bullet's body ids and the names."""
        self.table = self._box((SIZE / 2, SIZE / 2, TABLE_HEIGHT - 0.01), (1.2, 1.2, 0.02))

    # Scenes

    def add(self, urdf: str | Path, pose: Pose, scale: float = 1.0) -> int:
        """Adds an object with its base link at `pose`. Returns Bullet's body id."""
        path = existing(urdf)
        try:
            body = int(self.bullet.loadURDF(str(path), pose.position, pose.quaternion, globalScaling=scale))
        except pybullet.error:
            raise ValueError(f"{path} is not a URDF that PyBullet can load; see PyBullet's messages above") from None
        self.objects[body] = path.stem
        return body

    def place(self, objects: Iterable[tuple[str | Path, float, Pose]]) -> list[int]:
        """Replaces all objects, each given by URDF, scale and pose of the base link. Returns Bullet's body ids."""
        self.clear()
        return [self.add(urdf, pose, scale) for urdf, scale, pose in objects]

    def remove(self, body: int) -> None:
        """Removes an object."""
        self.bullet.removeBody(body)
        del self.objects[body]

    def pile(self, urdfs: Sequence[Path], count: int, rng: np.random.Generator) -> None:
        """Makes a pile: drops objects one by one into an open box, then removes the box."""
        self.clear()
        low, high, top, thickness = 0.02, 0.28, 0.13, 0.004
        middle, side, z = (low + high) / 2, high - low, TABLE_HEIGHT + top / 2
        walls = [
            self._box((edge, middle, z), (thickness, side, top)) for edge in (low + thickness / 2, high - thickness / 2)
        ] + [
            self._box((middle, edge, z), (side, thickness, top)) for edge in (low + thickness / 2, high - thickness / 2)
        ]
        for _ in range(count):
            urdf = urdfs[int(rng.integers(len(urdfs)))]
            turn = rng.normal(size=4)
            x, y = rng.uniform(0.1, 0.2, 2)
            qx, qy, qz, qw = turn / np.linalg.norm(turn)
            self.add(urdf, Pose((x, y, TABLE_HEIGHT + 0.2), (qx, qy, qz, qw)), rng.uniform(0.8, 1.0))
            self.wait_for_rest(1.0)
        for wall in walls:
            self.bullet.removeBody(wall)
        self.settle()

    def packed(self, urdfs: Sequence[Path], count: int, rng: np.random.Generator) -> None:
        """Places up to `count` objects upright at free positions."""
        self.clear()
        for _ in range(12):
            if len(self.objects) == count:
                break
            before = self.save()
            urdf = urdfs[int(rng.integers(len(urdfs)))]
            x, y = rng.uniform(0.08, 0.22, 2)
            yaw = rng.uniform(0, 2 * math.pi)
            quaternion = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
            body = self.add(urdf, Pose((x, y, 1.0), quaternion), rng.uniform(0.7, 0.9))
            # As in VGN's code, the centre of mass is placed at half the object's height.
            low, high = self.bullet.getAABB(body)
            z = TABLE_HEIGHT + (high[2] - low[2]) / 2 + 0.002
            self.bullet.resetBasePositionAndOrientation(body, (x, y, z), quaternion)
            self.bullet.stepSimulation()
            if self.bullet.getContactPoints(body):
                self.remove(body)
                self.restore(before)
            else:
                self.settle()
            self.forget(before)

    def settle(self) -> None:
        """Simulates until everything rests and removes objects that left the workspace, until no object leaves."""
        while True:
            self.wait_for_rest(2.0)
            gone = [body for body in self.objects if not all(0 <= c <= SIZE for c in self.position(body))]
            if not gone:
                return
            for body in gone:
                self.remove(body)

    def wait_for_rest(self, seconds: float) -> None:
        """Simulates until everything rests, for at most `seconds`."""
        for _ in range(math.ceil(seconds * STEPS_PER_SECOND / REST_CHUNK)):
            for _ in range(REST_CHUNK):
                self.bullet.stepSimulation()
            if all(np.linalg.norm(self.bullet.getBaseVelocity(body)) <= REST_SPEED for body in self.objects):
                return

    def position(self, body: int) -> tuple[float, float, float]:
        """Position of an object's centre of mass."""
        x, y, z = self.bullet.getBasePositionAndOrientation(body)[0]
        return x, y, z

    def save(self) -> int:
        """Saves poses and velocities. Returns the id of the saved state, which is valid until `forget`."""
        return int(self.bullet.saveState())

    def restore(self, state: int) -> None:
        """Restores a saved state. The world must contain the same objects."""
        self.bullet.restoreState(stateId=state)

    def forget(self, state: int) -> None:
        """Deletes a saved state."""
        self.bullet.removeState(state)

    # Grasps

    def execute(
        self,
        pose: Pose,
        allow_contact: bool = True,
        remove: bool = True,
        closed: Callable[[], None] | None = None,
    ) -> Attempt:
        """Executes a grasp: pre-grasp, approach, close, lift.

        `allow_contact`: at the first contact of the approach the hand closes; otherwise a contact is a failure.
        `remove`: removes the lifted object and lets the other objects settle. `closed` is called after the fingers have
        closed.
        """
        heights = {body: self.position(body)[2] for body in self.objects}
        hand = Hand(self.bullet, self.hand, moved(pose, -PREGRASP_DISTANCE))
        met_in = hand.move_to(pose.position, until_contact=True)
        short_by = 0.0 if met_in is None else math.dist(hand.pose.position, pose.position)
        blocked = "blocked_at_pregrasp" if met_in == 0 else "blocked_on_approach"
        held = None
        if met_in is not None and not allow_contact:
            outcome = blocked
        else:
            hand.close()
            if closed:
                closed()
            was_held = self._held(hand)
            hand.move_to(retreat(pose))
            held = self._held(hand)
            if held is not None:
                outcome = "lifted"
            elif met_in == 0:
                outcome = blocked
            else:
                outcome = "closed_on_nothing" if was_held is None else "lost_in_lift"
        attempt = Attempt(
            outcome=outcome,
            opening=hand.opening,
            rise=0.0 if held is None else self.position(held)[2] - heights[held],
            object=None if held is None else self.objects[held],
            touched=met_in is not None,
            short_by=short_by,
        )
        hand.remove()
        if remove:
            if held is not None:
                self.remove(held)
            self.settle()
        return attempt

    def _held(self, hand: Hand) -> int | None:
        if hand.opening <= EMPTY_OPENING:
            return None
        return next((body for body in hand.touched() if body in self.objects), None)

    def _box(self, centre: tuple[float, float, float], edges: tuple[float, float, float]) -> int:
        """A fixed box."""
        half = [edge / 2 for edge in edges]
        shape = self.bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        look = self.bullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=(0.9, 0.9, 0.9, 1))
        body = int(self.bullet.createMultiBody(0, shape, look, centre))
        self.bullet.changeDynamics(body, -1, lateralFriction=TABLE_FRICTION)
        return body


def moved(pose: Pose, distance: float) -> Pose:
    """The pose, moved by `distance` along its own z axis."""
    x, y, z = pose.position + distance * pose.matrix()[:3, 2]
    return Pose((x, y, z), pose.quaternion)


def retreat(pose: Pose) -> tuple[float, float, float]:
    """End position of the lift from a grasp: back along the approach, or straight up if the approach is too flat."""
    down = -pose.matrix()[2, 2]
    if math.acos(min(max(down, -1.0), 1.0)) > STEEPEST_LIFT_BACK:
        x, y, z = pose.position
        return x, y, z + LIFT
    return moved(pose, -LIFT).position


def existing(urdf: str | Path) -> Path:
    """The path of a file. Raises `FileNotFoundError` if it does not exist."""
    path = Path(urdf)
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; pass a URDF file")
    return path
