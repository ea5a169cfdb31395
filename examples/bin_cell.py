"""A simulated cell for picking, in MuJoCo: a Panda with long fingers, a full bin and an empty box.

Parts fall into the bin, touch each other, and are held by friction alone. The depth of the camera
on the wrist is cast by Embree and has the noise of a stereo camera; the poses that the arm reports
have the error of a hand-eye calibration. The arm's model is the one in ``gymnasium-robotics``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import mink
import mujoco
import numpy as np
from bin_parts import BinPart
from scipy.spatial.transform import Rotation

from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.scene.grasps import Gripper
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS, Sensor

FASTEST = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Velocity limits of the seven joints, rad/s (Franka Control Interface, robot and interface
specifications).
"""
RANGES = np.array(
    [
        [-2.8973, 2.8973],
        [-1.7628, 1.7628],
        [-2.8973, 2.8973],
        [-3.0718, -0.0698],
        [-2.8973, 2.8973],
        [-0.0175, 3.7525],
        [-2.8973, 2.8973],
    ]
)
"""Limits of the joints, rad (the same source)."""
OFFSETS = np.array([0, 0, 0, 0, 0, np.pi / 2, np.pi / 4])
"""The model counts its last two joints from elsewhere: Franka's angles less the model's."""
HOME = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 0.35, 0.0])
"""Joints at rest, rad: the elbow up, the camera over the table."""
STARTS = HOME + np.array(
    [
        [0, 0, 0, 0, 0, 0, 0],
        [0.9, 0.6, 0, 0.4, 0, 0, 0],
        [-0.9, 0.6, 0, 0.4, 0, 0, 0],
        [0.8, 0.9, -1.2, 0, 0, 0, 0],
        [-0.8, 0.9, 1.2, 0, 0, 0, 0],
        [0, 1.0, 0, 0.8, 0, -0.8, 0],
    ]
)
"""Where the search for joints begins if it finds none from where the arm is."""
LONGEST = 0.9
"""Metres from the shoulder beyond which no wrist comes: nothing is searched there."""

MILLIMETRE = 0.001
BIN = np.array([0.50, 0.0])  # centre of the bin, metres from the arm's base
BIN_INSIDE = np.array([0.32, 0.24, 0.07])  # its width, depth and height, metres
BOX = np.array([0.25, -0.45])  # centre of the box into which parts are dropped
BOX_INSIDE = np.array([0.30, 0.26, 0.12])
WALL = 0.003  # thickness of bin and box, metres: bent sheet
BELOW = 0.04  # metres of their bottoms in the table: falling parts would pass through a sheet
FUNNEL = 0.35  # metres, height of the walls while parts are poured
DENSITY = 2700.0  # of aluminium, kg/m^3
FRICTION = 0.35  # of metal on metal and on plastic
PAD_FRICTION = 1.0  # of a rubber pad on metal
FINGER_INERTIA = 1.0  # kilograms, of a finger with its drive
FINGER_STIFFNESS = 4000.0  # newtons a metre
FINGER_DAMPING = 2 * np.sqrt(FINGER_STIFFNESS * FINGER_INERTIA)  # critical
GRIP_FORCE = 40.0  # newtons of each finger; a Panda's hand holds with up to 70

GRIPPER = Gripper(
    opening=0.08,
    finger_width=0.018,
    finger_thickness=0.008,
    finger_length=0.09,
    palm=(0.14, 0.21, 0.16),
)
HAND_END = 0.165  # metres from link 7 to the front of the hand
PAD = 0.03  # metres of rubber on each finger
CAMERA = np.array([0.055, 0.0, 0.147])  # metres from link 7, along the hand's axes
SENSOR = replace(
    SENSORS["stereo"],  # a RealSense D415, whose lens is longer
    name="d415",
    focal=610.0,
    baseline=0.055,
    nearest=0.25,
    turned=0.1,
    moved=0.001,
)

TIMESTEP = 0.002  # seconds
SPEED = 0.35  # of the joints' velocity limits
STEP = 0.01  # metres between the places of a straight way that are solved for
CLEARANCE = 0.004  # metres that the planned arm keeps from walls and table
ITERATIONS = 40
CLOSE = 0.0005  # metres, and radians / 5, within which a pose counts as reached
ARRIVING = 0.4  # seconds that the controllers need to the end of a way
STILL = 0.02  # metres a second below which a part is at rest
SETTLING = 4.0  # seconds until which everything has to be at rest
STIFFNESS = np.array([4500, 4500, 3500, 3500, 2000, 2000, 2000.0])

WORLD = """
<mujoco>
  <include file="{assets}/assets.xml"/>
  <compiler meshdir="{assets}/meshes" angle="radian"/>
  <option timestep="{timestep}" cone="elliptic" impratio="10" noslip_iterations="5"
    integrator="implicitfast">
    <flag multiccd="enable"/>
  </option>
  <worldbody>
    <geom name="table" type="box" size="0.65 0.75 0.02" pos="0.35 0 -0.02" rgba="0.55 0.43 0.32 1"/>
    <include file="{assets}/chain.xml"/>
  </worldbody>
</mujoco>
"""
HAND = np.array([[1.0, 1, 0], [-1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
"""Axes of the hand in those of link 7, columns: the fingers close along y, z points forward."""


def panda_files() -> Path:
    """The folder of the arm's model."""
    spec = find_spec("gymnasium_robotics")  # to import it takes a while, and prints
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "envs/assets/kitchen_franka/franka_assets"


def along(way: Sequence[np.ndarray], step: float) -> list[np.ndarray]:
    """Joints along a way, no joint farther apart than a step, radians; with its first and its
    last.
    """
    found = [way[0]]
    for a, b in pairwise(way):
        n = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        found += [a + (b - a) * k / n for k in range(1, n + 1)]
    return found


def turned_least(rotation: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """A rotation, (3, 3), turned by the least angle that takes its z axis to a direction, (3,)
    (Rodrigues' formula).
    """
    now = rotation[:, 2]
    cosine = now @ forward
    if cosine < -1 + 1e-9:  # it looks the other way: any axis across it will do
        return rotation * [1, -1, -1]
    # times a vector: its cross product with the axis
    across = np.outer(forward, now) - np.outer(now, forward)
    return (np.eye(3) + across + across @ across / (1 + cosine)) @ rotation


CORNERS = np.stack(
    np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1], indexing="ij"),
    -1,
).reshape(8, 3)
SIDES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ],
    np.int32,
)


def triangles_of(model: Any, geom: int, mujoco: Any) -> tuple[np.ndarray, np.ndarray]:
    """A mesh or box of the model, in its own axes."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return CORNERS * model.geom_size[geom], SIDES
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    count = model.mesh_vertnum[mesh]
    begin = model.mesh_faceadr[mesh]
    faces = model.mesh_facenum[mesh]
    return (
        model.mesh_vert[first : first + count].astype(float),
        model.mesh_face[begin : begin + faces],
    )


def walls(
    centre: np.ndarray, inside: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centre and half sides, (3,) each, of the bottom and the four walls of a container."""
    x, y, height = *inside[:2] / 2, inside[2]
    flat = (
        [(0, 0, (WALL - BELOW) / 2)],
        [(x + WALL, y + WALL, (WALL + BELOW) / 2)],
    )
    middle = (height + WALL) / 2
    for sign in (-1, 1):
        flat[0].append((sign * (x + WALL / 2), 0, middle))
        flat[1].append((WALL / 2, y + WALL, middle))
        flat[0].append((0, sign * (y + WALL / 2), middle))
        flat[1].append((x, WALL / 2, middle))
    places = np.add(flat[0], [*centre, 0])
    return list(zip(places, np.array(flat[1]), strict=True))


def cell_spec() -> Any:
    """The arm with camera and fingers, the table, the bin and the box, without parts."""
    spec = mujoco.MjSpec.from_string(
        WORLD.format(assets=panda_files(), timestep=TIMESTEP)
    )
    box = mujoco.mjtGeom.mjGEOM_BOX
    for k, limits in enumerate(RANGES - OFFSETS[:, None]):
        spec.joint(f"robot:panda0_joint{k + 1}").range = limits
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(
        turn, np.stack([HAND[:, 1], -HAND[:, 0], HAND[:, 2]], 1).ravel()
    )
    upright = np.zeros(4)
    mujoco.mju_mat2Quat(upright, HAND.ravel())
    wrist = spec.body("panda0_link7")
    wrist.add_site(name="camera", pos=HAND @ CAMERA, quat=turn)
    tip = [0, 0, HAND_END + GRIPPER.finger_length]
    wrist.add_site(name="grip", pos=tip, quat=upright)
    back = CAMERA - [
        0,
        0,
        0.02,
    ]  # its lens is well before its case, whatever the errors
    for name, size, pos in (
        ("camera", [0.0125, 0.045, 0.012], back),
        ("mount", [0.03, 0.015, 0.006], back / [2, 1, 1]),
    ):
        wrist.add_geom(
            name=name,
            type=box,
            size=size,
            pos=HAND @ pos,
            quat=upright,
            rgba=[0.15, 0.15, 0.18, 1],
            mass=0.05,
        )
    for side, sign in (("left", 1), ("right", -1)):
        finger = spec.body(f"panda0_{side}finger")
        for geom in list(finger.geoms):
            spec.delete(geom)
        rest = GRIPPER.finger_length - PAD
        half = GRIPPER.finger_thickness / 2
        for name, low, length, colour in (
            ("steel", 0.0, rest, [0.6, 0.62, 0.65, 1]),
            ("pad", rest, PAD, [0.16, 0.17, 0.2, 1]),
        ):
            finger.add_geom(
                name=f"{side} {name}",
                type=box,
                size=[GRIPPER.finger_width / 2, half, length / 2],
                pos=[0, sign * half, low + length / 2],
                rgba=colour,
                mass=0.02,
                friction=[PAD_FRICTION if name == "pad" else FRICTION, 0.01, 0.0001],
                condim=4,
                solref=[2 * TIMESTEP, 1],  # the stiffest contact that is stable
                contype=1,
                conaffinity=1,
                group=0,
                priority=1,  # a pad's friction holds, whatever it touches
            )
    for name, centre, inside in (("bin", BIN, BIN_INSIDE), ("box", BOX, BOX_INSIDE)):
        for k, (place, half) in enumerate(walls(centre, inside)):
            spec.worldbody.add_geom(
                name=f"{name}{k}",
                type=box,
                size=half,
                pos=place,
                friction=[FRICTION, 0.005, 0.0001],
                rgba=[0.36, 0.42, 0.5, 1] if name == "bin" else [0.72, 0.6, 0.42, 1],
            )
    return spec


class Planner:
    """Inverse kinematics and collisions of the arm with open fingers, without the parts."""

    def __init__(self) -> None:
        spec = cell_spec()
        for finger in (1, 2):
            spec.delete(spec.joint(f"robot:panda0_finger_joint{finger}"))
        for geom in spec.worldbody.geoms:
            geom.margin = CLEARANCE
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._rest = mink.PostureTask(self.model, cost=1e-3)
        self._rest.set_target(HOME)
        self._fingers = [
            self.model.body(f"panda0_{s}finger").id for s in ("left", "right")
        ]
        names = [self.model.joint(k).name for k in range(7)]
        self._limits = [
            mink.ConfigurationLimit(self.model),
            mink.VelocityLimit(self.model, dict(zip(names, FASTEST, strict=True))),
        ]

    def open_to(self, opening: float) -> None:
        """Hold the fingers some metres apart."""
        for body, sign in zip(self._fingers, (1, -1), strict=True):
            self.model.body_pos[body, :2] = HAND[:2, 1] * sign * opening / 2

    def pose(self, joints: np.ndarray, site: str) -> np.ndarray:
        """Where "camera" or "grip" is, (4, 4), metres."""
        self.data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, self.data)
        found = np.eye(4)
        found[:3, :3] = self.data.site(site).xmat.reshape(3, 3)
        found[:3, 3] = self.data.site(site).xpos
        return found

    def touches(self, joints: np.ndarray) -> bool:
        """Whether the arm touches itself, the table, the bin or the box."""
        self.data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return self.data.ncon > 0

    def solve(
        self, pose: np.ndarray, site: str, start: np.ndarray
    ) -> np.ndarray | None:
        """Joints, (7,), near some others, with which a site is at a pose; None without any.

        The camera may turn about its line of sight, which shows nothing new.
        """
        turns = site == "camera"
        cost = [0.3, 0.3, 0.0 if turns else 0.3]
        task = mink.FrameTask(site, "site", 1.0, cost, lm_damping=1e-5)
        arm = mink.Configuration(self.model, start)
        for _ in range(ITERATIONS):
            target = pose.copy()
            if turns:
                here = arm.get_transform_frame_to_world(site, "site").as_matrix()
                target[:3, :3] = turned_least(here[:3, :3], pose[:3, 2])
            task.set_target(mink.SE3.from_matrix(target))
            error = task.compute_error(arm)
            if (
                np.linalg.norm(error[:3]) < CLOSE
                and np.linalg.norm(error[3:]) < 5 * CLOSE
            ):
                return arm.q.copy()
            try:
                speed = mink.solve_ik(
                    arm, [task, self._rest], 0.5, "daqp", limits=self._limits
                )
            except mink.NoSolutionFound:
                return None
            arm.integrate_inplace(speed, 0.5)
        return None

    def joints_for(
        self, pose: np.ndarray, site: str, here: np.ndarray
    ) -> np.ndarray | None:
        """Joints, (7,), with which a site is at a pose, without a collision; None without any."""
        if np.linalg.norm(pose[:3, 3] - [0, 0, 0.333]) > LONGEST or pose[2, 3] < 0:
            return None
        for start in (here, *STARTS):
            found = self.solve(pose, site, start)
            if found is not None and not self.touches(found):
                return found
        return None

    def line(
        self, start: np.ndarray, way: np.ndarray, site: str = "grip"
    ) -> list[np.ndarray] | None:
        """Joints along a straight way of a site from where it is, without turning.

        Args:
            start: joints at its begin, (7,).
            way: metres, (3,).

        Returns:
            Joints at places a centimetre apart; None if the way is blocked or out of reach.
        """
        pose = self.pose(start, site)
        found = [start]
        count = max(1, int(np.ceil(np.linalg.norm(way) / STEP)))
        for k in range(1, count + 1):
            there = pose.copy()
            there[:3, 3] += way * k / count
            joints = self.solve(there, site, found[-1])
            if joints is None or self.touches(joints):
                return None
            if (
                np.abs(joints - found[-1]).max() > 0.3
            ):  # another branch of the solutions
                return None
            found.append(joints)
        return found

    def way(self, start: np.ndarray, end: np.ndarray) -> list[np.ndarray] | None:
        """Corners of a way between two joint positions; None if all are blocked."""
        for corners in ([start, end], [start, HOME, end]):
            if not any(self.touches(joints) for joints in along(corners, 0.05)):
                return corners
        return None


class Cell:
    """The cell with its parts. The arm moves and grips by torques; time passes while it does.

    Attributes:
        joints: where the arm is sent, (7,).
        names: true name of each part.
    """

    def __init__(
        self,
        parts: Mapping[str, BinPart],
        poured: Sequence[str],
        rng: np.random.Generator,
    ) -> None:
        self.names = list(poured)
        self.planner = Planner()
        self.joints = HOME.copy()
        self.sensor: Sensor = SENSOR
        self._rng = rng
        self._meshes = {
            name: (MILLIMETRE * part.solid[0], part.solid[1])
            for name, part in parts.items()
        }
        self._build(parts, rng)
        self._rays = PinholeCamera.of(SENSOR.intrinsics, SENSOR.shape).rays.reshape(
            -1, 3
        )
        self._pour()

    def _build(self, parts: Mapping[str, BinPart], rng: np.random.Generator) -> None:
        spec = cell_spec()
        for body in spec.bodies:
            if body.name.startswith("panda0"):
                body.gravcomp = 1.0
        for k, kp in enumerate(STIFFNESS):
            act = spec.add_actuator(
                name=f"joint{k}", target=f"robot:panda0_joint{k + 1}"
            )
            act.trntype = mujoco.mjtTrn.mjTRN_JOINT
            act.set_to_position(kp=kp, kv=kp / 10)
        for finger in (1, 2):
            joint = spec.joint(f"robot:panda0_finger_joint{finger}")
            joint.armature = FINGER_INERTIA
            act = spec.add_actuator(name=f"finger{finger}", target=joint.name)
            act.trntype = mujoco.mjtTrn.mjTRN_JOINT
            act.set_to_position(kp=FINGER_STIFFNESS, kv=FINGER_DAMPING)
            act.forcerange = [-GRIP_FORCE, GRIP_FORCE]
            act.forcelimited = True
        together = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1="robot:panda0_finger_joint1",
            name2="robot:panda0_finger_joint2",
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
        )
        together.data[:5] = [0, 1, 0, 0, 0]
        hull = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        for name, part in parts.items():
            for k, (vertices, faces) in enumerate(part.pieces):
                spec.add_mesh(
                    name=f"{name}{k}",
                    uservert=(MILLIMETRE * vertices).ravel(),
                    userface=faces.ravel(),
                    inertia=hull,
                )
        for k, half in enumerate([FUNNEL / 2] * 4):
            place, size = walls(BIN, BIN_INSIDE)[k + 1]
            spec.worldbody.add_geom(
                name=f"funnel{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[*size[:2], half],
                pos=[*place[:2], BIN_INSIDE[2] + WALL + half],
                group=4,
            )
        for row, name in enumerate(self.names):
            layer, place = divmod(row, 4)
            x, y = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])[place] * [0.07, 0.05]
            body = spec.worldbody.add_body(
                name=f"part{row}",
                pos=[BIN[0] + x, BIN[1] + y, 0.12 + 0.1 * layer],
                quat=Rotation.random(random_state=rng).as_quat(),
            )
            body.add_freejoint()
            for k in range(len(parts[name].pieces)):
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH,
                    meshname=f"{name}{k}",
                    density=DENSITY,
                    friction=[FRICTION, 0.005, 0.0002],
                    condim=4,
                )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:7] = self.joints
        self.open()
        self._parts = [
            self.model.body(f"part{row}").id for row in range(len(self.names))
        ]
        self._speeds = [
            slice(adr, adr + 3)
            for adr in (self.model.body_dofadr[body] for body in self._parts)
        ]

    # Physics

    def open(self, opening: float = GRIPPER.opening) -> None:
        """Send the fingers some metres apart."""
        self.data.ctrl[7:9] = opening / 2

    @property
    def opening(self) -> float:
        """Distance between the fingers, metres."""
        return float(self.data.qpos[7:9].sum())

    def close(self) -> None:
        """Send the fingers together; they press as hard as GRIP_FORCE."""
        self.data.ctrl[7:9] = -0.01

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / TIMESTEP)):
            self.data.ctrl[:7] = self.joints
            mujoco.mj_step(self.model, self.data)

    def settle(self) -> None:
        """Wait until the parts lie still."""
        for _ in range(round(SETTLING / 0.1)):
            self.wait(0.1)
            if self.speed < STILL:
                return

    @property
    def speed(self) -> float:
        """Of the fastest part, metres a second."""
        return max(float(np.linalg.norm(self.data.qvel[one])) for one in self._speeds)

    def _pour(self) -> None:
        self.wait(2.0)
        self.settle()
        for k in range(4):
            geom = self.model.geom(f"funnel{k}")
            geom.contype = geom.conaffinity = 0
        self.settle()

    def follow(self, corners: Sequence[np.ndarray], speed: float = SPEED) -> None:
        """Move along joints, (7,) each, from rest to rest.

        Args:
            corners: of the way.
            speed: highest speed, as a share of the joints' velocity limits.
        """
        legs = [np.abs(b - a).max() for a, b in pairwise(corners)]
        until = np.cumsum([0, *(leg / FASTEST.min() / speed for leg in legs)])
        seconds = np.pi / 2 * until[-1]  # of a cosine with that highest speed
        ways = np.stack(corners)
        for share in np.arange(TIMESTEP, seconds, TIMESTEP) / max(seconds, TIMESTEP):
            now = until[-1] * (1 - np.cos(np.pi * share)) / 2
            self.joints = np.array([np.interp(now, until, way) for way in ways.T])
            self.wait(TIMESTEP)
        self.joints = corners[-1]
        self.wait(ARRIVING)

    @property
    def seconds(self) -> float:
        """Simulated time, seconds."""
        return float(self.data.time)

    # Truth

    def pose_of(self, row: int) -> np.ndarray:
        """True pose of a part, part-to-world, (4, 4), metres."""
        body = self._parts[row]
        pose = np.eye(4)
        pose[:3, :3] = self.data.xmat[body].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[body]
        return pose

    def inside(self, centre: np.ndarray, inside: np.ndarray) -> list[int]:
        """Parts whose origin is above the bottom of a container, by row."""
        places = np.array([self.pose_of(row)[:2, 3] for row in range(len(self.names))])
        return np.flatnonzero(
            (np.abs(places - centre) < inside[:2] / 2).all(1)
        ).tolist()

    def things(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """All that can be seen: vertices, (N, 3), and faces, (F, 3); first the parts, by row."""
        found = []
        for row, name in enumerate(self.names):
            vertices, faces = self._meshes[name]
            pose = self.pose_of(row)
            placed = vertices @ pose[:3, :3].T + pose[:3, 3]
            found.append((placed, faces.astype(np.int32)))
        model, data = self.model, self.data
        for k in range(model.ngeom):
            if model.geom_group[k] > 2 or model.geom_bodyid[k] in self._parts:
                continue
            vertices, faces = triangles_of(model, k, mujoco)
            placed = vertices @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k]
            found.append((placed, faces))
        return found

    # Camera

    def camera_pose(self) -> np.ndarray:
        """Where the arm believes its camera to be, (4, 4), OpenCV axes, metres."""
        return self.planner.pose(self.data.qpos[:7].copy(), "camera")

    def look(self) -> Frame:
        """What the camera on the wrist gives.

        Returns:
            The frame; ``owner`` has the part that each pixel truly shows, -1 for none.
        """
        rng = self._rng.spawn(1)[0]
        pose = self.camera_pose()
        true = pose.copy()
        turn = Rotation.from_rotvec(rng.normal(0, SENSOR.turned, 3), degrees=True)
        true[:3, :3] = pose[:3, :3] @ turn.as_matrix()
        true[:3, 3] += rng.normal(0, SENSOR.moved, 3)
        caster = RayCaster(self.things())
        depth, owner = caster.cast(true[:3, 3], self._rays @ true[:3, :3].T)
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        measured, source = SENSOR.measure(depth.reshape(SENSOR.shape), rng)
        owner = np.where(owner < len(self.names), owner, -1)
        self.owner = np.where(source >= 0, owner[np.maximum(source, 0)], -1)
        self.owner[measured == 0] = -1
        return Frame(measured, SENSOR.intrinsics, pose, pixel_centre=0.5)
