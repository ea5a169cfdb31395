"""A simulated arm, a Franka Panda, with a depth camera on its wrist, over what stands on a table.

MuJoCo tells where the links are and what they touch, mink solves the inverse kinematics, and the
depth is cast by Embree: MuJoCo's own renderer needs OpenGL, which not every machine has. The arm's
model is the one in ``gymnasium-robotics``, which comes from https://github.com/vikashplus/franka.

>>> rng = np.random.default_rng(0)                                              # doctest: +SKIP
>>> arm = Arm([put_down(nextview.load_mesh("chair.off"), rng)], rng)            # doctest: +SKIP
>>> arm.run(nextview.load().session(object=ObservedObject(life_size=False), distance=0.4))  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS, Sensor
from research.extras import extras

if TYPE_CHECKING:
    from nextview.session.result import Recognition
    from nextview.session.session import Session

Float = NDArray[np.float64]

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
ITERATIONS = 20
CLOSE = 0.002
STRAIGHT = np.radians(0.5)
"""Steps of a search, and how near it has to come: metres and radians."""
LONGEST = 0.9
"""Metres from the shoulder beyond which no wrist comes: nothing is searched there."""
CLEARANCE = 0.01
"""Metres that the arm keeps from the table and from the things on it."""
AROUND_LINKS = 6
"""Pixels beside the arm's own links that are taken out of a picture with them."""
FINE = 0.05
"""Radians between the places of a motion that are looked at for collisions."""
CAMERA = np.array([0.055, 0.0, 0.147])
"""Where the camera sits beside the hand: metres from link 7, along the hand's axes."""
OBJECT = np.array([0.5, 0.0])
"""Where on the table the object is put, or near it: metres from the arm's base."""

SCENE = """
<mujoco>
  <include file="{assets}/assets.xml"/>
  <compiler meshdir="{assets}/meshes" angle="radian"/>
  <worldbody>
    <geom name="table" type="box" size="0.55 0.6 0.02" pos="0.35 0 -0.02" margin="{clearance}" rgba="0.55 0.43 0.32 1"/>
    <include file="{assets}/chain.xml"/>
  </worldbody>
</mujoco>
"""


def _assets() -> Path:
    spec = find_spec("gymnasium_robotics")  # to import it takes a while, and prints
    if spec is None or spec.origin is None:
        with extras():
            raise ModuleNotFoundError(
                "No module named 'gymnasium_robotics'",
                name="gymnasium_robotics",
            )
    return Path(spec.origin).parent / "envs/assets/kitchen_franka/franka_assets"


def put_down(mesh: Mesh, rng: np.random.Generator, radius: float = 0.1) -> Triangles:
    """Put a mesh on the table near ``OBJECT``, turned at random.

    Args:
        mesh: the object.
        rng: draws where it stands and how it is turned.
        radius: of the object, metres.

    Returns:
        Vertices, (V, 3), metres, and faces, (F, 3).
    """
    cos = np.cos(turn := rng.uniform(0, 2 * np.pi))
    sin = np.sin(turn)
    vertices = (
        radius * mesh.vertices @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    )
    vertices += [*(OBJECT + rng.uniform(-0.05, 0.05, 2)), -vertices[:, 2].min()]
    return vertices, mesh.faces


def _model(things: Sequence[Triangles]) -> Any:
    """The arm with its camera, the table and the things on it.

    MuJoCo takes the convex hulls of the things for collisions.
    """
    with extras():
        import mujoco

    spec = mujoco.MjSpec.from_string(
        SCENE.format(assets=_assets(), clearance=CLEARANCE)
    )
    for finger in "12":  # it holds nothing: the hand stays closed
        spec.delete(spec.joint(f"robot:panda0_finger_joint{finger}"))
    for k, limits in enumerate(RANGES - OFFSETS[:, None]):
        spec.joint(f"robot:panda0_joint{k + 1}").range = limits
    # columns: its axes in those of link 7
    hand = np.array([[1.0, 1, 0], [-1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    eye = np.zeros(4)
    # x right, y down, z forward
    mujoco.mju_mat2Quat(eye, np.stack([hand[:, 1], -hand[:, 0], hand[:, 2]], 1).ravel())
    wrist = spec.body("panda0_link7")
    wrist.add_site(name="camera", pos=hand @ CAMERA, quat=eye)
    # its lens is in the middle of its front
    box = mujoco.mjtGeom.mjGEOM_BOX
    back = CAMERA - [0, 0, 0.013]
    for name, size, pos in (
        ("camera", [0.045, 0.0125, 0.012], back),
        ("mount", [0.015, 0.03, 0.006], back / [2, 1, 1]),
    ):
        wrist.add_geom(
            name=name,
            type=box,
            size=size,
            pos=hand @ pos,
            quat=eye,
            rgba=[0.15, 0.15, 0.18, 1],
            mass=0.05,
        )
    # of meshes that enclose no volume, too
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for k, (vertices, faces) in enumerate(things):
        name = f"thing{k}"
        spec.add_mesh(
            name=name,
            uservert=vertices.ravel(),
            userface=faces.ravel(),
            inertia=shell,
        )
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            margin=CLEARANCE,
            rgba=[0.25, 0.5, 0.75, 1],
        )
    return spec.compile()


class Arm:
    """A Panda at the origin, z up, on a table at z = 0; metres and radians. It moves, and looks.

    Args:
        things: what stands on the table, vertices (V, 3), metres, and faces (F, 3) of each.
        rng: draws the errors of the sensor and of its setup.
        joints: where the arm is at first, (7,).
        sensor: the camera on the wrist.

    Attributes:
        joints: where the arm is, (7,) float64.
        motions: what it did so far, one for each time that it moved: the joints at the corners of
            its way.
        seconds: how long it has moved.
        refused: poses to which it found no way.
        lean: of the table and all on it in the arm's world, (4, 4): the error of its vertical.
        standing: how many things stand on the table.
        owner: thing that each pixel of the last frame truly shows, -1 for none, (H, W).
    """

    def __init__(
        self,
        things: Sequence[Triangles],
        rng: np.random.Generator,
        joints: Float = HOME,
        sensor: Sensor = SENSORS["stereo"],
    ) -> None:
        with extras():
            import mink
            import mujoco

        self.sensor = sensor
        self.joints = np.asarray(joints, float)
        self._rng = rng
        self.motions: list[list[Float]] = []
        self.seconds = 0.0
        self.refused = 0
        self._mujoco = mujoco
        self._mink = mink
        self.standing = len(things)
        self.owner = np.full(sensor.shape, -1)
        tilt = [*rng.spawn(1)[0].normal(0, sensor.tilt, 2), 0]
        self.lean = np.eye(4)
        self.lean[:3, :3] = Rotation.from_rotvec(tilt, degrees=True).as_matrix()
        self.model = _model(things)
        self.data = mujoco.MjData(self.model)
        self._site = self.model.site("camera").id
        # Turning the camera about its line of sight shows nothing new: that much the arm is free to
        # choose.
        self._aim = mink.FrameTask(
            "camera",
            "site",
            position_cost=1.0,
            orientation_cost=[0.3, 0.3, 0.0],
            lm_damping=1e-4,
        )
        self._rest = mink.PostureTask(self.model, cost=1e-3)
        self._rest.set_target(HOME)
        names = [self.model.joint(k).name for k in range(7)]
        limits = dict(zip(names, FASTEST, strict=True))
        self._limits = [
            mink.ConfigurationLimit(self.model),
            mink.VelocityLimit(self.model, limits),
        ]
        self._solved: dict[tuple[bytes, bytes], Float | None] = {}

    # Kinematics

    def camera_at(self, joints: Float) -> Float:
        """Where the camera is: camera-to-world, (4, 4), OpenCV axes, metres."""
        self._place(joints)
        pose = np.eye(4)
        pose[:3, :3] = self.data.site_xmat[self._site].reshape(3, 3)
        pose[:3, 3] = self.data.site_xpos[self._site]
        return pose

    @property
    def pose(self) -> Float:
        """Where the camera is now, (4, 4)."""
        return self.camera_at(self.joints)

    def _place(self, joints: Float) -> None:
        self.data.qpos[:] = joints
        self._mujoco.mj_kinematics(self.model, self.data)

    def touches(self, joints: Float) -> bool:
        """Whether the arm touches itself, or comes nearer than CLEARANCE to the table or the
        object's convex hull.
        """
        self._place(joints)
        self._mujoco.mj_collision(self.model, self.data)
        return self.data.ncon > 0

    def solve(self, pose: Float) -> Float | None:
        """Joints with which the camera stands at a pose, turned about its line of sight as suits
        the arm.

        Args:
            pose: camera-to-world, (4, 4).

        Returns:
            (7,), within the joint limits and without a collision; None if none are found, from
            where the arm is or from any of STARTS.
        """
        asked = pose.tobytes(), self.joints.tobytes()
        if asked not in self._solved:
            self._solved[asked] = self._solve(pose)
        return self._solved[asked]

    def _solve(self, pose: Float) -> Float | None:
        if np.linalg.norm(pose[:3, 3] - [0, 0, 0.333]) > LONGEST or pose[2, 3] < 0:
            return None
        for start in (self.joints, *STARTS):
            found = self.descend(pose, start)
            if found is not None and not self.touches(found):
                return found
        return None

    def descend(self, pose: Float, start: Float) -> Float | None:
        """Differential inverse kinematics from some joints; None if it does not arrive."""
        mink = self._mink
        arm = self._mink.Configuration(self.model, start)
        for _ in range(ITERATIONS):
            here = arm.get_transform_frame_to_world("camera", "site").as_matrix()
            tilt = np.linalg.norm(here[:3, 2] - pose[:3, 2])
            if np.linalg.norm(here[:3, 3] - pose[:3, 3]) < CLOSE and tilt < STRAIGHT:
                return arm.q.copy()
            target = pose.copy()
            target[:3, :3] = _turned_least(here[:3, :3], pose[:3, 2])
            self._aim.set_target(mink.SE3.from_matrix(target))
            try:
                velocity = mink.solve_ik(
                    arm,
                    [self._aim, self._rest],
                    0.2,
                    "daqp",
                    limits=self._limits,
                )
            except mink.NoSolutionFound:
                return None
            arm.integrate_inplace(velocity, 0.2)
        return None

    # What a session asks

    def can_reach(self, pose: Float) -> bool:
        """Whether there are joints for a pose, and a way to them."""
        return self.way(pose) is not None

    def way(self, pose: Float) -> list[Float] | None:
        """The joints at the corners of a way from here to a pose: straight in joint space, or by
        HOME; None if both are blocked."""
        end = self.solve(pose)
        if end is None:
            return None
        ways = ([self.joints, end], [self.joints, HOME, end])
        return next(
            (
                way
                for way in ways
                if not any(self.touches(joints) for joints in along(way, FINE))
            ),
            None,
        )

    def travel_cost(self, here: Float, there: Float) -> float:
        """Seconds from where the arm is to a pose; infinity where there is no way."""
        way = self.way(there)
        return np.inf if way is None else seconds_of(way)

    # What a robot does

    def go_to(self, pose: Float) -> bool:
        """Move the camera to a pose. False, and nothing moves, where there is no way."""
        way = self.way(pose)
        if way is None:
            self.refused += 1
            return False
        self.motions.append(way)
        self.seconds += seconds_of(way)
        self.joints = way[-1]
        return True

    def look(self, itself: bool = True) -> Frame:
        """What the camera on the wrist gives, with the errors of the sensor and of its setup.

        Args:
            itself: whether the arm's own links are left in the picture, or taken out of it, as
                robots do who know where their links are.
        """
        rng = self._rng.spawn(1)[0]
        pose = self.pose
        true = pose.copy()
        turn = Rotation.from_rotvec(rng.normal(0, self.sensor.turned, 3), degrees=True)
        true[:3, :3] = pose[:3, :3] @ turn.as_matrix()
        true[:3, 3] += rng.normal(0, self.sensor.moved, 3)

        (height, width), k = self.sensor.shape, self.sensor.intrinsics
        seen = [triangles for triangles, _ in self.things()]
        for row in range(1 + self.standing):
            seen[row] = seen[row][0] @ self.lean[:3, :3].T, seen[row][1]
        rays = PinholeCamera.of(k, (height, width)).rays.reshape(-1, 3) @ true[:3, :3].T
        depth, owner = RayCaster(seen).cast(true[:3, 3], rays)
        depth = np.where(depth < self.sensor.farthest, depth, 0).astype(np.float32)
        measured, source = self.sensor.measure(depth.reshape(height, width), self._rng)
        # the table comes first, and the links come last
        if not itself:
            links = (owner > self.standing)[np.maximum(source, 0)] & (source >= 0)
            measured[ndimage.binary_dilation(links, iterations=AROUND_LINKS)] = 0
        owner = np.where((owner > 0) & (owner <= self.standing), owner - 1, -1)
        self.owner = np.where(source >= 0, owner[np.maximum(source, 0)], -1)
        return Frame(measured, k, pose, pixel_centre=0.5)

    def things(self) -> list[tuple[Triangles, Float]]:
        """All that can be seen, with the arm as it is: vertices (N, 3), metres, faces (F, 3),
        and colour (3,). The table comes first, then the things on it, then the arm.
        """
        self._place(self.joints)
        model = self.model
        data = self.data
        found = []
        for k in range(model.ngeom):
            if model.geom_group[k] != 3:  # those are hulls, for collisions
                vertices, faces = _triangles(model, k, self._mujoco)
                placed = (
                    vertices @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k]
                )
                found.append(((placed, faces), model.geom_rgba[k, :3].astype(float)))
        return found

    def run(
        self,
        session: Session,
        looked: Callable[[], None] = lambda: None,
        costs: bool = True,
    ) -> Recognition:
        """Go on with a session to its end: look, and move to where it asks, if there is a way.

        Args:
            session: for frames.
            looked: is called after each view that the session has taken in.
            costs: tell the session what moves cost; else it counts them in grid cells.

        Raises:
            ObservationError: the object is not found in the very first frame.
        """
        session.reachable = self.can_reach
        session.travel_cost = self.travel_cost if costs else None
        session.update(self.look())
        looked()
        while not session.done:
            try:
                if self.go_to(session.target):
                    session.update(self.look())
                    looked()
                else:
                    session.failed()
            except ObservationError:
                session.failed()
        return session.result


def first_joints(
    arm: Arm,
    elevation: float,
    azimuth: float,
    distance: float,
) -> Float | None:
    """Joints with which the camera looks at the middle of ``OBJECT`` from some angles, radians,
    and metres; or None.
    """
    pose = look_at_origin(elevation, azimuth, distance)
    pose[:3, 3] += [*OBJECT, 0.08]
    return arm.solve(pose)


def seconds_of(way: Sequence[Float]) -> float:
    """How long a way in joint space takes at the joints' velocity limits: on each leg the
    slowest joint counts.
    """
    return float(sum((np.abs(b - a) / FASTEST).max() for a, b in pairwise(way)))


def along(way: Sequence[Float], step: float) -> list[Float]:
    """Joints along a way, no joint farther apart than a step, radians; with its first and its
    last.
    """
    found = [way[0]]
    for a, b in pairwise(way):
        n = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        found += [a + (b - a) * k / n for k in range(1, n + 1)]
    return found


def _turned_least(rotation: Float, forward: Float) -> Float:
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


def _triangles(model: Any, geom: int, mujoco: Any) -> Triangles:
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
