"""The ways in which an object is likely to lie on a plane."""

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.viewsphere import Directions

LIKELY, MOST = 0.1, 3  # resting poses less likely than this are left out, and all but so many
SAME_TILT = np.radians(20)  # resting poses whose directions up are within this angle are one
_DIRECTIONS = np.concatenate([half := Directions.fibonacci(250).directions, -half])


def resting_poses(mesh: Mesh) -> NDArray[np.float64]:
    """Rotations from a mesh's own axes into its likely resting poses, (P, 3, 3) float64; the first is the identity.

    A dropped object rests on a face of its convex hull, the likelier the larger it looks from the centre of mass
    (Goldberg et al., "Part pose statistics", IJRR 1999, as in trimesh). The mesh's own pose is always among them.
    """
    from trimesh import Trimesh
    from trimesh.poses import compute_stable_poses

    # The outermost vertices in many directions are enough of the hull, and a fine mesh takes no minute.
    outer = np.unique((_DIRECTIONS @ mesh.vertices.T).argmax(1))
    try:
        hull = Trimesh(mesh.vertices[outer]).convex_hull
        transforms, likely = compute_stable_poses(hull, n_samples=1, threshold=LIKELY / 20)
    except Exception:  # qhull and trimesh raise whatever a flat mesh leads to: it lies as it is
        likely = np.zeros(0)
    if not len(likely):
        return np.eye(3)[None]
    ups = transforms[:, 2, :3]  # the directions, in the mesh's axes, that come to point up
    near = ups @ ups.T > np.cos(SAME_TILT)
    chosen = [np.array([0.0, 0.0, 1.0])]
    for at in np.argsort(-likely, kind="stable"):
        alone = all(ups[at] @ other < np.cos(SAME_TILT) for other in chosen)
        if alone and likely[near[at]].sum() >= LIKELY and len(chosen) < MOST:
            chosen.append(ups[at])
    return np.stack([_upright(up) for up in chosen])


def _upright(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shortest rotation that takes a direction to +z, (3, 3)."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, (0, 0, 1))
    length = np.linalg.norm(axis)
    if length < 1e-9:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / length * np.arctan2(length, up[2])).as_matrix()


def rotated(mesh: Mesh, rotation: NDArray[np.float64]) -> Mesh:
    """The mesh turned about its centre, brought into the object frame anew."""
    return make_mesh(mesh.vertices @ rotation.T * mesh.radius, mesh.faces, mesh.name, mesh.unit)
