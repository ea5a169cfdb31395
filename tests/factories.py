"""Simulated tables with a few things of the bundled memory, and views of them."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.geometry.mesh import Mesh
from nextview.geometry.resting import resting_poses
from nextview.simulation.sensor import SENSORS
from nextview.things.memory import taught_meshes
from nextview_lab.worlds.tables import (
    PlacedThing,
    SimulatedTable,
    TableCamera,
    poses_around,
)

CENTRE = np.array([0, 0, 0.03])


def meshes_of(names: Sequence[str]) -> dict[str, Mesh]:
    """Surfaces of the bundled memory, by name."""
    return dict(zip(names, taught_meshes("ycb", names), strict=True))


_RESTING: dict[tuple[bytes, bytes], np.ndarray] = {}


def resting_of(mesh: Mesh) -> np.ndarray:
    """Its resting poses, found once for all tables."""
    key = mesh.vertices.tobytes(), mesh.faces.tobytes()
    if key not in _RESTING:
        _RESTING[key] = resting_poses(mesh)
    return _RESTING[key]


def camera_over(
    meshes: Sequence[Mesh],
    seed: int = 5,
    sensor: str = "stereo",
    gap: float = 0.08,
) -> TableCamera:
    """A camera over a table on which some things are put down at random."""
    rng = np.random.default_rng(seed)
    table = SimulatedTable.draw(meshes, rng, gap, resting_of)
    return TableCamera(table, SENSORS[sensor], rng)


def leaning(mesh: Mesh, degrees: float, place: Sequence[float]) -> PlacedThing:
    """A thing that touches the table at (x, y) around its middle, tilted about the y axis."""
    metres = mesh.vertices * mesh.radius + mesh.centre
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    turned = metres @ pose[:3, :3].T
    middle = (turned.min(0) + turned.max(0)) / 2
    pose[:3, 3] = place[0] - middle[0], place[1] - middle[1], -turned[:, 2].min()
    return PlacedThing(mesh.name, metres, mesh.faces, pose)


def view(degrees: float, elevation: float = 50.0, distance: float = 0.65) -> np.ndarray:
    """The pose of a camera that looks at the table's centre, (4, 4)."""
    return poses_around(np.radians([degrees]), np.radians(elevation), distance, CENTRE)[
        0
    ]


def without(table: SimulatedTable, name: str) -> SimulatedTable:
    """The same table after a thing was taken away."""
    return SimulatedTable(tuple(thing for thing in table.things if thing.name != name))
