"""The ways in which an object is likely to lie on a plane."""

import logging
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.spatial import QhullError, cKDTree
from scipy.spatial.transform import Rotation

from nextview.checks import check_extras
from nextview.geometry.mesh import Mesh
from nextview.geometry.viewsphere import Directions
from nextview.types import Float

LIKELY_POSE = 0.1  # resting poses less likely than this are left out
MOST_RESTING_POSES = 4  # and all but so many, the mesh's own among them
# resting poses whose directions up are within this angle are one
SAME_TILT = np.radians(20)
# this share of the throws, those into the rarest poses, is not looked at
RARE_REST = 0.05
# thickness, object radii, below which an object is a sheet: it has two sides and no convex hull
FLAT_SHEET = 1e-4

# Of the comparison of an object with itself, turned. Distances are in object radii.
RESTING_POINTS = 20_000
COMPARED_POINTS = 150
COMPARED_TURNS = np.radians(np.arange(0, 360, 10))[:, None]
FITTING_ROUNDS = 10
SAME_SURFACE = 0.04  # root mean square distance from one surface to the other


_DIRECTIONS = np.concatenate([half := Directions.fibonacci(250).directions, -half])
_log = logging.getLogger("nextview")


@dataclass
class _Pose:
    """A kind of resting pose: one direction that points up in it, and its share of all throws."""

    up: Float
    share: float = 0.0


@dataclass(frozen=True, eq=False)
class StablePoses:
    """All poses in which an object can rest on a plane.

    Attributes:
        rotations: from the mesh's own axes into the poses, (P, 3, 3) float64.
        shares: of all throws that end in each, (P,) float64, their sum is 1.
    """

    rotations: Float
    shares: Float


def stable_poses(mesh: Mesh) -> StablePoses:
    """Find all poses in which a mesh rests on a face of its convex hull, however rarely.

    Args:
        mesh: the object.

    Returns:
        The poses in no order, none among them left out or joined, and their shares of the throws.
        Without a convex hull only the mesh's own pose.
    """
    ups, shares = _stable_poses(mesh)
    if not len(ups):
        return StablePoses(np.eye(3)[None], np.ones(1))
    return StablePoses(np.stack([_upright(up) for up in ups]), shares / shares.sum())


def resting_poses(mesh: Mesh) -> Float:
    """Find the poses in which a mesh is likely to rest.

    A dropped object rests on a face of its convex hull, the likelier the larger it looks from the
    centre of mass (Goldberg et al., "Part pose statistics", IJRR 1999, as in trimesh). The mesh's
    own pose is always among them. Poses that look alike are one, and their shares of the throws are
    added: a can lies on its side in one way, whichever part of the side is down, and a ball has one
    pose.

    Args:
        mesh: the object.

    Returns:
        Rotations from the mesh's own axes, (P, 3, 3) float64, the likeliest first after the
        identity: at most MOST_RESTING_POSES, each but the first of at least LIKELY_POSE of the
        throws. ``stable_poses`` has all others.
    """
    ups, shares = _stable_poses(mesh)
    own, *others = _distinct_poses(mesh, ups, shares)

    likely = [pose for pose in others if pose.share >= LIKELY_POSE]
    likely.sort(key=lambda pose: -pose.share)
    kept = [own, *likely[: MOST_RESTING_POSES - 1]]
    return np.stack([_upright(pose.up) for pose in kept])


def _stable_poses(mesh: Mesh) -> tuple[Float, Float]:
    """Return the up directions of all stable poses, (N, 3), and their shares of throws, (N,)."""
    from trimesh import Trimesh
    from trimesh.poses import compute_stable_poses

    check_extras("teach")  # networkx, which trimesh imports only when it is asked

    axes = np.linalg.eigh(np.cov(mesh.vertices.T))[1].T
    normal = axes[0]  # of the plane that is nearest to all vertices
    if np.ptp(mesh.vertices @ normal) < FLAT_SHEET:
        return np.stack([normal, -normal]), np.array([0.5, 0.5])

    # The outermost vertices in many directions are enough of the hull, and a fine mesh takes no
    # minute.
    directions = np.concatenate([_DIRECTIONS, axes, -axes])
    outer = np.unique((directions @ mesh.vertices.T).argmax(1))
    try:
        hull = Trimesh(mesh.vertices[outer]).convex_hull
    except QhullError as error:
        reason = str(error).partition("\n")[0]
        _log.warning(
            "%s: has no convex hull (%s); it is taken to lie only as in its file",
            mesh.name,
            reason,
        )
        return np.zeros((0, 3)), np.zeros(0)

    transforms, shares = compute_stable_poses(hull, n_samples=1)
    return transforms[:, 2, :3], shares


def _distinct_poses(mesh: Mesh, ups: Float, shares: Float) -> list[_Pose]:
    """Kinds of poses that do not look alike: the mesh's own first, then in no particular order."""
    compared = _SelfComparison.of(mesh)
    near = ups @ ups.T > np.cos(SAME_TILT)
    poses = [_Pose(np.array([0.0, 0.0, 1.0]))]

    left = ups[:, 2] <= np.cos(SAME_TILT)
    poses[0].share = float(shares[~left].sum())
    while shares[left].sum() > RARE_REST:
        together = np.where(left, near @ (shares * left), 0)
        at = int(together.argmax())
        alike = [pose for pose in poses if compared.look_alike(pose.up, ups[at])]
        if not alike:
            alike = [_Pose(ups[at])]
            poses += alike
        alike[0].share += float(together[at])
        left &= ~near[at]
    return poses


@dataclass(frozen=True)
class _SelfComparison:
    """Compares an object in one pose with itself in another.

    Attributes:
        few: points on the surface, (COMPARED_POINTS, 3).
    """

    surface: cKDTree
    few: Float

    @classmethod
    def of(cls, mesh: Mesh) -> "_SelfComparison":
        rng = np.random.default_rng(0)
        surface = cKDTree(_points_on(mesh, RESTING_POINTS, rng))
        return cls(surface, _points_on(mesh, COMPARED_POINTS, rng))

    def look_alike(self, first_up: Float, second_up: Float) -> bool:
        """Return whether a rotation about the vertical maps one resting pose onto the other.

        The best of many rotations is refined by iterative closest points (Besl and McKay, PAMI
        1992).

        Args:
            first_up: direction that points up in the first pose, (3,), mesh axes.
            second_up: direction that points up in the second pose, (3,), mesh axes.

        Returns:
            True if the poses look alike.
        """
        about_vertical = Rotation.from_euler("z", COMPARED_TURNS).as_matrix()
        turns = _upright(second_up).T @ about_vertical @ _upright(first_up)
        moved = self.few @ turns.transpose(0, 2, 1)
        apart = np.asarray(self.surface.query(moved)[0])
        best = (apart**2).mean(1).argmin()
        turn = turns[best]
        points = moved[best]

        for _ in range(FITTING_ROUNDS):
            nearest = self.surface.data[self.surface.query(points)[1]]
            centre = points.mean(0)
            target = nearest.mean(0)
            closer = _best_rotation(points - centre, nearest - target)
            points = (points - centre) @ closer.T + target
            turn = closer @ turn

        apart = np.asarray(self.surface.query(points)[0])
        fits = np.sqrt((apart**2).mean()) < SAME_SURFACE
        return bool(fits and turn @ first_up @ second_up > np.cos(SAME_TILT))


def _points_on(mesh: Mesh, count: int, rng: Generator) -> Float:
    """Points drawn evenly over the surface, (count, 3)."""
    corners = mesh.vertices[mesh.faces]
    sides = corners[:, 1:] - corners[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    face = rng.choice(len(areas), count, p=areas / areas.sum())

    along = rng.random((count, 2, 1))
    outside = along.sum(1) > 1
    along = np.where(outside[:, None], 1 - along, along)
    return corners[face, 0] + (along * sides[face]).sum(1)


def _best_rotation(points: Float, targets: Float) -> Float:
    """Return the rotation, (3, 3), that maps points closest to targets (Kabsch, 1976).

    Both are centred, (N, 3).
    """
    left, _, right = np.linalg.svd(points.T @ targets)
    no_mirror = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    return (left @ no_mirror @ right).T


def _upright(up: Float) -> Float:
    """The shortest rotation that takes a direction to +z, (3, 3)."""
    axis = np.cross(up, (0, 0, 1))
    length = np.linalg.norm(axis)
    if length < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / length * np.arctan2(length, up[2])).as_matrix()


def rotated(mesh: Mesh, rotation: Float) -> Mesh:
    """Turn a mesh about its centre, and bring it into the object frame anew.

    Args:
        mesh: the object.
        rotation: (3, 3) float64.

    Returns:
        The mesh in its new pose, of the same size and unit.
    """
    return mesh.reshaped(mesh.vertices @ rotation.T)
