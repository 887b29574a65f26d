"""A table with objects in PyBullet, and grasps tried on them: the benchmark's protocol in the engine of VGN's own code.

Lengths are in metres, poses `graspd.Pose` in the task frame: its origin is a corner of the cube of 0.3 m, z is up, the
table is at z = 0.05.
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
"""The Panda hand."""

SIZE = 0.3
TABLE_HEIGHT = 0.05
TABLE_FRICTION = 0.5
SOLVER_ITERATIONS = 150

REST_SPEED = 0.01
"""Norm of a resting body's velocity, m/s and rad/s together."""
REST_CHUNK = 60
"""Steps between two checks that everything rests."""

PREGRASP_DISTANCE = 0.05
LIFT = 0.1
STEEPEST_LIFT_BACK = math.pi / 3
"""How far off straight down an approach may be for the hand to lift back along it; else it lifts straight up."""
EMPTY_OPENING = 0.1 * MAX_OPENING
"""A hand with a smaller opening holds nothing."""
LEAST_RISE = 0.03
WIDEST_OPENING = MAX_OPENING + 0.005
"""Wider, a finger is jammed beyond the end of its range."""


@dataclass(frozen=True)
class Attempt:
    """The result of a grasp."""

    outcome: str
    """`lifted`, `blocked_at_pregrasp`, `blocked_on_approach`, `closed_on_nothing` or `lost_in_lift`.

    Where contacts are allowed the hand closes where its approach met something, and a failure is called
    `blocked_at_pregrasp` if that was in the first 2 mm."""
    opening: float
    """Between the fingers at the end."""
    rise: float
    """Of the object in the hand; 0 without one."""
    object: str | None
    """The name of the object in the hand."""
    touched: bool
    """Whether the approach met something."""
    short_by: float
    """From where the hand closed to the grasp; 0 if nothing stopped it."""

    @property
    def success(self) -> bool:
        """VGN's check: after the lift the hand touches something that is not the table, and is not shut."""
        return self.outcome == "lifted"

    @property
    def rose(self) -> bool:
        """A success whose object is in the air, for VGN's check also passes when a finger is jammed."""
        return self.success and self.rise > LEAST_RISE and self.opening < WIDEST_OPENING


class World:
    """A table, at first an empty one."""

    def __init__(self, hand: str | Path = HAND) -> None:
        """`hand` is the URDF of a hand with the frames and the order of joints of `sim/hand/hand.urdf`."""
        self.hand = existing(hand)
        self.bullet = BulletClient(pybullet.DIRECT)
        self.clear()

    def close(self) -> None:
        """Ends the simulation."""
        self.bullet.disconnect()

    def clear(self) -> None:
        """Empties the table."""
        self.bullet.resetSimulation()
        self.bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / STEPS_PER_SECOND, numSolverIterations=SOLVER_ITERATIONS
        )
        self.bullet.setGravity(0, 0, -9.81)
        self.objects: dict[int, str] = {}
        """What stands on the table: Bullet's numbers and the names."""
        self.table = self._box((SIZE / 2, SIZE / 2, TABLE_HEIGHT - 0.01), (1.2, 1.2, 0.02))

    # Scenes

    def add(self, urdf: str | Path, pose: Pose, scale: float = 1.0) -> int:
        """Adds an object whose base link is at `pose`; the answer is Bullet's number of it."""
        path = existing(urdf)
        try:
            body = int(self.bullet.loadURDF(str(path), pose.position, pose.quaternion, globalScaling=scale))
        except pybullet.error:
            raise ValueError(f"{path} is not a URDF that PyBullet can load; its messages above say why") from None
        self.objects[body] = path.stem
        return body

    def place(self, objects: Iterable[tuple[str | Path, float, Pose]]) -> list[int]:
        """Empties the table and puts these on it, each a URDF, its scale and the pose of its base link."""
        self.clear()
        return [self.add(urdf, pose, scale) for urdf, scale, pose in objects]

    def remove(self, body: int) -> None:
        """Takes an object away."""
        self.bullet.removeBody(body)
        del self.objects[body]

    def pile(self, urdfs: Sequence[Path], count: int, rng: np.random.Generator) -> None:
        """Makes a pile: objects dropped one by one into an open box, which is then taken away."""
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
        """Stands up to `count` objects upright where there is room."""
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
            # As VGN's code has it, the centre of mass goes to half the object's height.
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
        """Simulates until everything rests, and removes objects outside the workspace, until none leaves it."""
        while True:
            self.wait_for_rest(2.0)
            gone = [body for body in self.objects if not all(0 <= c <= SIZE for c in self.position(body))]
            if not gone:
                return
            for body in gone:
                self.remove(body)

    def wait_for_rest(self, seconds: float) -> None:
        """Simulates until everything rests, at most `seconds`."""
        for _ in range(math.ceil(seconds * STEPS_PER_SECOND / REST_CHUNK)):
            for _ in range(REST_CHUNK):
                self.bullet.stepSimulation()
            if all(np.linalg.norm(self.bullet.getBaseVelocity(body)) <= REST_SPEED for body in self.objects):
                return

    def position(self, body: int) -> tuple[float, float, float]:
        """Of an object's centre of mass."""
        x, y, z = self.bullet.getBasePositionAndOrientation(body)[0]
        return x, y, z

    def save(self) -> int:
        """Saves poses and velocities, until `forget`."""
        return int(self.bullet.saveState())

    def restore(self, state: int) -> None:
        """Restores poses and velocities. The objects must be the same."""
        self.bullet.restoreState(stateId=state)

    def forget(self, state: int) -> None:
        """Ends a `save`."""
        self.bullet.removeState(state)

    # Grasps

    def execute(
        self,
        pose: Pose,
        allow_contact: bool = True,
        remove: bool = True,
        closed: Callable[[], None] | None = None,
    ) -> Attempt:
        """Tries a grasp: pre-grasp, approach, close, lift.

        `allow_contact`: the hand closes where its approach met something; else that is a failure. `remove`: takes away
        what was lifted, and lets the rest settle. `closed` is called when the fingers have closed.
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
        """A box that does not move."""
        half = [edge / 2 for edge in edges]
        shape = self.bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        look = self.bullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=(0.9, 0.9, 0.9, 1))
        body = int(self.bullet.createMultiBody(0, shape, look, centre))
        self.bullet.changeDynamics(body, -1, lateralFriction=TABLE_FRICTION)
        return body


def moved(pose: Pose, distance: float) -> Pose:
    """The pose so far along its own z."""
    x, y, z = pose.position + distance * pose.matrix()[:3, 2]
    return Pose((x, y, z), pose.quaternion)


def retreat(pose: Pose) -> tuple[float, float, float]:
    """Where the lift from a grasp ends: back along the approach, or above the grasp if that is too flat."""
    down = -pose.matrix()[2, 2]
    if math.acos(min(max(down, -1.0), 1.0)) > STEEPEST_LIFT_BACK:
        x, y, z = pose.position
        return x, y, z + LIFT
    return moved(pose, -LIFT).position


def existing(urdf: str | Path) -> Path:
    """The path, if there is such a file."""
    path = Path(urdf)
    if not path.is_file():
        raise FileNotFoundError(f"{path} not found; pass a URDF file")
    return path
