"""Check captured frames: leave out unusable ones, and reject wrong poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.captured.frames import Capture, CapturedFrame
from nextview.captured.late_poses import Shift, find_shifts
from nextview.errors import DatasetError, ObservationError
from nextview.sensing.agreement import Agreement, SurfaceView, compare, surface_view
from nextview.sensing.camera_offsets import CameraOffset, camera_offsets
from nextview.sensing.frame import Frame
from nextview.sensing.mistakes import (
    LEAST_EXPLAINED,
    PosedViews,
    Stored,
    find_fitted,
    find_mistake,
    fitted_mistakes,
)

# largest number of frames compared with each other, evenly spread
MOST_COMPARED_FRAMES = 60
MOST_REFUSED = 0.1  # largest share of frames left out; a single one is always allowed
# A frame contradicts the others if more than this share of its points is contradicted, ...
MUCH_CONTRADICTED = 0.5
# ... or more than this share, if that is also this multiple of the usual share.
UNUSUALLY_CONTRADICTED = 0.3
TIMES_USUAL = 4.0
# contradicted share of the points above the plane if all frames are inconsistent
CONTRADICTED_IN_ALL = 0.3
FEWEST_TO_BLAME = 5  # least number of frames for single ones to be left out
NAMED_FRAMES = 3  # frames named in a message; the others are counted
COMPARED_MOMENTS = 6  # moments of several cameras that are registered: a second each
DEPTH_SOURCES = {
    "BOP": "depth_scale in scene_camera.json",
    "TUM RGB-D": "this layout, 5000 per metre",
    "7-Scenes": "this layout, 1000 per metre",
    "YCB-Video": "factor_depth in the files -meta.mat",
    "GraspNet": "factor_depth in the files of meta",
    "PCD": "the clouds, in metres",
    "ROS 2 bag": "as REP 118 has it: 16UC1 millimetres, 32FC1 metres",
}


def check_capture(
    capture: Capture,
    masked: bool = True,
) -> tuple[Capture, dict[str, str]]:
    """Find the usable frames of a capture, and check that their poses are consistent.

    Args:
        capture: its images are read.
        masked: whether the masks of the folder will be used.

    Returns:
        The capture with the usable frames, and the reasons for the others, by name.

    Raises:
        DatasetError: more than a tenth of the frames cannot be used, or they are inconsistent with
            one rigid scene; the message names the likely mistake.
    """
    refused = dict(capture.unreadable)
    compared, frames = _read_some(capture, masked, refused)
    refuse_many(capture, refused, len(capture.frames) + len(capture.unreadable))

    if capture.object_is_world:  # then only the masked pixels are static
        with_mask = [i for i, frame in enumerate(frames) if frame.mask is not None]
        compared = compared[with_mask]
        frames = [frames[i] for i in with_mask]
    if (
        capture.stands
    ):  # the scene may have changed, except between frames taken together
        together = {frame.name for frame in max(capture.moments, key=len)}
        kept = [
            i for i, row in enumerate(compared) if capture.frames[row].name in together
        ]
        compared = compared[kept]
        frames = [frames[i] for i in kept]
    if len(frames) > 1:
        refused |= _contradicting(capture, compared, frames)
        refuse_many(capture, refused, len(capture.frames) + len(capture.unreadable))

    usable = tuple(frame for frame in capture.frames if frame.name not in refused)
    return replace(capture, frames=usable), refused


def refuse_many(capture: Capture, refused: Mapping[str, str], total: int) -> None:
    """Reject a capture with too many unusable frames.

    Args:
        capture: the capture.
        refused: reasons by frame name.
        total: number of all frames.

    Raises:
        DatasetError: more than one frame and more than a tenth are unusable.
    """
    if len(refused) == total or len(refused) > max(1, MOST_REFUSED * total):
        what = f"{len(refused)} of {total} frames cannot be used"
        raise DatasetError(f"{capture.folder}: {what}: {summary(refused)}")


def summary(refused: Mapping[str, str]) -> str:
    """Summarise the unusable frames and the most frequent reason in one phrase."""
    reasons = list(refused.values())
    commonest = max(reasons, key=reasons.count)
    names = [name for name, reason in refused.items() if reason == commonest]
    listed = ", ".join(names[:NAMED_FRAMES])
    if len(names) > NAMED_FRAMES:
        listed += f" and {len(names) - NAMED_FRAMES} more"
    others = len(refused) - len(names)
    return f"{listed}: {commonest}" + (
        f"; {others} for other reasons" if others else ""
    )


def _read_some(
    capture: Capture,
    masked: bool,
    refused: dict[str, str],
) -> tuple[np.ndarray, list[Frame]]:
    """Read evenly spread frames; unreadable ones are added to ``refused``."""
    spread = _evenly_spread(capture)
    indices = []
    frames = []

    for i in spread:
        captured = capture.frames[i]
        try:
            frame = _read(captured, masked)
        except (DatasetError, ObservationError) as error:
            refused[captured.name] = str(error)
        else:
            if frame is not None:
                indices.append(i)
                frames.append(frame)

    return np.array(indices, int), frames


def _evenly_spread(capture: Capture) -> list[int]:
    """Return the indices of frames that are evenly spread over the capture.

    Those that were taken together stay together.
    """
    moments = capture.moments
    most = max(1, MOST_COMPARED_FRAMES // len(capture.cameras))
    few = np.unique(
        np.linspace(0, len(moments) - 1, min(len(moments), most)).astype(int)
    )
    names = {frame.name for k in few for frame in moments[k]}
    if capture.stands:
        names |= {frame.name for frame in max(moments, key=len)}
    return [i for i, frame in enumerate(capture.frames) if frame.name in names]


def _read(captured: CapturedFrame, masked: bool) -> Frame | None:
    """Read a frame; None if its mask is empty, which means that the object is not visible."""
    try:
        return captured.read(masked)
    except ObservationError:
        if not masked or captured.mask is None:
            raise
        captured.read(masked=False)
        return None


def _contradicting(
    capture: Capture,
    compared: np.ndarray,
    frames: list[Frame],
) -> dict[str, str]:
    """Return frames that contradict the others, with reasons; DatasetError if they are many."""
    rng = np.random.default_rng(0)
    views = [surface_view(frame, rng) for frame in frames]
    poses = np.stack([frame.pose for frame in capture.frames])
    posed = PosedViews(views, poses[compared], _stored(capture))
    fitted = fitted_mistakes(float(capture.frames[0].intrinsics[0, 0]))

    mistake = find_mistake(posed) or find_fitted(posed, fitted["focal length"])
    if mistake is not None:
        raise _disagree(capture, mistake.sentence)

    most = max(1, int(MOST_REFUSED * len(frames)))
    shifts = find_shifts(views, compared, poses)
    late = np.zeros(len(frames), bool)
    for shift in shifts:
        late[shift.first : shift.end] = True
    if late.sum() > most:
        raise _disagree(
            capture,
            " and ".join(_shift_in_words(capture, compared, shift) for shift in shifts),
        )
    refused = _late_frames(capture, compared, shifts)

    kept = np.flatnonzero(~late)
    evidence = PoseEvidence.of([views[i] for i in kept], poses[compared[kept]])
    blamed = _to_blame(evidence)
    left = np.setdiff1d(np.arange(len(kept)), list(blamed))
    most_blamed = most - int(late.sum()) if len(frames) >= FEWEST_TO_BLAME else 0
    too_many = len(blamed) > most_blamed
    too_many |= len(left) > 1 and _disagreeing(evidence, left)
    if too_many or blamed:
        offset = find_fitted(posed, fitted["offset"])
        if offset is not None:
            raise _disagree(capture, offset.sentence)
    if too_many:
        raise _unexplained(capture, compared[kept], evidence)

    for i, share in blamed.items():
        what = (
            f"it contradicts the other frames ({1 - share:.0%} of what it shows with them): was its"
            " pose lost?"
        )
        refused[capture.frames[compared[kept[i]]].name] = what
    return refused


def _stored(capture: Capture) -> Stored:
    """Return the storage conventions of a capture's layout."""
    of_bop = capture.layout == "BOP"
    return Stored(
        to_world=not of_bop,
        unit=0.001 if of_bop else 1.0,
        step=capture.frames[0].scale,
        step_told_by=(
            "--depth-scale"
            if capture.scale_given
            else DEPTH_SOURCES.get(capture.layout, "in its files")
        ),
    )


def _disagree(capture: Capture, looks: str) -> DatasetError:
    """Return the error for contradictions that a mistake explains."""
    problem = "its frames do not agree about one rigid object, and without this mistake they would"
    return DatasetError(f"{capture.folder}: {problem}: {looks}")


@dataclass(frozen=True)
class PoseEvidence:
    """Agreement of N frames.

    Attributes:
        all: of all points.
        standing: of the points above the largest plane.
    """

    all: Agreement
    standing: Agreement

    @classmethod
    def of(cls, views: Sequence[SurfaceView], poses: np.ndarray) -> "PoseEvidence":
        """Compare frames with given poses.

        Args:
            views: surfaces of the frames.
            poses: camera-to-world, (N, 4, 4).

        Returns:
            The evidence.
        """
        standing = [view.some(view.standing) for view in views]
        return cls(compare(views, poses), compare(standing, poses))


def _to_blame(evidence: PoseEvidence) -> dict[int, float]:
    """Return frames that contradict the others most, worst first, with confirmed shares."""
    kept = np.ones(len(evidence.all.confirmed), bool)
    blamed: dict[int, float] = {}
    while kept.sum() > 1:
        pairs = kept[:, None] & kept
        share = np.minimum(
            _enough_judged(evidence.all.among(pairs)),
            _enough_judged(evidence.standing.among(pairs)),
        )
        share = np.where(kept, share, 1.0)

        usual = float(np.median(1 - share[kept]))
        limit = np.clip(TIMES_USUAL * usual, UNUSUALLY_CONTRADICTED, MUCH_CONTRADICTED)
        worst = int(share.argmin())
        if 1 - share[worst] <= limit:
            break
        blamed[worst] = float(share[worst])
        kept[worst] = False
    return blamed


def _enough_judged(agreement: Agreement) -> np.ndarray:
    """Return the confirmed share of each frame, (N,); 1 if too few points were judged."""
    share, judged = agreement.of_each()
    return np.where(judged >= LEAST_EXPLAINED, share, 1.0)


def _disagreeing(evidence: PoseEvidence, left: np.ndarray) -> bool:
    """Return True if the remaining frames contradict each other about the object.

    Either all of them do, or those from some frame on contradict the earlier ones.
    """
    standing = evidence.standing.of_frames(left)
    if standing.judged >= LEAST_EXPLAINED and 1 - standing.share > CONTRADICTED_IN_ALL:
        return True
    first = _break(standing)
    return first > 0 and 1 - _across(standing, first).share > CONTRADICTED_IN_ALL


def _unexplained(
    capture: Capture,
    compared: np.ndarray,
    evidence: PoseEvidence,
) -> DatasetError:
    """Return the error for contradictions that no usual mistake explains."""
    contradicted = 1 - min(evidence.all.share, evidence.standing.share)
    problem = f"its frames do not agree about one rigid object ({contradicted:.0%} of what they "
    problem += "show in common is contradicted), and no usual mistake explains it"
    hint = "are the poses of another recording, or did the object move in between?"
    first = _break(evidence.standing)
    if len(capture.cameras) > 1:
        hint = "is the pose of a camera that of another one, or in another world?"
    elif first:
        name = capture.frames[compared[first]].name
        hint = (
            f"the frames from {name} on contradict those before: did the object or the camera's"
            " base move there?"
        )
    return DatasetError(f"{capture.folder}: {problem}: {hint}")


def _break(agreement: Agreement) -> int:
    """Return the first frame that disagrees with those before; 0 if there is none."""
    count = len(agreement.confirmed)
    best = 0
    largest = 0.0
    for first in range(2, count - 1):
        later = np.arange(count) >= first
        across = _across(agreement, first)
        within = agreement.among(later[:, None] == later)
        if min(across.judged, within.judged) < LEAST_EXPLAINED:
            continue

        wrong_across = 1 - across.share
        wrong_within = 1 - within.share
        if (
            wrong_across > TIMES_USUAL * wrong_within
            and wrong_across - wrong_within > largest
        ):
            largest = wrong_across - wrong_within
            best = first
    return best


def _across(agreement: Agreement, first: int) -> Agreement:
    """Return the agreement of the frames from one on with the earlier ones."""
    later = np.arange(len(agreement.confirmed)) >= first
    return agreement.among(later[:, None] != later)


def _late_frames(
    capture: Capture,
    compared: np.ndarray,
    shifts: Sequence[Shift],
) -> dict[str, str]:
    """Return frames that have the poses of other frames, and why they are left out."""
    refused = {}
    for shift in shifts:
        reason = f"its pose is {_frames_late(shift)}"
        for i in range(compared[shift.first], compared[shift.end - 1] + 1):
            refused[capture.frames[i].name] = reason
    return refused


def _shift_in_words(capture: Capture, compared: np.ndarray, shift: Shift) -> str:
    """Describe the frame from which, or up to which, poses are late."""
    first = capture.frames[compared[shift.first]].name
    last = capture.frames[compared[shift.end - 1]].name
    late = f"the poses are {_frames_late(shift)}"
    if shift.first == 0 and shift.end == len(compared):
        return late
    if shift.end < len(compared):
        return f"from frame {first} to {last} {late}"
    lost = "an image" if shift.frames > 0 else "a pose"
    return f"from frame {first} on {late} (was {lost} lost there?)"


def _frames_late(shift: Shift) -> str:
    """Describe by how many frames poses are late."""
    many = "one frame" if abs(shift.frames) == 1 else f"{abs(shift.frames)} frames"
    if shift.frames > 0:
        return f"{many} late: each frame has the pose of an earlier one"
    return f"{many} early: each frame has the pose of a later one"


def errors_of_cameras(capture: Capture) -> list[CameraOffset]:
    """Estimate the errors of the poses of several cameras, from some evenly spread moments.

    Args:
        capture: of several cameras; its images are read.

    Returns:
        The error of each camera relative to the first one; a camera that sees too little of what
        others see is left out.

    Raises:
        DatasetError: an image cannot be read.
    """
    moments = [frames for frames in capture.moments if len(frames) > 1]
    few = np.linspace(0, len(moments) - 1, min(len(moments), COMPARED_MOMENTS))
    return camera_offsets(
        [
            [captured.read(masked=False) for captured in moments[k]]
            for k in np.unique(few.astype(int))
        ]
    )
