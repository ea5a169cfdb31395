"""What is explored, without any page: an object, one or two walks around it, and what their policies value."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import whole
from nextview.belief import FixedLength, Stopping
from nextview.errors import NextviewError, UsageError
from nextview.explorer.shown_object import ShownObject
from nextview.mesh import Mesh
from nextview.observation import Camera, Observation
from nextview.session import Session, View
from nextview.system import System, load, simulated
from nextview.viewsphere import Viewpoints, level_pose, look_at_origin

Float = NDArray[np.float64]


class Walk:
    """The views that were taken of an object, by hand or by a policy, and what is believed after them.

    It goes on as long as there are views: where the stopping rule would end it is told, and nothing more.

    Args:
        system: recogniser, policy, viewpoints and stopping rule.
        camera: looks at the object.
        start: where a policy looks first.
        seed: decides what the policy draws.
    """

    def __init__(self, system: System, camera: Camera, start: int, seed: int = 0) -> None:
        self.system, self.camera, self.start, self.seed = system, camera, start, seed
        endless = FixedLength(max_views=len(system.sphere))
        self.session: Session = replace(system, stopping=endless).session(start, seed)

    @property
    def views(self) -> list[View]:
        """Those taken, in order."""
        return self.session.views

    @property
    def sphere(self) -> Viewpoints:
        """The candidate viewpoints."""
        return self.session.sphere

    @property
    def stopping(self) -> Stopping:
        """The rule that would end it."""
        return self.system.stopping

    @property
    def stopped(self) -> bool:
        """Whether the stopping rule would have ended it by now."""
        counted = 0
        for view in self.views:
            counted += view.observation.seen
            if view.observation.seen and view.belief.max() >= self.stopping.threshold_at(counted):
                return True
        return len(self.views) >= self.stopping.max_views

    @property
    def next_view(self) -> int | None:
        """Where the policy looks next; None where all views were taken."""
        return None if self.session.done else self.session.view

    @property
    def values(self) -> Float | None:
        """What the policy values each view at, (V,), NaN for those not considered; None if it values nothing yet."""
        return self.views[-1].values if self.views else None

    @property
    def visited(self) -> list[int]:
        """The candidate views from which, or from near which, it was looked."""
        return [view.index for view in self.views]

    @property
    def points(self) -> NDArray[np.float32]:
        """All that was seen so far, (N, 3), object frame, object radii."""
        seen = [view.observation.points for view in self.views if view.observation.seen]
        return np.concatenate([np.zeros((0, 3), np.float32), *seen])

    def look(self, where: int | Float) -> View:
        """Take a view: from a candidate viewpoint, or from a pose, (4, 4), object frame.

        Raises:
            UsageError: all views were taken.
        """
        if self.session.done:
            raise UsageError("every candidate view was taken: start over")
        pose = self.sphere.poses[where] if isinstance(where, int) else where
        return self.session.update(self.camera.observe(pose))

    def step(self) -> View:
        """Take the view that the policy asks for."""
        return self.look(self.session.view)

    def with_policy_of(self, system: System) -> Walk:
        """The same views under another policy: what would it do now?"""
        other = Walk(system, self.camera, self.start, self.seed)
        for view in self.views:
            other.session.update(view.observation)
        return other


class Exploration:
    """An object among some, a camera before it, and one walk for each policy that is compared.

    Args:
        objects: to choose from; the first is shown.
        policies: one or two, as ``nextview.load`` takes them.
        sensor: the camera's sensor, as ``nextview.recognise`` takes it; None for clean renders.
        start: where policies look first; drawn by the seed if not given.
        seed: decides the first view, what policies draw and the errors of the sensor.
        options: of ``nextview.load``, but for the policy.

    Raises:
        UsageError: there is no such sensor, or the object has only stored views and no sensor can look at it; or the
            seed or the first view is none.
        NextviewError: the object or the models cannot be opened.
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
        self.objects, self.sensor, self.seed = {shown.name: shown for shown in objects}, sensor, seed
        self._load = lru_cache(maxsize=None)(lambda policy: load(policy=policy, **options))
        self.systems: list[System] = [self._load(policy) for policy in policies]
        views = len(self.systems[0].sphere)
        drawn = int(np.random.default_rng(seed).integers(views))
        self.start = drawn if start is None else whole(start, "the first view", 0, views - 1)
        self.show(objects[0].name)

    @property
    def policies(self) -> list[str]:
        """Names of the policies that are compared."""
        return [system.policy_name for system in self.systems]

    @property
    def mesh(self) -> Mesh | None:
        """The object; None if there are only pictures of it."""
        return self._opened if isinstance(self._opened, Mesh) else None

    def show(self, name: str) -> None:
        """Go to another object, and start over."""
        self._begin(self.objects[name], self.objects[name].open(), self.sensor)

    def use_sensor(self, sensor: str | None) -> None:
        """Look through another sensor, and start over."""
        self._begin(self.shown, self._opened, sensor)

    def restart(self) -> None:
        """Forget all views; a sensor errs anew in the same way."""
        self._begin(self.shown, self._opened, self.sensor)

    def _begin(self, shown: ShownObject, opened: Mesh | Camera, sensor: str | None) -> None:
        if sensor is not None and not isinstance(opened, Mesh):
            raise UsageError(f"{shown.name} has only stored views: no sensor can look at it")
        cameras = [simulated(opened, sensor, self.seed) if isinstance(opened, Mesh) else opened for _ in self.systems]
        walks = [
            Walk(system, camera, self.start, self.seed) for system, camera in zip(self.systems, cameras, strict=True)
        ]
        self.shown, self._opened, self.sensor, self.walks = shown, opened, sensor, walks

    def compare(self, policies: Sequence[str | None]) -> None:
        """Use one policy, or two side by side; those that walked before keep their views."""
        systems = [self._load(policy) for policy in policies]
        walks = [self.walks[min(k, len(self.walks) - 1)].with_policy_of(system) for k, system in enumerate(systems)]
        self.systems, self.walks = systems, walks

    def step(self) -> None:
        """Let each policy take its next view, if there is one."""
        for walk in self.walks:
            if not walk.session.done:
                walk.step()

    def walk_on(self) -> bool:
        """Let each policy that has not stopped take its next view. Returns whether any did."""
        going = [walk for walk in self.walks if not walk.stopped and not walk.session.done]
        for walk in going:
            walk.step()
        return bool(going)

    def pictures(self) -> dict[str, NDArray[np.uint8]]:
        """Each object by name as seen from 20 degrees up, (H, W) uint8; without those that cannot be opened."""
        found = {}
        for name, shown in self.objects.items():
            with suppress(NextviewError):  # it is said when the object is chosen
                opened = shown.open()
                camera = simulated(opened) if isinstance(opened, Mesh) else opened
                found[name] = camera.observe(look_at_origin(np.radians(20), np.radians(40))).picture
        return found

    def preview(self, where: Float) -> Observation:
        """What would be seen from a position, (3,), object radii, without noise; nothing is taken."""
        pose = self.pose_towards(where)
        return (simulated(self.mesh) if self.mesh is not None else self.walks[0].camera).observe(pose)

    def pose_towards(self, position: Float) -> Float:
        """A level pose, (4, 4), in the direction of a position, (3,), as far away as the candidate views are."""
        length = np.linalg.norm(position)
        outward = position / length if length > 0 else np.array([1.0, 0, 0])
        return level_pose(outward, self.walks[0].sphere.distance)
