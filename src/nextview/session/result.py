"""The result of an episode: answer, confidence, pose and figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nextview.checks import number_of
from nextview.geometry.ray_caster import Triangles
from nextview.geometry.viewsphere import Viewpoints
from nextview.recognition.belief import Stopping
from nextview.recognition.inference import Models
from nextview.recognition.novelty import Quantiles, values_of
from nextview.recognition.poses import (
    PoseCandidate,
    PoseUncertainty,
    place_in_words,
    uncertainty_of,
)
from nextview.recognition.protocol import JointBelief, classes_of_other_size
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.view_warning import ViewWarning
from nextview.session.pose_frame import PoseFrame, PoseFrameName
from nextview.session.view import View, is_doubtful
from nextview.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# no answer is confident if the p-value is below this multiple of the significance level
SUSPICIOUS = 5.0


@dataclass(frozen=True)
class Recognition:
    """The result of an episode, or its current state.

    An answer is confident if the threshold was reached in a view without blocking warnings (see
    ``ViewWarning.holds``), the object is not suspiciously novel (see ``SUSPICIOUS``), its size is
    possible for the class, fewer than half of the views contradict others, and there is no
    ``joint_doubt``. ``doubt`` tells what of this is missing.

    Attributes:
        views: in order.
        classes: their names.
        confident: whether the answer is confident.
        sphere: the candidate views.
        stopping: the stopping rule.
        stranded: whether the episode ended because no remaining view could be reached; then it is
            not confident.
        why_stranded: reasons for the remaining views, such as "30 too low, 9 failed"; "" if not
            stranded.
        score: computes the novelty of views; None if the recogniser has no novelty score.
        unknown_rate: significance level of the test for unknown objects; 0 disables it.
        impossible: classes that never have the size of this object.
        poses_in: the coordinate frame of the poses.
        ruled_out: names that the object cannot have, with reasons, see ``scene.rule.SceneRule``.

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
    ruled_out: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        models: Models,
        sphere: Viewpoints,
        stopping: Stopping,
        unknown: float,
        thing: ObservedObject | None,
    ) -> Recognition:
        """Return the result of some views, not confident yet.

        Args:
            views: in order.
            models: that judged them.
            sphere: the candidate views.
            stopping: the stopping rule.
            unknown: significance level of the test for unknown objects.
            thing: the object in the views; None if observations were passed in.
        """
        radius = views[-1].observation.radius if views else None
        return cls(
            tuple(views),
            models.classes,
            False,
            sphere,
            stopping,
            score=models.recogniser.novelty,
            unknown_rate=unknown,
            impossible=classes_of_other_size(models.recogniser, radius),
            poses_in=PoseFrame.of(thing),
        )

    @property
    def seen(self) -> bool:
        """True if the object was visible in any view."""
        return any(view.observation.seen for view in self.views)

    @property
    def warnings(self) -> tuple[ViewWarning, ...]:
        """Likely problems of the views, each kind once, as reported by the last view."""
        found = {
            warning.name: warning for view in self.views for warning in view.warnings
        }
        return tuple(found.values())

    @property
    def novelty(self) -> float | None:
        """p-value: share of known objects that are at least as novel; None without a novelty score.

        It is valid for objects seen under the same conditions as the known ones; occlusion is taken
        into account, see ``values_of``. For things with known geometry it is the probability that
        the name of the likeliest one is right.
        """
        if self._explained is not None:
            return self._explained
        if self.score is None or not self.seen:
            return None
        views = [view.score for view in self.views if view.score is not None]
        return self.score.of_views(values_of(views, whole=True))

    @property
    def unknown(self) -> bool:
        """True if the object belongs to no known class, by its novelty or its size."""
        if not self.unknown_rate or not self.seen:
            return False
        if self.novelty is not None and self.novelty < self.unknown_rate:
            return True
        # A thing that explains the depth has the right size, even if half of it is hidden.
        return self._explained is None and self.most_like in self.impossible

    @property
    def refused(self) -> bool:
        """True if the answer must not be confident, whatever its belief.

        It is unknown or suspiciously novel, in ``joint_doubt``, or ruled out by warnings.
        """
        if self.unknown or self.joint_doubt:
            return True
        if is_doubtful([view.warnings for view in self.views]):
            return True
        return self.familiarity < 1

    @property
    def familiarity(self) -> float:
        """1 unless the object is suspiciously novel; then its p-value relative to that limit."""
        if self.novelty is None or not self.unknown_rate:
            return 1.0
        return min(1.0, self.novelty / (SUSPICIOUS * self.unknown_rate))

    @property
    def none_of_them(self) -> str:
        """Answer for an unknown object.

        For example ``none of the 10 known classes (most like a toilet)``.
        """
        a = "an" if str(self.most_like)[:1].lower() in "aeiou" else "a"
        return f"none of the {len(self.classes)} known classes (most like {a} {self.most_like})"

    @property
    def why_unknown(self) -> str:
        """Reason why the object is called unknown, in words."""
        explained = self._explained is not None and self._joint_poses
        if self.most_like in self.impossible and not explained:
            return f"no {self.most_like} has a radius of {self.radius:.2g} m"
        return self._novelty_in_words

    @property
    def _novelty_in_words(self) -> str:
        """The p-value of the test for unknown objects."""
        if self._explained is not None and self._joint_poses:
            return f"the name is right with a probability of {self._explained:.2g}"
        return f"{100 * (self.novelty or 0):.2g} % of known objects are as novel"

    @property
    def most_like(self) -> str | None:
        """Class with the highest belief, even for an unknown object; None if never visible."""
        return self.classes[int(self.views[-1].belief.argmax())] if self.seen else None

    @property
    def answer(self) -> str | None:
        """Class with the highest belief; None if nothing was visible or the object is unknown."""
        return None if self.unknown else self.most_like

    @property
    def confidence(self) -> float:
        """Belief in the answer; 0 if there is none."""
        return 0.0 if self.answer is None else float(self.views[-1].belief.max())

    @property
    def beliefs(self) -> dict[str, float]:
        """Belief in each class by name, over all views; empty if nothing was visible."""
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

        A point p of the scan, in metres, is at ``(pose @ [*p, 1])[:3]``. None if there is no answer
        or its geometry is not known: see ``why_no_pose``.
        """
        found = self._candidates_of_answer
        return found[0].pose if found else None

    @property
    def pose_of(self) -> str | None:
        """Name of the thing to whose scan ``pose`` belongs; a thing of the answer's class."""
        found = self._candidates_of_answer
        return found[0].thing if found else None

    @property
    def place(self) -> Float | None:
        """Centroid of the thing's surface in ``pose_frame``, (3,), metres; None without a pose."""
        found = self._candidates_of_answer
        return found[0].place if found else None

    @property
    def pose_frame(self) -> PoseFrameName:
        """Name of the coordinate frame of the poses.

        "world" is the frame of the camera poses, usually that of the robot. "camera" is the camera
        frame (OpenCV axes) of a single frame without a pose. "object" is the object frame in
        metres, for cameras that return observations, such as simulated ones.
        """
        return self.poses_in.name

    @property
    def pose_candidates(self) -> tuple[PoseCandidate, ...]:
        """Plausible poses, most likely first, in ``pose_frame``; their probabilities sum to 1.

        There are several if a thing looks alike from several sides, or if two things look alike;
        each candidate names its thing. There are none if the geometry is not known.
        """
        return tuple(
            candidate.moved(self.poses_in.from_object)
            for candidate in self._joint_poses
        )

    @property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Standard deviations of ``pose``, degrees and millimetres; None without a pose.

        They combine the precision of the registration, the probabilities of the other candidates of
        the same thing, and, in the world frame, the usual error of camera poses.
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
        """Scan of the named thing in its pose; None without a pose or a surface.

        Vertices, (V, 3) float64, in the object frame and object radii like observations; and faces,
        (F, 3).
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
    def _likeliest_in_object_frame(self) -> PoseCandidate:
        """Likeliest pose among the things of the answer's class, in the object frame."""
        label = self._candidates_of_answer[0].label
        return next(each for each in self._joint_poses if each.label == label)

    @property
    def why_no_pose(self) -> str:
        """Reason why jointly judged views determine no pose; "" if there is a pose."""
        joint = self._joint
        return joint.why_no_pose if joint is not None and self.pose is None else ""

    @property
    def joint_doubt(self) -> str:
        """Reason of the recogniser why no answer is confident whatever its belief; "" for none."""
        joint = self._joint
        return "" if joint is None else joint.doubt

    @property
    def doubt(self) -> str:
        """First reason why the result is not confident; "" if it is."""
        if self.confident:
            return ""
        if not self.seen:
            return "nothing of it is seen"
        return (
            (self.why_unknown if self.unknown else self.joint_doubt)
            or self._why_warned
            or self._why_suspicious
            or self._why_not_reached
        )

    @property
    def _why_warned(self) -> str:
        """The warning that rules out a confident answer, see ``is_doubtful``; "" for none."""
        if not is_doubtful([view.warnings for view in self.views]):
            return ""
        for warning in self.views[-1].warnings:
            if warning.holds:
                return f"warning ({warning.name}): {warning.message}"
        return "half of the views contradict others"

    @property
    def _why_suspicious(self) -> str:
        """What the p-value is and would have to be, see ``familiarity``; "" if it is enough."""
        if self.familiarity >= 1:
            return ""
        return (
            f"{self._novelty_in_words}, and a confident name needs"
            f" {100 * SUSPICIOUS * self.unknown_rate:.2g} %"
        )

    @property
    def _why_not_reached(self) -> str:
        """What the belief is and would have to be."""
        belief = self.confidence
        counted = sum(view.observation.seen for view in self.views)
        threshold = float(self.stopping.threshold_at(counted))
        if np.isinf(threshold):
            return f"belief {belief:.3f}, and the rule to stop is {self.stopping}"
        if belief < threshold:
            return f"belief {belief:.4g}, and a confident name needs {threshold:.4g}"
        return (
            f"belief {belief:.4g} is enough for the name, but the session has not ended, or its"
            " pose is not certain"
        )

    @property
    def _joint(self) -> JointBelief | None:
        """Joint belief from all views; None if views are judged separately."""
        return self.views[-1].joint if self.views else None

    @property
    def _joint_poses(self) -> tuple[PoseCandidate, ...]:
        """Candidate poses of the object, in the object frame."""
        joint = self._joint
        return () if joint is None else joint.poses

    @property
    def _explained(self) -> float | None:
        """See ``JointBelief.p_value``; None if it is not known."""
        joint = self._joint
        return None if joint is None else joint.p_value

    @property
    def _candidates_of_answer(self) -> list[PoseCandidate]:
        """Poses of things of the answer's class, most likely first; empty if unknown."""
        if self.answer is None:
            return []
        label = self.classes.index(self.answer)
        return [
            candidate for candidate in self.pose_candidates if candidate.label == label
        ]

    @property
    def travel(self) -> float:
        """Distance travelled in the whole episode, grid cells."""
        return self.views[-1].travel if self.views else 0.0

    @property
    def effort_in_words(self) -> str:
        """Describe the number of views and the camera travel between them as an angle.

        For example ``2 views, moved by 63° around it``.
        """
        views = number_of(len(self.views), "view")
        if len(self.views) < 2:
            return views
        return f"{views}, moved by {np.degrees(self.views[-1].arc):.0f}° around it"

    def __repr__(self) -> str:
        """Return one line: ``chair (belief 0.998, 2 views, moved by 63° around it, confident)``."""
        views = self.effort_in_words

        if not self.seen:
            return f"nothing is seen ({views})"
        if self.unknown:
            return f"{self.none_of_them}: {self.why_unknown} ({views})"

        sure = "confident" if self.confident else "not confident"
        if self.doubt:
            sure += f", {self.doubt}"
        if self.stranded:
            sure += ", no other view in reach"
            if self.why_stranded:
                sure += f": {self.why_stranded}"

        sure += "".join(f", no {name}: {why}" for name, why in self.ruled_out)
        names = [warning.name for warning in self.warnings]
        warnings = f", warnings: {', '.join(names)}" if names else ""
        return (
            f"{self.answer} (belief {self.confidence:.3f}, {views},"
            f" {sure}{self._place_in_words}{warnings})"
        )

    @property
    def _place_in_words(self) -> str:
        """Describe position and uncertainty; "" without a pose.

        For example ``, at [0.412, -0.103, 0.050] m in the world, ± 1.2°, 0.8 mm``.
        """
        if self.place is None:
            return ""
        return f", at {place_in_words(self.place)} in {self.poses_in}, {self.pose_uncertainty}"

    def plot(self, path: str | Path | None = None, title: str = "") -> Figure:
        """Draw the episode: images, values of the views, beliefs, and the camera path.

        The outline of the named thing's scan is drawn over the images in its pose, corrected for
        the errors of the camera positions.

        Args:
            path: output file, PNG, PDF or SVG; an existing file is replaced; None for no file.
            title: text before the heading.

        Returns:
            The figure.

        Raises:
            UsageError: the format is not supported.
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
        )
        if path is not None:
            save_figure(figure, Path(path))
        return figure
