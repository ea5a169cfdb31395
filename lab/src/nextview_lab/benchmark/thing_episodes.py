"""Episodes with taught things.

An episode is a thing at its true size on a table, alone or half hidden by boxes, in front of a
sensor with its own errors. Every view is simulated once, and every set of views is verified once,
exactly as in ``Session``, however many policies look at it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import (
    ViewSphere,
    azimuth_of,
    direction_of,
    rotation_z,
)
from nextview.policies.base import EpisodeState
from nextview.recognition.belief import log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.model_card import find_models
from nextview.recognition.own_recogniser import own_recogniser
from nextview.recognition.protocol import (
    JointBelief,
    JudgesTogether,
    LooksAhead,
    Recogniser,
)
from nextview.sensing.observation import Observation
from nextview.session.recogniser import ThingRecogniser, open_recogniser
from nextview.simulation.boxes import boxes_around
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.surface import Surface
from nextview.types import Float, Floats
from nextview.views.expected_views import Outlook
from nextview_lab.data.metrics import add_s


class KnownThings:
    """The things that a recogniser knows.

    Attributes:
        recogniser: the recogniser.
        names: its classes in alphabetical order, so that things with the same names have the same
            episodes.
        memory: the same recogniser, of taught things; None for one of your own.
    """

    def __init__(self, recogniser: Recogniser) -> None:
        """Use a recogniser.

        Args:
            recogniser: a memory of taught things of known geometry, or one of your own.
        """
        self.recogniser = recogniser
        self._order = np.argsort(recogniser.classes, kind="stable")
        self.names = tuple(recogniser.classes[k] for k in self._order)
        self.memory = recogniser if isinstance(recogniser, ThingRecogniser) else None

    def surface(self, thing: int) -> Surface | None:
        """Return the taught surface of a thing; None for a recogniser of your own."""
        if self.memory is None:
            return None
        library = self.memory.library
        return library.caster.surfaces[library.names.index(self.names[thing])]

    def __call__(self, observations: Sequence[Observation]) -> JointBelief:
        """What it says of views of one thing; the belief is in the order of the names.

        Args:
            observations: views that show the thing, in one object frame.

        Raises:
            ModelError: its answer is invalid.
        """
        joint = self._together(observations)
        belief = np.asarray(joint.belief, np.float64)[self._order]
        return replace(joint, belief=belief)

    def _together(self, observations: Sequence[Observation]) -> JointBelief:
        """What it says of views of one thing: together if it can, else by the sum of all."""
        total = log_evidence_of_views(self.recogniser, observations).sum(0)
        count = len(observations)
        if isinstance(self.recogniser, JudgesTogether):
            return self.recogniser.together(observations, total, count)
        calibration = self.recogniser.calibration
        return JointBelief(calibration.belief(total, count, len(self.names)))

    def outlook(self, observations: Sequence[Observation]) -> Outlook | None:
        """Return the prediction of further views; None where nothing can be foreseen.

        Args:
            observations: views that show the thing, in one object frame.
        """
        if not isinstance(self.recogniser, LooksAhead):
            return None
        found = self.recogniser.outlook(observations, self._together(observations))
        assert found is None or isinstance(found, Outlook)
        return found


@lru_cache(maxsize=1)
def things_of(models: str, given: str | None) -> KnownThings:
    """Open the things of a memory, or of your own recogniser, once per process.

    Args:
        models: folder or name of the memory.
        given: MODULE:NAME of your own recogniser; None for the memory.

    Raises:
        UsageError: the memory knows no geometry, or there is no such recogniser.
        ModelError: the memory or the recogniser cannot be opened.
    """
    if given is not None:
        return KnownThings(own_recogniser(given))
    recogniser = open_recogniser(find_models(models).recogniser, threads=1)
    if not isinstance(recogniser, ThingRecogniser):
        raise UsageError(
            f"{models}: knows the geometry of no thing; teach it with --unit"
        )
    return KnownThings(recogniser)


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
        mesh: Mesh,
        thing: int,
        draw: int,
        setting: Setting,
    ) -> None:
        """Set up the scene.

        Args:
            things: the hypotheses: a memory of taught things, or your own recogniser.
            mesh: of the thing, with a known unit.
            thing: its number among the things.
            draw: number of the draw.
            setting: conditions of the episode.
        """
        self.things = things
        self.thing = thing
        self._mesh = mesh
        self._seed = (setting.seed, thing, draw)
        self._draw_scene(setting)
        self._views: dict[int, tuple[Observation, Float]] = {}
        self._verified: dict[frozenset[int], JointBelief] = {}
        self.start = self._first_view()

    def _draw_scene(self, setting: Setting) -> None:
        """Rotate the thing, and draw its sensor and its surroundings."""
        mesh = self._mesh
        rng = np.random.default_rng(self._seed)
        turn = rotation_z(rng.uniform(0, 2 * np.pi))
        self._standing = rotated(mesh, turn)
        radius = self._standing.metres
        assert radius is not None  # the unit of its file is known
        away = max(NEAREST_SURFACE + radius, min(USUAL_DISTANCE, RADII_AWAY * radius))
        drawn = sensor_named(setting.sensor).draw(rng)
        self._sensor = replace(drawn, radius=radius, distance=away, boxes=0.0)
        # from the frame of the file to the true object frame, metres
        self._in_truth = np.eye(4)
        self._in_truth[:3, :3] = turn
        self._in_truth[:3, 3] = -(turn @ mesh.centre + self._standing.centre)
        self._around: Mesh | None = None
        if setting.occlusion != "none":
            share = VISIBLE_SHARES[setting.occlusion]
            self._around = hiding_boxes(self._standing, share, (*self._seed, 2))

    def _first_view(self) -> int:
        """Return a view in which the thing is visible."""
        rng = np.random.default_rng((*self._seed, 3))
        for view in rng.permutation(len(EPISODE_SPHERE)):
            if self.observation(int(view)).seen:
                return int(view)
        raise UsageError(f"{self.things.names[self.thing]}: shows from no viewpoint")

    def observation(self, view: int) -> Observation:
        """Return the observation from a viewpoint. Its noise depends only on the viewpoint."""
        return self._sensed(view)[0]

    def _sensed(self, view: int) -> tuple[Observation, Float]:
        """Return the observation from a viewpoint, and the file's true pose in its camera."""
        if view not in self._views:
            # with the setup errors of the episode and the noise of one view
            rng = np.random.default_rng((*self._seed, 7))
            camera = SensedCamera(
                self._standing, self._sensor, rng, around=self._around
            )
            rng.spawn(view)
            observation = camera.observe(EPISODE_SPHERE.poses[view])
            in_camera = np.full((4, 4), np.nan)
            if camera.true_pose is not None:
                in_camera = np.linalg.inv(camera.true_pose) @ self._in_truth
            self._views[view] = observation, in_camera
        return self._views[view]

    def seen(self, views: Sequence[int]) -> list[int]:
        """Return the views in which the thing is visible."""
        return [view for view in views if self.observation(view).seen]

    def verified(self, views: Sequence[int]) -> JointBelief:
        """Return what the recogniser says of some views."""
        used = frozenset(self.seen(views))
        if used not in self._verified:
            self._verified[used] = self.things(
                [self.observation(view) for view in sorted(used)]
            )
        return self._verified[used]

    def named_right(self, views: Sequence[int]) -> bool:
        """Return True if the thing is named correctly after some views."""
        return int(self.verified(views).belief.argmax()) == self.thing

    def belief_in_truth(self, views: Sequence[int]) -> float:
        """Return the belief in the true thing after some views."""
        return float(self.verified(views).belief[self.thing])

    def p_value(self, views: Sequence[int]) -> float | None:
        """Return the value of the test for unknown things; None if there is none."""
        value = self.verified(views).p_value
        return None if value is None else float(value)

    def pose_error(self, views: Sequence[int]) -> float | None:
        """Return the pose error (ADD-S) in the last view, millimetres.

        Returns:
            The mean distance of surface points in the estimated pose to the nearest points of the
            true surface; None if the thing is not named correctly.
        """
        name = self.things.names[self.thing]
        poses = [each.pose for each in self.verified(views).poses if each.thing == name]
        if not poses or not self.named_right(views):
            return None

        seen = self.seen(views)
        observation = self.observation(seen[-1])
        assert observation.sighting is not None
        assert observation.object_frame is not None
        pose = observation.sighting.frame.camera_to_world
        camera = observation.object_frame.pose_in_metres(pose)
        points = self._surface.sample(POSE_ERROR_POINTS, np.random.default_rng(0))
        true = self._sensed(seen[-1])[1]
        return 1000 * add_s(points, np.linalg.inv(camera) @ poses[0], true)

    @cached_property
    def _surface(self) -> Surface:
        """Return the surface of the thing in the memory; without a memory, that of its file."""
        taught = self.things.surface(self.thing)
        if taught is not None:
            return taught
        return Surface.from_mesh(self._mesh, self.things.names[self.thing])

    def state(self, views: Sequence[int], needs: Sequence[str]) -> EpisodeState:
        """Return the state of the episode for a policy.

        Args:
            views: in order.
            needs: inputs of the policy: "observations" and "outlook" are available.
        """
        classes = len(self.things.recogniser.classes)
        visited = np.zeros((1, len(EPISODE_SPHERE)), bool)
        visited[0, list(views)] = True
        return EpisodeState(
            current=np.array([views[-1]]),
            visited=visited,
            belief=self.verified(views).belief[None],
            evidence=Evidence(np.zeros((1, classes))),
            step=len(views),
            observations=[[self.observation(view) for view in views]],
            outlook=[self.outlook(views)] if "outlook" in needs else None,
        )

    def outlook(self, views: Sequence[int]) -> Outlook | None:
        """Return the prediction of further views for the choice of the next view."""
        return self.things.outlook(
            [self.observation(view) for view in self.seen(views)]
        )


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


def log_evidence_of_views(
    recogniser: Recogniser,
    observations: Sequence[Observation],
) -> Floats:
    """Return what a recogniser says of each view, in a form that can be summed over views.

    Args:
        recogniser: is asked once.
        observations: V views.

    Returns:
        (V, D): see ``log_evidence_of``.

    Raises:
        ModelError: its answer is none.
    """
    evidence = recogniser(observations)
    azimuths = azimuth_of(np.stack([direction_of(each.pose) for each in observations]))
    return log_evidence_of(evidence.logits, evidence.azimuth_bins, azimuths)
