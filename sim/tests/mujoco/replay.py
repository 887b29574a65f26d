"""Replays trials of grasp-sim in MuJoCo, for sim/tests/it/agreement.rs. Needs `pip install mujoco numpy`.

    grasp-sim objects --objects train --out objects
    grasp-sim label --scene pile --objects train --points 40 --scenes 8 --seed 77 --out pile --export pile.jsonl
    grasp-sim label --scene packed --objects train --points 40 --scenes 8 --seed 77 --out packed --export packed.jsonl
    python replay.py objects pile.jsonl packed.jsonl > sim/tests/mujoco/trials.jsonl

Each line is a scene: its objects, and for each grasp point the pose of its first yaw and the outcomes of the five
different yaws: 0 blocked on the approach, 1 failed later, 2 lifted.
"""

import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

STEP = 1 / 240
TABLE = 0.05
TCP = 0.062
TRAVEL = 0.04
FORCE = 20.0
DAMPING = 130.0
# Height of the fingers' frames in the hand's frame, see hand.urdf.
FINGER_ROOT = 0.0584
HAND = Path(__file__).parents[2] / "hand"


def parts_of(folder, name):
    """Mass, friction and convex parts (vertices) of an object."""
    link = ElementTree.parse(folder / f"{name}.urdf").find("link")
    mass = float(link.find("inertial/mass").get("value"))
    friction = link.find("contact/lateral_friction")
    mesh = link.find("collision/geometry/mesh").get("filename")
    vertices, parts, used = [], [], set()
    for line in (folder / mesh).read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(number) for number in rest[:3]])
        elif kind in ("o", "g"):
            parts, used = parts + [used], set()
        elif kind == "f":
            used |= {int(corner.split("/")[0]) - 1 for corner in rest}
    parts = [np.array([vertices[i] for i in sorted(part)]) for part in [*parts, used] if part]
    return mass, float(friction.get("value")) if friction is not None else 1.0, parts


def hand_part(name, side, offset):
    """The corners of a part of the hand in the grasp frame; the right finger is the left one rotated about z."""
    lines = (HAND / name).read_text().splitlines()
    corners = np.array([[float(number) for number in line.split()[1:4]] for line in lines if line.startswith("v ")])
    return corners * [side, side, 1] + offset


def numbers(values):
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def scene_xml(folder, scene, hand_pose, axis):
    """A world with the scene's objects and a hand that slides along `axis` only."""
    assets, bodies = [], []
    for index, body in enumerate(scene["objects"]):
        mass, friction, parts = parts_of(folder, body["object"])
        geoms = []
        for number, vertices in enumerate(parts):
            mesh = f"mesh{index}_{number}"
            assets.append(f'<mesh name="{mesh}" vertex="{numbers(vertices * body["scale"])}"/>')
            share = mass / len(parts)
            geoms.append(f'<geom type="mesh" mesh="{mesh}" mass="{share:.9g}" friction="{friction} 0.005 0.0001"/>')
        x, y, z, qx, qy, qz, qw = body["pose"]
        bodies.append(
            f'<body name="object{index}" pos="{numbers([x, y, z])}" quat="{numbers([qw, qx, qy, qz])}">'
            f"<freejoint/>{''.join(geoms)}</body>"
        )
    x, y, z, qx, qy, qz, qw = hand_pose
    palm = hand_part("palm.obj", 1, [0, 0, -TCP])
    assets.append(f'<mesh name="palm" vertex="{numbers(palm)}"/>')
    fingers = ""
    for side, name in [(1, "left"), (-1, "right")]:
        finger = hand_part("finger.obj", side, [0, side * TRAVEL, FINGER_ROOT - TCP])
        assets.append(f'<mesh name="{name}" vertex="{numbers(finger)}"/>')
        fingers += (
            f'<body name="{name}" gravcomp="1"><joint name="{name}" type="slide" axis="0 {side} 0" '
            f'range="{-TRAVEL} 0" limited="true" damping="{DAMPING}"/>'
            f'<geom name="{name}" type="mesh" mesh="{name}" mass="0.15" '
            f'friction="1 0.005 0.0001"/></body>'
        )
    return f"""<mujoco>
      <compiler angle="radian"/>
      <option timestep="{STEP}" gravity="0 0 -9.81" cone="elliptic" impratio="10" integrator="discrete"/>
      <default><geom condim="4" solref="0.005 1" solimp="0.95 0.99 0.001"/></default>
      <asset>{''.join(assets)}</asset>
      <worldbody>
        <geom name="table" type="plane" size="1 1 1" pos="0 0 {TABLE}" friction="0.5 0.005 0.0001" priority="1"/>
        {''.join(bodies)}
        <body name="hand" pos="{numbers([x, y, z])}" quat="{numbers([qw, qx, qy, qz])}" gravcomp="1">
          <joint name="slide" type="slide" axis="{numbers(axis)}"/>
          <geom name="palm" type="mesh" mesh="palm" mass="0.81"/>
          {fingers}
        </body>
      </worldbody>
      <contact><exclude body1="hand" body2="left"/><exclude body1="hand" body2="right"/>
        <exclude body1="left" body2="right"/></contact>
      <equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0" solref="0.01 1"/></equality>
      <actuator>
        <position name="slide" joint="slide" kp="2e5" kv="4e3"/>
        <motor name="left" joint="left"/><motor name="right" joint="right"/>
      </actuator>
    </mujoco>"""


def rotated(quaternion, vector):
    out = np.zeros(3)
    x, y, z, w = quaternion
    mujoco.mju_rotVecQuat(out, np.asarray(vector, float), np.array([w, x, y, z]))
    return out


def touches(model, data, hand):
    """Whether a part of the hand touches anything else."""
    for contact in data.contact[: data.ncon]:
        a, b = (model.geom_bodyid[geom] in hand for geom in contact.geom)
        if a != b and contact.dist < 0:
            return True
    return False


def trial(folder, scene, pose):
    quaternion = pose[3:]
    approach = rotated(quaternion, [0, 0, 1])
    off = np.arccos(np.clip(-approach[2], -1, 1))
    lift = np.array([0, 0, 1.0]) if off > np.pi / 3 else -approach
    # First the hand slides along its approach to detect contacts. Then a new model slides it along the lift direction.
    hand_names = ["hand", "left", "right"]
    model = mujoco.MjModel.from_xml_string(scene_xml(folder, scene, pose, rotated(np.array([-1, -1, -1, 1]) * quaternion, approach)))
    data = mujoco.MjData(model)
    hand = [model.body(name).id for name in hand_names]
    slide = model.joint("slide").qposadr[0]
    for distance in np.arange(0.05, -1e-9, -0.002):
        data.qpos[slide] = -distance
        mujoco.mj_forward(model, data)
        if touches(model, data, hand):
            return 0
    model = mujoco.MjModel.from_xml_string(scene_xml(folder, scene, pose, rotated(np.array([-1, -1, -1, 1]) * quaternion, lift)))
    data = mujoco.MjData(model)
    slide = model.joint("slide").qposadr[0]
    left, right = (model.joint(name).qposadr[0] for name in ["left", "right"])
    actuators = {name: model.actuator(name).id for name in ["slide", "left", "right"]}
    data.ctrl[actuators["left"]] = data.ctrl[actuators["right"]] = -FORCE
    for _ in range(120):
        mujoco.mj_step(model, data)
    width = lambda: 2 * TRAVEL + data.qpos[left] + data.qpos[right]
    if width() <= 0.008:
        return 1
    ramp, target = 0.05, 0.0
    for step in range(int((0.1 / 0.1 + ramp / 2) / STEP)):
        target += 0.1 * STEP * min(1.0, (step + 1) * STEP / ramp)
        data.ctrl[actuators["slide"]] = target
        mujoco.mj_step(model, data)
    fingers = [model.geom(name).id for name in ["left", "right"]]
    objects = {model.geom("table").id, model.geom("palm").id, *fingers}
    held = any(
        (a in fingers) != (b in fingers) and not {a, b} - set(fingers) & objects for a, b in data.contact.geom[: data.ncon]
    )
    return 2 if held and width() > 0.008 else 1


def turned(pose, yaw):
    """The pose rotated by `yaw` · 36° about its z axis."""
    half = yaw * np.pi / 5 / 2
    x, y, z, w = pose[3:]
    s, c = np.sin(half), np.cos(half)
    return [*pose[:3], x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s]


def main():
    folder, *exports = map(Path, sys.argv[1:])
    for path in exports:
        for line in path.read_text().splitlines():
            scene = json.loads(line)
            points = []
            for point in scene["trials"]:
                first = turned(point["pose"], -point["yaw"])
                outcomes = [trial(folder, scene, turned(first, yaw)) for yaw in range(5)]
                points.append({"pose": [round(number, 6) for number in first], "mujoco": outcomes})
            objects = [{**body, "pose": [round(number, 6) for number in body["pose"]]} for body in scene["objects"]]
            print(json.dumps({"kind": path.stem, "objects": objects, "points": points}), flush=True)


if __name__ == "__main__":
    main()
