"""How an episode ended: the answer, how sure it is, and its picture."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nextview.checks import number_of
from nextview.geometry.ray_caster import Triangles
from nextview.geometry.viewsphere import Viewpoints
from nextview.recognition.belief import Stopping
from nextview.recognition.novelty import Quantiles, values_of
from nextview.recognition.poses import (
    PoseCandidate,
    PoseUncertainty,
    place_in_words,
    uncertainty_of,
)
from nextview.recognition.protocol import JointBelief
from nextview.sensing.view_warning import ViewWarning
from nextview.session.pose_frame import PoseFrame, PoseFrameName
from nextview.session.view import View
from nextview.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

# an object as novel as so many times the share that may be called unknown gets no confident answer
SUSPICIOUS = 5.0


@dataclass(frozen=True)
class Recognition:
    """The end of an episode, or how it stands; before the first view nothing is seen.

    It is confident where the threshold was reached in a view without warnings that hold it (see
    ``ViewWarning.holds``), by an object that is not suspiciously novel (see ``SUSPICIOUS``) and may
    be of the class by its size, fewer than half of the views contradict others, and there is no
    ``doubt``.

    Attributes:
        views: in order.
        classes: their names.
        confident: else the views ran out.
        sphere: the candidates.
        stopping: the rule that ended it.
        stranded: whether it ended because no view that was left could be reached; then it is not
            confident.
        why_stranded: what became of the views that were left, as "30 too low, 9 failed"; "" if not
            stranded.
        score: gives the novelty of views; None if the recogniser has none.
        unknown_rate: share of objects of known classes that may be called unknown; 0: none.
        impossible: classes whose objects have not such a size.
        poses_in: the frame in which poses are given.

    Example:
        >>> result = nextview.recognise(sample_mesh("chair"), start=3)
        >>> result.answer, result.confident
        ('chair', True)
    """

    views: tuple[View, ...]
    classes: tuple[str, ...]
    confident: bool
    sphere: Viewpoints
    stopping: Stopping
    stranded: bool = False
    why_stranded: str = ""
    score: Quantiles | None = None
    unknown_rate: float = 0.0
    impossible: tuple[str, ...] = ()
    poses_in: PoseFrame = field(default_factory=PoseFrame, repr=False)

    @property
    def seen(self) -> bool:
        """Whether the object was seen from any of the views."""
        return any(view.observation.seen for view in self.views)

    @property
    def warnings(self) -> tuple[ViewWarning, ...]:
        """Likely faults of the views, each kind once, as the last view reports it."""
        found = {
            warning.name: warning for view in self.views for warning in view.warnings
        }
        return tuple(found.values())

    @property
    def novelty(self) -> float | None:
        """p-value: share of known objects that are at least as novel; None without a score.

        It holds for objects seen as the known ones were; what is hidden of one is allowed for, see
        ``values_of``. Of things that are known by their geometry it says how badly the likeliest
        one explains the depth.
        """
        if self._explained is not None:
            return self._explained
        if self.score is None or not self.seen:
            return None
        views = [view.score for view in self.views if view.score is not None]
        return self.score.of_views(values_of(views, whole=not self.score.joint))

    @property
    def unknown(self) -> bool:
        """Whether the object is of no known class, by its novelty or its size."""
        if not self.unknown_rate or not self.seen:
            return False
        if self.novelty is not None and self.novelty < self.unknown_rate:
            return True
        # A thing that explains the depth has the right size, even where half of it is hidden.
        return self._explained is None and self.most_like in self.impossible

    @property
    def none_of_them(self) -> str:
        """The answer for an unknown object.

        It reads ``none of the 10 known classes (most like a toilet)``.
        """
        a = "an" if str(self.most_like)[:1].lower() in "aeiou" else "a"
        return f"none of the {len(self.classes)} known classes (most like {a} {self.most_like})"

    @property
    def why_unknown(self) -> str:
        """What an object is called unknown for, in words."""
        if self._explained is not None and self._joint_poses:
            return (
                f"{100 * self._explained:.2g} % of taught things are explained as badly by their"
                " scans"
            )
        if self.most_like in self.impossible:
            return f"no {self.most_like} has a radius of {self.radius:.2g} m"
        return f"{100 * (self.novelty or 0):.2g} % of known objects are as novel"

    @property
    def most_like(self) -> str | None:
        """The class believed most, also of an unknown object; None if nothing was seen."""
        return self.classes[int(self.views[-1].belief.argmax())] if self.seen else None

    @property
    def answer(self) -> str | None:
        """The class believed most; None if nothing was seen, or the object is unknown."""
        return None if self.unknown else self.most_like

    @property
    def confidence(self) -> float:
        """The belief in the answer; 0 if there is none."""
        return 0.0 if self.answer is None else float(self.views[-1].belief.max())

    @property
    def beliefs(self) -> dict[str, float]:
        """The belief in each class by its name, over all views; empty if nothing was seen."""
        return (
            dict(zip(self.classes, self.views[-1].belief.tolist(), strict=True))
            if self.seen
            else {}
        )

    @property
    def radius(self) -> float | None:
        """Current estimate of the object radius, metres; None if the scale is not known."""
        return self.views[-1].observation.radius if self.views else None

    @property
    def pose(self) -> Float | None:
        """Transform from the frame of the scan file to ``pose_frame``, (4, 4), metres.

        A point p of the scan, in metres, is at ``(pose @ [*p, 1])[:3]``. None where there is no
        answer, or its geometry is not known: see ``why_no_pose``.
        """
        found = self._candidates_of_answer
        return found[0].pose if found else None

    @property
    def pose_of(self) -> str | None:
        """Name of the thing whose scan ``pose`` is of; one of the answer's class."""
        found = self._candidates_of_answer
        return found[0].thing if found else None

    @property
    def place(self) -> Float | None:
        """Centroid of the thing's surface in ``pose_frame``, (3,), metres; None without a pose."""
        found = self._candidates_of_answer
        return found[0].place if found else None

    @property
    def pose_frame(self) -> PoseFrameName:
        """The frame in which poses are given.

        "world" is the robot's: that in which the frames' camera poses are. "camera" is that of the
        camera (OpenCV axes), of a single frame without a pose. "object" is the object frame in
        metres, where a camera gives observations, as simulated ones do.
        """
        return self.poses_in.name

    @property
    def pose_candidates(self) -> tuple[PoseCandidate, ...]:
        """The plausible poses, most likely first, in ``pose_frame``; probabilities sum to 1.

        There are several where a thing looks alike from several sides, or two things look alike:
        each says of which thing it is. None are known where ``pose`` is None because the geometry
        is not known.
        """
        return tuple(
            candidate.moved(self.poses_in.from_object)
            for candidate in self._joint_poses
        )

    @property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Standard deviations of ``pose``, degrees and millimetres; None without a pose.

        It comes from how well the depth determines the pose, from how likely the other candidates
        of the same thing are, and in the world from how far off cameras usually are.
        """
        found = self._candidates_of_answer
        joint = self._joint
        if not found or joint is None:
            return None
        camera = joint.camera_error if self.pose_frame == "world" else 0.0
        return uncertainty_of(
            [one for one in found if one.thing == found[0].thing],
            camera,
        )

    @property
    def symmetry(self) -> Any:
        """Rotations that leave the named thing unchanged; None if they are not known."""
        found = self._candidates_of_answer
        return found[0].symmetry if found else None

    @property
    def posed_surface(self) -> Triangles | None:
        """The scan of the named thing in its pose; None without a pose or a surface.

        Vertices, (V, 3) float64, in the object frame and object radii as observations are, and
        faces, (F, 3).
        """
        radius = self.radius
        if not self._candidates_of_answer or radius is None:
            return None
        found = self._likeliest_in_object_frame
        if found.vertices is None or found.faces is None:
            return None
        in_metres = found.vertices @ found.pose[:3, :3].T + found.pose[:3, 3]
        return in_metres / radius, found.faces

    @property
    def _displacements(self) -> Float:
        """Displacement of ``posed_surface`` in each view, (views, 3), object radii.

        It comes from the errors of the camera positions, in the object frame; 0 where it is not
        known.
        """
        displaced = np.zeros((len(self.views), 3))
        radius = self.radius
        if not self._candidates_of_answer or radius is None:
            return displaced

        known = self._likeliest_in_object_frame.displacements
        seen = np.array([view.observation.seen for view in self.views])
        if len(known) == seen.sum():
            displaced[seen] = known / radius
        elif len(known):
            logger.warning(
                "displacements of %d views are given with a pose, and %d views show something:"
                " outlines are drawn without them",
                len(known),
                seen.sum(),
            )
        return displaced

    @property
    def _likeliest_in_object_frame(self) -> PoseCandidate:
        """The likeliest pose of a thing of the class that is the answer, in the object frame."""
        label = self._candidates_of_answer[0].label
        return next(each for each in self._joint_poses if each.label == label)

    @property
    def why_no_pose(self) -> str:
        """Why there is no pose though all views were judged together; "" if there is one."""
        joint = self._joint
        return joint.why_no_pose if joint is not None and self.pose is None else ""

    @property
    def doubt(self) -> str:
        """Why the answer is not confident however high the belief in it, in words; "" if it may be.

        A taught thing is confident as "this thing in this pose": its scan stands on the ground or
        above, hides what is behind it, fits without being stretched, has its orientation known, and
        is seen in enough pixels.
        """
        joint = self._joint
        return "" if joint is None or self.answer is None else joint.doubt

    @property
    def _joint(self) -> JointBelief | None:
        """What all views say together; None if views are judged one by one."""
        return self.views[-1].joint if self.views else None

    @property
    def _joint_poses(self) -> tuple[PoseCandidate, ...]:
        """The poses that the object may have, in the object frame."""
        joint = self._joint
        return () if joint is None else joint.poses

    @property
    def _explained(self) -> float | None:
        """Share of known things that are explained as badly; None if it is not known."""
        joint = self._joint
        return None if joint is None else joint.p_value

    @property
    def _candidates_of_answer(self) -> list[PoseCandidate]:
        """Poses of things of the answer's class, most likely first; none if unknown."""
        if self.answer is None:
            return []
        label = self.classes.index(self.answer)
        return [
            candidate for candidate in self.pose_candidates if candidate.label == label
        ]

    @property
    def travel(self) -> float:
        """Of the whole episode, grid cells."""
        return self.views[-1].travel if self.views else 0.0

    @property
    def effort_in_words(self) -> str:
        """How many views there were and how far the camera moved between them, as angles.

        It reads ``2 views, moved by 63° around it``.
        """
        views = number_of(len(self.views), "view")
        if len(self.views) < 2:
            return views
        return f"{views}, moved by {np.degrees(self.views[-1].arc):.0f}° around it"

    def __repr__(self) -> str:
        """One line: ``chair (belief 0.998, 2 views, moved by 63° around it, confident)``."""
        views = self.effort_in_words

        if not self.seen:
            return f"nothing is seen ({views})"
        if self.unknown:
            return f"{self.none_of_them}: {self.why_unknown} ({views})"

        sure = "confident" if self.confident else "not confident"
        if self.doubt and not self.confident:
            sure += f", {self.doubt}"
        if self.stranded:
            sure += ", no other view in reach"
            if self.why_stranded:
                sure += f": {self.why_stranded}"

        names = [warning.name for warning in self.warnings]
        warnings = f", warnings: {', '.join(names)}" if names else ""
        return (
            f"{self.answer} (belief {self.confidence:.3f}, {views},"
            f" {sure}{self._place_in_words}{warnings})"
        )

    @property
    def _place_in_words(self) -> str:
        """Place and uncertainty in words; "" without a pose.

        It reads ``, at [0.412, -0.103, 0.050] m in the world, ± 1.2°, 0.8 mm``.
        """
        if self.place is None:
            return ""
        return f", at {place_in_words(self.place)} in {self.poses_in}, {self.pose_uncertainty}"

    def plot(self, path: str | Path | None = None, title: str = "") -> "Figure":
        """Draw the episode: images, values of the views, beliefs, and the path on the sphere.

        The outline of the posed scan of the named thing is drawn over the images, corrected for the
        errors of the camera positions.

        Args:
            path: file to write, PNG, PDF or SVG, which is replaced; None for no file.
            title: text before the heading.

        Returns:
            The figure.

        Raises:
            UsageError: it is another format.
            ResultsError: the path is a link or a folder, or cannot be written.
        """
        from nextview.session.episode_figure import draw_episode, save_figure

        heading = f"{title}: {self!r}" if title else repr(self)
        figure = draw_episode(
            self.views,
            self.classes,
            self.sphere,
            self.stopping,
            heading,
            self.posed_surface,
            self._displacements,
        )
        if path is not None:
            save_figure(figure, Path(path))
        return figure
