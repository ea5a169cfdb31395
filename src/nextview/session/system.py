"""Entry points of the library: models, policy, candidate viewpoints and stopping rule."""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import did_you_mean, number, one_line, whole
from nextview.errors import (
    MeshError,
    ModelError,
    OtherUseError,
    PolicyError,
    UsageError,
)
from nextview.geometry.mesh import Mesh, load_mesh, mesh_warnings
from nextview.geometry.viewsphere import (
    VIEW_LAYOUTS,
    Viewpoints,
    ViewSphere,
    viewpoints_of,
)
from nextview.policies.base import Policy
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.maps import MapPeak, SpherePeak
from nextview.policies.registry import make_policy_anywhere, with_cards
from nextview.recognition.belief import Stopping
from nextview.recognition.inference import MapNetwork, Models, open_maps
from nextview.recognition.map_names import SPHERE_SUFFIX
from nextview.recognition.model_card import DISCRIMINATE, Collection, find_models
from nextview.recognition.own_recogniser import own_recogniser
from nextview.recognition.own_stopping import Rule, own_stopping
from nextview.recognition.protocol import (
    Recogniser,
    RulesOut,
    check_unknown,
    tells_unknown,
)
from nextview.segmentation.instances import Segmenter
from nextview.sensing.observation import Camera
from nextview.sensing.observed_object import ObservedObject
from nextview.session.limits import Limits
from nextview.session.recogniser import ThingRecogniser, open_recogniser
from nextview.session.result import Recognition
from nextview.session.session import FrameCamera, Session
from nextview.session.several import SeveralRecognisers
from nextview.views.expected_views import Goal

if TYPE_CHECKING:
    from nextview.captured.camera import CapturedCamera
    from nextview.simulation.sensor import Sensor

MOST_THREADS = 1024
# the default models and their false-alarm rate
DEFAULT_MODELS = "modelnet10"
UNKNOWN_ALPHA = 0.02
# suffixes of captured frames, as opposed to meshes
FRAME_FILES = (".mcap", ".db3", ".bag", ".png", ".pcd")


@dataclass(frozen=True, repr=False)
class System:
    """Everything needed to recognise an object, as created by ``load``.

    It is pickled as the arguments of ``load``.

    Attributes:
        models: the recogniser and the map networks.
        policy: chooses the next view.
        policy_name: name of the policy.
        sphere: the candidate viewpoints.
        stopping: the stopping rule.
        unknown: significance level of the test for unknown objects; 0 disables it.
        loaded: the arguments of ``load``.
        ruled_out: names of things that the object is not, see ``without``.

    Example:

        >>> nextview.load().recognise(sample_mesh("table"), start=33).answer
        'table'
    """

    models: Models
    policy: Policy
    policy_name: str
    sphere: Viewpoints
    stopping: Stopping
    unknown: float
    loaded: dict[str, Any] = field(repr=False)
    ruled_out: tuple[str, ...] = ()

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the known classes."""
        return self.models.classes

    def session(
        self,
        start: int | None = None,
        seed: int = 0,
        object: ObservedObject | None = None,
        distance: float | None = None,
        min_height: float | None = None,
        max_height: float | None = None,
        clearance: float | None = None,
        goal: Goal = "thing",
        segmentation: Segmenter | None = None,
    ) -> Session:
        """Create a session for one object. For a robot, a distance is enough.

        Candidate views that would collide with the table or other visible surfaces are excluded,
        see ``session.limits.Limits`` for the three limits.

        Args:
            start: first view, an index of ``sphere``; random by default.
            seed: of the first view and of random policies.
            object: the object to find in the frames of a depth camera; by default the one at which
                the first camera is aimed. One in the air must be selected by a mask or a box, with
                ``ObservedObject(support=False)``.
            distance: desired distance of the camera from the object, metres; 3 object radii by
                default. With an object or a distance, the session accepts frames; otherwise the
                first input decides.
            min_height: least height of the camera above the support plane, metres; by default 0.08,
                and a tenth of the camera's distance from the object.
            max_height: largest height of the camera above the support plane, metres; by default 2,
                or the greatest height of the camera so far.
            clearance: least distance between the camera and surfaces in the frames, metres; 0.1 by
                default, 0 for no limit.
            goal: "thing" ends once the identity is confident, "pose" once the pose is confident
                too, see ``Session.goal``.
            segmentation: segments the objects in frames, see ``Scene``; the object is one of the
                segments.
        """
        rng = np.random.default_rng(whole(seed, "the seed", 0, 2**63 - 1))
        drawn = int(rng.integers(len(self.sphere)))
        start = drawn if start is None else start
        options = (self.stopping, rng, object, distance, self.unknown)
        session = Session(
            self.models, self.policy, self.sphere, start, *options, segmentation
        )
        session.limits = Limits(min_height, max_height, clearance)
        session.goal = goal
        return session

    def session_with(
        self,
        camera: Camera | FrameCamera,
        start: int | None = None,
        seed: int = 0,
    ) -> Session:
        """Create a session for a camera. A camera that delivers frames also provides the object.

        Args:
            camera: the camera.
            start: index of the first view; None for a random one.
            seed: of the first view and of random policies.

        Returns:
            The session.
        """
        if not isinstance(camera, FrameCamera):
            return self.session(start, seed)
        session = self.session(start, seed, camera.object)
        if getattr(camera, "knows_reach", False):
            session.limits = Limits.none()
        return session

    def recognise(
        self,
        what: str | Path | Mesh | Camera | FrameCamera,
        start: int | None = None,
        seed: int = 0,
        up: str | tuple[float, float, float] | None = None,
        unit: str | None = None,
        sensor: "str | Sensor | None" = None,
        largest_part: bool = False,
    ) -> Recognition:
        """Recognise an object from as few views as needed.

        Args:
            what: a mesh file (OFF, OBJ, PLY, STL or GLB), a mesh, captured views (a folder or a ROS
                2 bag), or a camera: any object with ``observe(pose)``.
            start: first view, an index of ``sphere``; random by default.
            seed: of the first view and of random policies.
            up: up axis of a mesh file, "y" or "z"; by default z, and y for GLB. For captured views,
                the direction against gravity in the world, (3,); by default that of the layout.
            unit: unit of length of a mesh file, one of ``mesh.UNITS``; if it is given, size counts
                as evidence.
            sensor: simulated depth camera: a ``Sensor``, or NAME or NAME:STRENGTH of
                ``simulation.sensor.SENSORS``; its errors are drawn with the seed. None for
                renders without noise.
            largest_part: keep only the largest connected part of a mesh file, see ``load_mesh``.
                Likely problems of a mesh file are reported as Python warnings.

        Raises:
            MeshError, DatasetError: the file or the folder cannot be used.
            UsageError: the sensor is not known, or ``what`` has an unsupported type.
            ObservationError: the object is not found in any captured view.
        """
        if largest_part and not (isinstance(what, str | Path) and not is_frames(what)):
            raise UsageError(
                "the largest part is taken of a mesh file while it is read"
            )
        if isinstance(what, str) and not what.strip():
            raise UsageError(
                "what is looked at has an empty name; give a mesh file or a folder of views"
            )

        if isinstance(what, str | Path):
            if is_frames(what):
                what = _camera_of(Path(what), up)
            elif up is None or isinstance(up, str):
                what = load_mesh(what, up, unit, largest_part=largest_part)
                for sentence in mesh_warnings(what):
                    warnings.warn(f"{what.name}: {sentence}", stacklevel=2)
            else:
                raise MeshError(
                    f"{what}: the up axis of a mesh file is y or z, not {up}"
                )

        if isinstance(what, Mesh):
            what = simulated(what, sensor, seed)
        elif sensor is not None:
            raise UsageError("a sensor is for meshes: a camera has its own errors")

        if not hasattr(what, "observe"):
            wanted = (
                "a mesh file, a Mesh, a folder of views, or a camera with observe(pose)"
            )
            raise UsageError(
                f"what is looked at is {wanted}, not {one_line(repr(what))}"
            )
        return self.session_with(what, start, seed).run(what)

    def without(self, *names: str) -> "System":
        """Return the same system for an object that is none of some taught things.

        Names, poses, doubts and p-values are those of the likeliest of the other things. It serves
        for what you know otherwise: for example, that the only mug stands elsewhere.

        Args:
            names: of things; ``classes`` still contains them, with a belief of 0.

        Raises:
            UsageError: no thing has such a name, or no name is left.
            ModelError: things are ruled out by their geometry, and the models have none.
        """
        recogniser = self.models.recogniser
        for name in names:
            if name not in self.classes:
                what = f"{one_line(str(name))} is none of the taught things"
                raise UsageError(f"{what}{did_you_mean(str(name), self.classes)}")
        if not isinstance(recogniser, RulesOut):
            what = "only things of known geometry are ruled out, and it knows none"
            raise ModelError(f"{recogniser.name}: {what}")
        ruled_out = (*self.ruled_out, *names)
        if set(self.classes) <= {*ruled_out}:
            raise UsageError("every name is ruled out: leave one at least")
        models = replace(self.models, recogniser=recogniser.without(names))
        return replace(self, models=models, ruled_out=ruled_out)

    def __post_init__(self) -> None:
        check_unknown(self.unknown, self.models.recogniser)

    def __repr__(self) -> str:
        name = self.models.recogniser.name
        views = len(self.sphere)
        return f"System({name}, policy {self.policy_name}, {views} viewpoints, {self.stopping})"

    def __reduce__(self) -> "tuple[Callable[[], System], tuple[()]]":
        return partial(_reloaded, self.loaded, self.ruled_out), ()


def _reloaded(loaded: dict[str, Any], ruled_out: Sequence[str]) -> System:
    """Return a system that was pickled as the arguments of ``load``."""
    system = load(**loaded)
    return system.without(*ruled_out) if ruled_out else system


def simulated(
    mesh: Mesh,
    sensor: "str | Sensor | None" = None,
    seed: int = 0,
) -> Camera:
    """Create a simulated camera in front of a mesh.

    Args:
        mesh: the mesh.
        sensor: simulated sensor errors; None for noise-free renders.
        seed: of the errors.

    Returns:
        The camera.
    """
    if sensor is None:
        from nextview.simulation.simulated import SimulatedCamera

        return SimulatedCamera(mesh)
    from nextview.simulation.sensed_camera import SensedCamera

    return SensedCamera(
        mesh,
        sensor,
        np.random.default_rng(whole(seed, "the seed", 0, 2**63 - 1)),
    )


def load(
    models: str | Path | Sequence[str | Path] = DEFAULT_MODELS,
    policy: str | None = None,
    threshold: float = 0.97,
    risk: float | None = None,
    max_views: int = 5,
    viewpoints: str | Viewpoints | ArrayLike = "40",
    threads: int = 0,
    unknown: float | None = None,
    stopping: Stopping | Rule | str | None = None,
    recogniser: Any = None,
    camera_accuracy: tuple[float, float] | None = None,
) -> System:
    """Load models and create a system.

    Args:
        models: name of bundled models, or a folder with the card of a recogniser and, optionally,
            cards of maps and policies. Missing maps are taken from the bundled models; they do not
            depend on the classes. Or a list: memories with geometry, and at most one network. A
            thing is then named if its geometry explains the views, and otherwise a class of the
            network.
        policy: policy that chooses the next view; by default "gain" if one was trained for these
            classes, else "spread". Names are those of ``nextview.policies.registry``, of policy
            cards in the folder, or "MODULE:CLASS".
        threshold: stop as soon as the belief in one class reaches this value; it applies after the
            first view and decreases with every further view.
        risk: instead of ``threshold``, the largest share of wrong answers among the episodes that
            stop early; the lowest threshold that guarantees it is used.
        max_views: largest number of views.
        viewpoints: candidate viewpoints: "40", "12", "rings:0,30,60x12", "fibonacci:60", or your
            own directions or poses, see ``viewsphere.viewpoints_of``.
        threads: of ONNX Runtime, 0 for one on each core that is used, see ``nextview.cores``.
        unknown: significance level of the test for unknown objects: the answer is None for a
            smaller p-value, and so for this share of known objects. Objects of a size that their
            class never has are unknown too. 0 always names a class; another rate has to be above
            the smallest p-value that the models can give. By default 0.02 if the recogniser has a
            novelty score.
        stopping: your own rule: "MODULE:NAME", or a function of a
            ``recognition.own_stopping.Believed`` and the threshold; or a ``Stopping``, which
            replaces threshold, risk and max_views.
        recogniser: your own recogniser, which replaces that of the models: an object or
            "MODULE:NAME", see ``recognition.own_recogniser``. It is pickled with the system.
        camera_accuracy: standard deviations of the camera poses along and about each axis:
            (millimetres, degrees), for example from hand-eye calibration and the data sheet of the
            arm. By default (4, 0.34). They add to the uncertainty of poses in the world frame, and
            guide the alignment of views.

    Returns:
        The system.

    Raises:
        ModelError: the models are not known or cannot be used, or the recogniser has no novelty
            score.
        PolicyError: the policy is not known or cannot be created.
        RiskError: the error rate cannot be guaranteed.
        UsageError: a threshold, a rate or a number of views is invalid.

    Example:

        >>> nextview.load(policy="gain", max_views=3).policy_name
        'gain'
    """
    given = dict(locals())
    names = _names_of(models)
    given["models"] = names if len(names) > 1 else names[0]
    _check_options(policy, threads, risk, unknown)
    # reports invalid arguments before any file is opened
    Stopping(threshold, max_views)

    collections = {name: find_models(name) for name in names}
    found = collections[names[-1]]
    sphere = viewpoints_of(viewpoints)
    knows = (
        _opened(collections, threads)
        if recogniser is None
        else own_recogniser(recogniser)
    )
    if camera_accuracy is not None:
        knows = _for_cameras(knows, camera_accuracy)
    policies = found.policies
    # the policy of a memory is valid only for its own things
    if recogniser is not None or len(names) > 1:
        policies = {
            name: card for name, card in policies.items() if name != DISCRIMINATE
        }

    share = _unknown_share(
        unknown,
        knows,
        str(found.recogniser) if recogniser is None else knows.name,
    )
    if not share:
        knows.novelty = None  # not used, and slow
    if policy is None:
        name, made = _default_policy(policies, sphere, knows)
    else:
        name = str(policy)
        made = make_policy_anywhere(
            with_cards(name, policies),
            sphere,
            (),
            knows.classes,
            found.maps,
        )

    opened = Models(knows, open_maps(found.maps, made.needs, threads))
    # the card of a map lists the classes for which its policy goes to the valley
    if name in opened.maps:
        made = make_policy_anywhere(
            name,
            sphere,
            opened.valley_classes(name),
            knows.classes,
            found.maps,
        )
    if isinstance(made, MapPeak | SpherePeak):
        made = replace(
            made,
            sphere=_grid_of(
                opened.maps[made.map_name.removesuffix(SPHERE_SUFFIX)],
                made.sphere,
            ),
        )
    rule = _rule(
        stopping,
        Stopping.of(knows.calibration, threshold, risk, max_views),
        risk,
    )
    return System(opened, made, name, sphere, rule, share, given)


def _check_options(
    policy: Any,
    threads: int,
    risk: float | None,
    unknown: float | None,
) -> None:
    """Check arguments of ``load`` before any file is opened; UsageError."""
    if policy is not None and not isinstance(policy, str | Path):
        raise UsageError(
            f"a policy is given by name or path, not {one_line(repr(policy))}"
        )
    whole(threads, "the number of threads", 0, MOST_THREADS)
    if risk is not None:
        number(risk, "the risk")
    if (
        unknown is not None
        and number(unknown, "the share of known objects called unknown", 0) >= 1
    ):
        raise UsageError(
            f"the share of known objects called unknown is below 1, not {unknown}"
        )


def _names_of(models: Any) -> list[str]:
    """Return the names of one or several collections; UsageError if they are invalid."""
    given = list(models) if isinstance(models, list | tuple) else [models]
    for name in given or [models]:
        if not isinstance(name, str | Path):
            raise UsageError(
                f"models are given by name or path, not {one_line(repr(name))}"
            )
    names = [str(name) for name in given]
    if len(set(names)) < len(names):
        raise UsageError(f"one of the models is there twice: {', '.join(names)}")
    return names


def _opened(collections: dict[str, Collection], threads: int) -> Recogniser:
    """Open the recogniser of one collection, or a joint one of several."""
    opened = {
        name: open_recogniser(found.recogniser, threads)
        for name, found in collections.items()
    }
    if len(opened) > 1:
        return SeveralRecognisers(opened)
    return next(iter(opened.values()))


def _for_cameras(recogniser: Recogniser, accuracy: Any) -> Recogniser:
    """Return the recogniser for cameras of this accuracy, millimetres and degrees.

    UsageError if the numbers are invalid, ModelError without known geometry.
    """
    what = "the accuracy of the cameras"
    if not isinstance(accuracy, tuple | list) or len(accuracy) != 2:
        raise UsageError(
            f"{what} is (millimetres, degrees), not {one_line(repr(accuracy))}"
        )
    place, aim = (number(value, what, 0) for value in accuracy)
    if not isinstance(recogniser, ThingRecogniser | SeveralRecognisers):
        raise ModelError(
            f"{recogniser.name}: {what} counts for taught things of known geometry alone"
        )
    return recogniser.for_cameras(place / 1000, float(np.radians(aim)))


def _unknown_share(asked: float | None, recogniser: Recogniser, called: str) -> float:
    """Return the significance level of the test for unknown objects.

    ModelError if the recogniser has no novelty score.
    """
    can_tell = tells_unknown(recogniser)
    if asked and not can_tell:
        raise ModelError(
            f"{called}: cannot tell unknown objects; nextview-lab fit unknown teaches it"
        )
    if asked is None:
        return UNKNOWN_ALPHA if can_tell else 0.0
    return asked


def _rule(
    given: Stopping | Rule | str | None,
    usual: Stopping,
    risk: float | None,
) -> Stopping:
    if given is None or isinstance(given, Stopping):
        return given or usual
    if risk is not None:
        raise UsageError(
            "error rates are promised for the package's own stopping rule, not for yours"
        )
    return own_stopping(given, usual.threshold, usual.max_views)


def _grid_of(network: MapNetwork, sphere: ViewSphere) -> ViewSphere:
    """Return the grid of a network's maps: that of the views, or the 40 views."""
    for grid in (sphere, *VIEW_LAYOUTS.values()):
        if network.rings in (None, grid.rings):
            return grid
    there = f"the {len(sphere)} viewpoints {sphere.rings}"
    raise PolicyError(
        f"the map {network.card.name} has {network.rings} rings, and {there}"
    )


def is_frames(path: str | Path) -> bool:
    """Return True if a path is a folder, bag or image of captured frames, not a mesh file."""
    # Path.is_dir raises an error if a name is too long
    return os.path.isdir(path) or os.path.splitext(path)[1].lower() in FRAME_FILES


def _camera_of(
    folder: Path,
    up: str | tuple[float, float, float] | None,
) -> "CapturedCamera":
    from nextview.captured.camera import UP, CapturedCamera
    from nextview.captured.folders import read_capture

    if isinstance(up, str) and up not in UP:
        raise UsageError(
            f"{folder}: up is {', '.join(UP)} or a direction, three numbers, not {up!r}"
        )
    return CapturedCamera(read_capture(folder), UP[up] if isinstance(up, str) else up)


def _default_policy(
    own: dict[str, Path],
    sphere: Viewpoints,
    recogniser: Recogniser,
) -> tuple[str, Policy]:
    """Return "discriminate" for taught things, "gain" if one fits, else "spread"."""
    if isinstance(recogniser, SeveralRecognisers):
        return DISCRIMINATE, DiscriminateGeometry(sphere)
    if (memory := own.get(DISCRIMINATE)) is not None:
        return DISCRIMINATE, make_policy_anywhere(
            str(memory),
            sphere,
            (),
            recogniser.classes,
        )

    try:
        gain = make_policy_anywhere(
            str(own.get("gain", "gain")),
            sphere,
            (),
            recogniser.classes,
        )
        grid = getattr(gain, "sphere", None)
        if "azimuth_bins" not in gain.needs or recogniser.azimuth_bins == getattr(
            grid,
            "azimuths",
            None,
        ):
            return "gain", gain
    except OtherUseError:
        pass

    return "spread", make_policy_anywhere("spread", sphere)


_bundled = lru_cache(maxsize=1)(load)


def recognise(
    what: str | Path | Mesh | Camera | FrameCamera,
    **options: Any,
) -> Recognition:
    """Recognise an object with the bundled models; options as for ``System.recognise``.

    Args:
        what: mesh file, mesh, folder of captured views, or camera.
        **options: see ``System.recognise``.

    Returns:
        The result.

    Example:
        >>> nextview.recognise(sample_mesh("chair"), start=3).answer
        'chair'
    """
    return _bundled().recognise(what, **options)
