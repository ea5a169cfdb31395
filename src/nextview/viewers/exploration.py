"""The state of the explorer: an object, one or two walks, and the values of their policies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nextview.checks import whole
from nextview.data.folders import list_dataset
from nextview.data.samples import SAMPLE_MESHES, sample_mesh
from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.viewsphere import level_pose
from nextview.recognition.belief import FixedLength
from nextview.sensing.observation import Camera, Observation
from nextview.session.session import Session
from nextview.session.system import System, load, simulated
from nextview.session.view import View
from nextview.types import Float, Float32
from nextview.views.expected_views import RivalPictures


@dataclass(frozen=True)
class ShownObject:
    """An object that can be opened by name.

    Attributes:
        name: of the object.
        open: reads the mesh, or returns a camera of the stored views.
        label: true class; None if it is not known.
    """

    name: str
    open: Callable[[], Mesh | Camera]
    label: str | None = None


def shown_objects(
    path: Path | None = None,
    up: str | None = None,
    unit: str | None = None,
) -> tuple[ShownObject, ...]:
    """List the objects of a path.

    Args:
        path: mesh file or folder of meshes; None for the samples.
        up: up axis of the mesh files; None for that of their format.
        unit: of the mesh files; None if it is not known.

    Returns:
        The objects, in order.

    Raises:
        DatasetError: there is no object.
    """
    if path is None:
        return tuple(
            ShownObject(name, partial(sample_mesh, name), name)
            for name in SAMPLE_MESHES
        )
    if not path.is_dir():
        return (ShownObject(path.stem, partial(load_mesh, path, up, unit)),)
    # A single mesh outside class folders has no label.
    return tuple(
        ShownObject(
            entry.name,
            partial(load_mesh, entry.path, up, unit),
            entry.label if "CLASS" in entry.layout else None,
        )
        for entry in list_dataset(path, loose=True)
    )


class Walk:
    """The views of an object so far, and the beliefs after them.

    In contrast to an episode, it ends only after all views.
    """

    def __init__(
        self,
        system: System,
        camera: Camera,
        start: int,
        seed: int = 0,
    ) -> None:
        self.system = system
        self.camera = camera
        self.start = start
        self.seed = seed
        self.sphere = system.sphere
        self.stopping = system.stopping
        self.session: Session = replace(
            system,
            stopping=FixedLength(max_views=len(system.sphere)),
        ).session(start, seed)

    @property
    def views(self) -> list[View]:
        """Views in order."""
        return self.session.views

    @property
    def stopped(self) -> bool:
        """True if the stopping rule would have ended the walk."""
        if not self.views:
            return False
        seen = np.array([view.observation.seen for view in self.views])
        beliefs = np.stack([view.belief for view in self.views])
        reached = self.stopping.reached_along(beliefs, np.maximum(seen.cumsum(), 1))
        return (
            bool((reached & seen).any()) or len(self.views) >= self.stopping.max_views
        )

    @property
    def next_view(self) -> int | None:
        """Next view according to the policy; None after all views."""
        return None if self.session.done else self.session.view

    @property
    def values(self) -> Float | None:
        """Values of the views, (V,), NaN if not considered; None before the first view."""
        return self.views[-1].values if self.views else None

    def rival_pictures(self, direction: Float) -> RivalPictures | None:
        """Render the two leading hypotheses from a direction, (3,).

        Returns:
            Images in the estimated poses, with the pixels in which they differ; None if the
            geometry is not known, or there is only one hypothesis.
        """
        outlook = self.session.outlook
        return (
            None
            if outlook is None
            else outlook.rivals(outlook.cameras(direction[None])[0])
        )

    @property
    def visited(self) -> list[int]:
        """Candidate views that were taken, or that are nearest to a pose that was taken."""
        return [view.index for view in self.views]

    @property
    def points(self) -> Float32:
        """All observed points so far, (N, 3), object frame, object radii."""
        seen = [view.observation.points for view in self.views if view.observation.seen]
        return np.concatenate([np.zeros((0, 3), np.float32), *seen])

    def look(self, where: int | Float) -> View:
        """Take a view: from a candidate viewpoint, or from a pose, (4, 4), object frame."""
        if self.session.done:
            raise UsageError("every candidate view was taken: start over")
        return self.session.update(
            self.camera.observe(
                self.sphere.poses[where] if isinstance(where, int) else where
            )
        )

    def step(self) -> View:
        """Take the next view according to the policy."""
        return self.look(self.session.view)

    def with_policy_of(self, system: System) -> "Walk":
        """Return a walk with the same views under another policy."""
        other = Walk(system, self.camera, self.start, self.seed)
        for view in self.views:
            other.session.update(view.observation)
        return other


class Exploration:
    """A list of objects, the camera of the current one, and a walk for each of one or two policies.

    Options are those of ``nextview.load``.
    """

    def __init__(
        self,
        objects: Sequence[ShownObject],
        policies: Sequence[str | None] = (None,),
        sensor: str | None = None,
        start: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        whole(seed, "the seed", most=2**63 - 1)
        self.objects = {shown.name: shown for shown in objects}
        self.sensor = sensor
        self.seed = seed
        self._load = lru_cache(maxsize=None)(
            lambda policy: load(policy=policy, **options)
        )
        self.systems: list[System] = [self._load(policy) for policy in policies]
        views = len(self.systems[0].sphere)
        drawn = int(np.random.default_rng(seed).integers(views))
        self.start = (
            drawn if start is None else whole(start, "the first view", 0, views - 1)
        )
        self.show(objects[0].name)

    @property
    def policies(self) -> list[str]:
        """Names of the compared policies."""
        return [system.policy_name for system in self.systems]

    @property
    def mesh(self) -> Mesh | None:
        """Mesh of the object; None if there are only stored views."""
        return self._opened if isinstance(self._opened, Mesh) else None

    def show(self, name: str) -> None:
        """Select another object, and start over."""
        self._begin(self.objects[name], self.objects[name].open(), self.sensor)

    def use_sensor(self, sensor: str | None) -> None:
        """Select another sensor, and start over."""
        self._begin(self.shown, self._opened, sensor)

    def restart(self) -> None:
        """Forget all views; the errors of the sensor are repeated."""
        self.use_sensor(self.sensor)

    def _begin(
        self,
        shown: ShownObject,
        opened: Mesh | Camera,
        sensor: str | None,
    ) -> None:
        if sensor is not None and not isinstance(opened, Mesh):
            raise UsageError(
                f"{shown.name} has only stored views: no sensor can look at it"
            )
        walks = [
            Walk(system, self._camera(opened, sensor), self.start, self.seed)
            for system in self.systems
        ]
        self.shown = shown
        self._opened = opened
        self.sensor = sensor
        self.walks = walks

    def _camera(self, opened: Mesh | Camera, sensor: str | None = None) -> Camera:
        return (
            simulated(opened, sensor, self.seed) if isinstance(opened, Mesh) else opened
        )

    def compare(self, policies: Sequence[str | None]) -> None:
        """Use one policy, or two side by side; policies used before keep their views."""
        systems = [self._load(policy) for policy in policies]
        walks = [
            self.walks[min(k, len(self.walks) - 1)].with_policy_of(system)
            for k, system in enumerate(systems)
        ]
        self.systems = systems
        self.walks = walks

    def step(self) -> None:
        """Let each policy take its next view, if there is one."""
        for walk in self.walks:
            if not walk.session.done:
                walk.step()

    def walk_on(self) -> bool:
        """Let each policy that has not stopped take its next view. Returns True if any did."""
        walks = [
            walk for walk in self.walks if not walk.stopped and not walk.session.done
        ]
        for walk in walks:
            walk.step()
        return bool(walks)

    def preview(self, where: Float) -> Observation:
        """Render a noise-free observation from a position, (3,), object radii."""
        return self._camera(self._opened).observe(self.pose_towards(where))

    def pose_towards(self, position: Float) -> Float:
        """Return a level pose, (4, 4), in the direction of a position, at the usual distance."""
        length = np.linalg.norm(position)
        return level_pose(
            position / length if length > 0 else np.array([1.0, 0, 0]),
            self.walks[0].sphere.distance,
        )
