"""Episodes with taught things, with cached views and verifications.

An episode is a thing at its true size on a table, alone or half hidden by boxes, in front of a
sensor with its own errors. Every view is simulated once, its features are computed once, and every
set of views is verified once, exactly as in ``Session``. All results are kept in a folder per
episode, so that another policy can be replayed without simulating anything again.
"""

import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ResultsError, UsageError
from nextview.files import new_file
from nextview.geometry.mesh import Mesh
from nextview.geometry.observation import Observation, SceneView
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import ViewSphere, rotation_z
from nextview.policies.base import EpisodeState
from nextview.recognition.evidence import Evidence
from nextview.recognition.protocol import log_evidence_of_views
from nextview.simulation.boxes import boxes_around
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.expected_views import Outlook
from nextview.things.memory import TaughtRecogniser
from nextview.things.surface import Surface
from nextview.types import Float
from nextview_lab.benchmark.known_things import Answer, KnownThings
from nextview_lab.benchmark.pose_recall import add_s

Occlusion = Literal["none", "half", "heavy"]

EPISODE_SPHERE = ViewSphere.named("40")
NEAREST_SURFACE = 0.25  # metres, least distance between the camera and the surface
USUAL_DISTANCE = 0.45  # metres, largest distance between the camera and the centre
RADII_AWAY = (
    5.0  # distance of the camera from the centre, object radii, within these limits
)
# ranges of the visible share, averaged over the viewpoints
VISIBLE_SHARES = {"half": (0.45, 0.65), "heavy": (0.25, 0.45)}
FEWEST_BOXES = 3  # around a thing that is partly hidden
MOST_BOXES = 40
BOX_LAYOUTS_TRIED = 60  # layouts of boxes, after which the closest one is used
SHARE_SIDE = 24  # rows and columns of the images that measure a visible share
SHARE_EVERY = 3  # step between the viewpoints that measure it
POSE_ERROR_POINTS = 500  # sampled points of a surface for the pose error


@dataclass(frozen=True)
class Setting:
    """Conditions of the episodes.

    Attributes:
        sensor: NAME or NAME:STRENGTH of the sensor.
        occlusion: "none" shows things alone, "half" and "heavy" among boxes that leave about half
            and a third of them visible, averaged over the viewpoints.
        seed: of the rotation and surroundings of each thing, the first view, and the sensor errors.
    """

    sensor: str = "wrist"
    occlusion: Occlusion = "none"
    seed: int = 0


class ThingEpisode:
    """A thing that can be observed from all viewpoints."""

    def __init__(
        self,
        things: KnownThings,
        mesh: Callable[[], Mesh],
        thing: int,
        draw: int,
        setting: Setting,
        folder: Path | None = None,
    ) -> None:
        """Set up the scene, or continue with cached results.

        Args:
            things: the hypotheses: a memory of taught things, or your own recogniser.
            mesh: returns the mesh of the thing, with a known unit; called only if a view must be
                simulated.
            thing: its number among the things.
            draw: number of the draw.
            setting: conditions of the episode.
            folder: of the cache; None for no cache. Results of your own recogniser are not cached,
                as it may change.
        """
        self.things = things
        self.thing = thing
        self._mesh = mesh
        self._seed = (setting.seed, thing, draw)
        self._setting = setting
        self._kept = KeptArrays(folder)
        own = things.memory is None
        self._answers = KeptArrays(None) if own else self._kept
        self._stage: _Stage | None = None
        self._views: dict[int, Observation] = {}
        self._verified: dict[frozenset[int], tuple[Answer, float]] = {}
        if "start" not in self._kept:
            self._kept["start"] = np.array(self._first_view())
        self.start = int(self._kept["start"])

    def save(self) -> None:
        """Write new results to the cache."""
        self._kept.save()

    @property
    def stage(self) -> "_Stage":
        """Simulated scene with the thing."""
        if self._stage is None:
            self._stage = _Stage.of(
                self._mesh(),
                self._setting,
                self._seed,
                self._kept,
            )
        return self._stage

    def _first_view(self) -> int:
        """Return a view in which the thing is visible."""
        rng = np.random.default_rng((*self._seed, 3))
        for view in rng.permutation(len(EPISODE_SPHERE)):
            if self.observation(int(view)).seen:
                return int(view)
        raise UsageError(f"{self.things.names[self.thing]}: shows from no viewpoint")

    def observation(self, view: int) -> Observation:
        """Return the observation from a viewpoint. Its noise depends only on the viewpoint."""
        if view not in self._views:
            if f"{view}.depth" not in self._kept:
                self._sense(view)
            self._views[view] = _observation(self._kept, view)
        return self._views[view]

    def _sense(self, view: int) -> None:
        """Simulate one view."""
        camera = self.stage.camera(view)
        observation = camera.observe(EPISODE_SPHERE.poses[view])
        for name, values in _arrays_of(observation).items():
            self._kept[f"{view}.{name}"] = values
        in_camera = np.full((4, 4), np.nan)
        if camera.true_pose is not None:
            in_camera = np.linalg.inv(camera.true_pose) @ self.stage.in_truth
        self._kept[f"{view}.in_camera"] = in_camera

    def seen(self, views: Sequence[int]) -> list[int]:
        """Return the views in which the thing is visible."""
        return [view for view in views if self.observation(view).seen]

    def verified(self, views: Sequence[int]) -> tuple[Answer, float]:
        """Return the verification of some views, and its CPU time in seconds."""
        used = frozenset(self.seen(views))
        if used not in self._verified:
            name = "-".join(map(str, sorted(used)))
            needed = {f.name: f"{name}.{f.name}" for f in fields(Answer)}
            # The cache of an earlier version is incomplete and outdated.
            if not all(
                one in self._answers for one in (*needed.values(), f"{name}.seconds")
            ):
                self._verify(name, sorted(used))
            parts = {part: self._answers[one] for part, one in needed.items()}
            self._verified[used] = (
                Answer(**parts),
                float(self._answers[f"{name}.seconds"]),
            )
        return self._verified[used]

    def _verify(self, name: str, views: list[int]) -> None:
        observations = [self.observation(view) for view in views]
        begun = time.process_time()
        found = self.things(observations)
        self._answers[f"{name}.seconds"] = np.array(time.process_time() - begun)
        for part, values in vars(found).items():
            self._answers[f"{name}.{part}"] = values

    def named_right(self, views: Sequence[int]) -> bool:
        """Return True if the thing is named correctly after some views."""
        return int(self.verified(views)[0].belief.argmax()) == self.thing

    def belief_in_truth(self, views: Sequence[int]) -> float:
        """Return the belief in the true thing after some views."""
        return float(self.verified(views)[0].belief[self.thing])

    def p_value(self, views: Sequence[int]) -> float | None:
        """Return the value of the test for unknown things; None if there is none."""
        value = float(self.verified(views)[0].p_value)
        return None if np.isnan(value) else value

    def pose_error(self, views: Sequence[int]) -> float | None:
        """Return the pose error (ADD-S) in the last view, millimetres.

        Returns:
            The mean distance of surface points in the estimated pose to the nearest points of the
            true surface; None if the thing is not named correctly.
        """
        found, _ = self.verified(views)
        rows = np.flatnonzero(found.things == self.thing)
        if int(found.belief.argmax()) != self.thing or not len(rows):
            return None

        seen = self.seen(views)
        scene = self.observation(seen[-1]).scene
        radius = self.observation(seen[-1]).radius
        assert scene is not None
        assert radius is not None
        camera = scene.pose.copy()
        camera[:3, 3] *= radius
        pose = found.poses[rows[0]]

        points = self._surface.sample(POSE_ERROR_POINTS, np.random.default_rng(0))
        true = self._kept[f"{seen[-1]}.in_camera"]
        return 1000 * add_s(points, np.linalg.inv(camera) @ pose, true)

    @cached_property
    def _surface(self) -> Surface:
        """Return the surface of the thing in the memory; without a memory, that of its file."""
        taught = self.things.surface(self.thing)
        if taught is not None:
            return taught
        return Surface.from_mesh(self._mesh(), self.things.names[self.thing])

    def state(self, views: Sequence[int], needs: Sequence[str]) -> EpisodeState:
        """Return the state of the episode for a policy.

        Args:
            views: in order.
            needs: inputs of the policy: "joint", "observations" and "outlook" are available.
        """
        seen = self.seen(views)
        recogniser = self.things.recogniser
        classes = len(recogniser.classes)
        visited = np.zeros((1, len(EPISODE_SPHERE)), bool)
        visited[0, list(views)] = True
        joint = None
        if "joint" in needs:
            assert isinstance(recogniser, TaughtRecogniser)  # see ``policies_of``
            views_seen = [self.observation(view) for view in seen]
            total = log_evidence_of_views(recogniser, views_seen).sum(0)
            here = EPISODE_SPHERE.azimuth[views[-1]]
            joint = recogniser.calibration.joint(total, len(seen), classes, here)[None]

        return EpisodeState(
            current=np.array([views[-1]]),
            visited=visited,
            belief=self.verified(views)[0].belief[None],
            evidence=Evidence(np.zeros((1, classes))),
            step=len(views),
            joint=joint,
            observations=[[self.observation(view) for view in views]],
            outlook=[self.outlook(views)] if "outlook" in needs else None,
        )

    def outlook(self, views: Sequence[int]) -> Outlook | None:
        """Return the prediction of further views for the choice of the next view."""
        return self.things.outlook(
            [self.observation(view) for view in self.seen(views)]
        )


@dataclass(frozen=True, eq=False)
class _Stage:
    """Simulated scene with a thing on its table.

    Attributes:
        standing: its mesh, rotated.
        around: the boxes around it; None for none.
        sensor: the simulated sensor.
        seed: of the sensor errors.
        in_truth: from the frame of the file to the true object frame, (4, 4), metres.
    """

    standing: Mesh
    around: Mesh | None
    sensor: Any
    seed: tuple[int, ...]
    in_truth: Float

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        setting: Setting,
        seed: tuple[int, ...],
        kept: "KeptArrays",
    ) -> "_Stage":
        """Rotate a thing, and draw its sensor and its surroundings.

        Args:
            mesh: the thing, with a known unit, so that its lengths are metres.
            setting: sensor, distance and occlusion.
            seed: of all random numbers of the episode.
            kept: cache of the boxes, which are slow to find.
        """
        rng = np.random.default_rng(seed)
        turn = rotation_z(rng.uniform(0, 2 * np.pi))
        standing = rotated(mesh, turn)
        radius = standing.metres
        assert radius is not None  # the unit of its file is known
        away = max(NEAREST_SURFACE + radius, min(USUAL_DISTANCE, RADII_AWAY * radius))
        drawn = sensor_named(setting.sensor).draw(rng)
        sensor = replace(drawn, radius=radius, distance=away, boxes=0.0)
        in_truth = np.eye(4)
        in_truth[:3, :3] = turn
        in_truth[:3, 3] = -(turn @ mesh.centre + standing.centre)
        around = None
        if setting.occlusion != "none":
            if "boxes.vertices" not in kept:
                share = VISIBLE_SHARES[setting.occlusion]
                found = hiding_boxes(standing, share, (*seed, 2))
                kept["boxes.vertices"] = found.vertices
                kept["boxes.faces"] = found.faces
            corners = kept["boxes.vertices"]
            around = Mesh(corners, kept["boxes.faces"], np.zeros(3), 1.0, "boxes")

        return cls(standing, around, sensor, (*seed, 7), in_truth)

    def camera(self, view: int) -> SensedCamera:
        """Return the camera, with the setup errors of the episode and the noise of one view."""
        rng = np.random.default_rng(self.seed)
        camera = SensedCamera(self.standing, self.sensor, rng, around=self.around)
        rng.spawn(view)
        return camera


def hiding_boxes(
    standing: Mesh,
    wanted: tuple[float, float],
    seed: tuple[int, ...],
) -> Mesh:
    """Place boxes around a thing so that a given share of it stays visible.

    Args:
        standing: the thing.
        wanted: least and largest visible share of its pixels, averaged over the viewpoints.
        seed: of the boxes.

    Returns:
        The first layout in this range, or else the closest one.
    """
    rng = np.random.default_rng(seed)
    poses = EPISODE_SPHERE.poses[::SHARE_EVERY]
    alone = SimulatedCamera(standing, SHARE_SIDE)
    own = [alone.observe(pose).depth for pose in poses]
    found: list[tuple[float, Mesh]] = []

    for _ in range(BOX_LAYOUTS_TRIED):
        boxes = boxes_around(
            standing.vertices,
            int(rng.integers(FEWEST_BOXES, MOST_BOXES + 1)),
            rng,
        )
        before = SimulatedCamera(boxes, SHARE_SIDE)
        shares = []
        for pose, depth in zip(poses, own, strict=True):
            boxed = before.observe(pose).depth
            shows = depth > 0
            hidden = shows & (boxed > 0) & (boxed < depth)
            shares.append(1 - hidden.sum() / max(1, shows.sum()))
        share = float(np.mean(shares))
        found.append((max(wanted[0] - share, share - wanted[1]), boxes))
        if found[-1][0] <= 0:
            break

    return min(found, key=lambda pair: pair[0])[1]


def _arrays_of(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return an observation as arrays; "scene" is empty if there is none."""
    scene = observation.scene
    radius = np.nan if observation.radius is None else observation.radius
    numbers = [
        observation.pose.ravel(),
        observation.intrinsics.ravel(),
        np.array([radius]),
    ]
    arrays: dict[str, NDArray[Any]] = {"depth": observation.depth}
    if scene is not None:
        free = np.array([float(scene.background_free)])
        numbers += [scene.pose.ravel(), scene.intrinsics.ravel(), free]
        arrays |= {"scene": scene.depth, "target": scene.target}
    return arrays | {"numbers": np.concatenate(numbers)}


def _observation(kept: "KeptArrays", view: int) -> Observation:
    """Restore an observation from arrays."""
    numbers = kept[f"{view}.numbers"]
    scene = None
    if f"{view}.scene" in kept:
        pose, intrinsics, (free,) = np.split(numbers[26:], (16, 25))
        scene = SceneView(
            kept[f"{view}.scene"],
            kept[f"{view}.target"],
            pose.reshape(4, 4),
            intrinsics.reshape(3, 3),
            bool(free),
        )
    pose, intrinsics, (radius,) = np.split(numbers[:26], (16, 25))

    return Observation(
        kept[f"{view}.depth"],
        pose.reshape(4, 4),
        intrinsics.reshape(3, 3),
        None if np.isnan(radius) else float(radius),
        scene=scene,
    )


class KeptArrays:
    """Named arrays in a folder, with one more file for each save.

    The files have the layout of ``numpy.savez``. Arrays are decompressed on demand.
    """

    def __init__(self, folder: Path | None) -> None:
        """Index the existing files.

        Args:
            folder: that may not exist yet; None to keep nothing on disk.

        Raises:
            ResultsError: a file is damaged.
        """
        self._folder = folder
        self._known: dict[str, NDArray[Any]] = {}
        self._new: set[str] = set()
        self._packed: dict[str, Any] = {}
        files = (
            []
            if folder is None or not folder.is_dir()
            else sorted(folder.glob("*.npz"))
        )
        for file in files:
            with _unpacked(file):
                archive = np.load(BytesIO(file.read_bytes()), allow_pickle=False)
            self._packed |= dict.fromkeys(archive.files, (file, archive))

    def __contains__(self, name: str) -> bool:
        """Return True if there is an array of this name."""
        return name in self._known or name in self._packed

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return the array of this name."""
        if name not in self._known:
            file, archive = self._packed[name]
            with _unpacked(file):
                self._known[name] = archive[name]
        return self._known[name]

    def __setitem__(self, name: str, values: NDArray[Any]) -> None:
        """Store an array."""
        self._known[name] = np.asanyarray(values)
        self._new.add(name)

    def save(self) -> None:
        """Write new arrays to one more file, completely or not at all.

        Depth images are mostly empty, so the fastest compression is almost as good as any.
        """
        if self._folder is None or not self._new:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        number = len(list(self._folder.glob("*.npz")))

        with new_file(self._folder / f"{number:06d}.npz") as part:
            archive = zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
            with archive:
                for name in sorted(self._new):
                    with archive.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(
                            member,
                            self._known[name],
                            allow_pickle=False,
                        )

        self._new.clear()


@contextmanager
def _unpacked(file: Path) -> Iterator[None]:
    """Turn errors of a damaged file into one sentence."""
    try:
        yield
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ResultsError(
            f"{file}: is damaged ({error}); remove its folder, and run again"
        ) from None
