"""Check captured frames: leave out unusable ones, and reject wrong poses."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
from scipy.optimize import minimize

from nextview.captured.frames import Capture, CapturedFrame
from nextview.captured.late_poses import FEWEST_JUDGED, explains, find_late
from nextview.errors import DatasetError, ObservationError
from nextview.sensing.agreement import Agreement, SurfaceView, compare, in_one_place
from nextview.sensing.frame import Frame
from nextview.sensing.mistakes import Mistake, PosedViews, Stored, in_poses, mistakes
from nextview.sensing.registration import CameraOffset, camera_offsets
from nextview.types import Float, Index

MOST_REFUSED = 0.1  # largest share of frames left out; a single one is always allowed
# contradicted share of what frames show in common if their poses are inconsistent
MUCH_CONTRADICTED = 0.3
TIMES_USUAL = 4.0  # of the usual share, from which on a single frame is wrong
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
    frames = {}
    for i in _evenly_spread(capture):
        captured = capture.frames[i]
        try:
            frame = _read(captured, masked)
        except (DatasetError, ObservationError) as error:
            refused[captured.name] = str(error)
        else:
            if frame is not None:
                frames[i] = frame
    total = len(capture.frames) + len(capture.unreadable)
    refuse_many(capture, refused, total)

    if capture.object_is_world:  # then only the masked pixels are static
        frames = {i: frame for i, frame in frames.items() if frame.mask is not None}
    if capture.stands:
        # the scene may have changed, except between frames taken together
        together = {frame.name for frame in max(capture.moments, key=len)}
        frames = {
            i: frame
            for i, frame in frames.items()
            if capture.frames[i].name in together
        }
    if len(frames) > 1:
        refused |= _contradicting(capture, np.array(list(frames)), [*frames.values()])
        refuse_many(capture, refused, total)
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
        what = "its only frame" if total == 1 else f"{len(refused)} of {total} frames"
        raise DatasetError(
            f"{capture.folder}: {what} cannot be used: {summary(refused)}"
        )


def summary(refused: Mapping[str, str]) -> str:
    """Summarise the unusable frames and the most frequent reason in one phrase."""
    # without the path of the frame's file, with which a reason may begin
    reasons = [
        re.sub(rf"^[^:]*{re.escape(name)}[^:]*: ", "", reason)
        for name, reason in refused.items()
    ]
    commonest = max(reasons, key=reasons.count)
    names = [
        name for name, one in zip(refused, reasons, strict=True) if one == commonest
    ]
    listed = ", ".join(names[:3])
    if len(names) > 3:
        listed += f" and {len(names) - 3} more"
    others = len(refused) - len(names)
    more = f"; {others} for other reasons" if others else ""
    return f"{listed}: {commonest}{more}"


def _evenly_spread(capture: Capture) -> list[int]:
    """Return the indices of frames that are evenly spread over the capture.

    Those that were taken together stay together.
    """
    moments = capture.moments
    # so many frames are compared with each other
    most = max(1, 60 // len(capture.cameras))
    names = {
        frame.name for k in evenly_spread(len(moments), most) for frame in moments[k]
    }
    if capture.stands:
        names |= {frame.name for frame in max(moments, key=len)}
    return [i for i, frame in enumerate(capture.frames) if frame.name in names]


def evenly_spread(count: int, most: int) -> Index:
    """Return evenly spaced numbers below a count.

    Args:
        count: above the largest number.
        most: of numbers that are returned.
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


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
    compared: Index,
    frames: Sequence[Frame],
) -> dict[str, str]:
    """Return frames that contradict the others, with reasons; DatasetError if they are many."""
    rng = np.random.default_rng(0)
    views = [SurfaceView.of(frame, rng, whole=False) for frame in frames]
    poses = np.stack([frame.pose for frame in capture.frames])
    posed = PosedViews(views, poses[compared])
    stored = _stored(capture, frames)
    found = _find_mistake(posed, stored)
    if found is not None:
        raise _disagree(capture, found.sentence, found.name)

    most = max(1, int(MOST_REFUSED * len(frames)))
    late = find_late(views, compared, poses)
    ends = [0, *(np.flatnonzero(np.diff(late)) + 1), len(late)]
    parts = [(first, end) for first, end in pairwise(ends) if late[first]]
    names = [capture.frames[i].name for i in compared]
    if np.count_nonzero(late) > most:
        words = " and ".join(_in_words(late, names, *part) for part in parts)
        raise _disagree(capture, words, "late poses")
    refused = {
        capture.frames[i].name: f"its pose is {_frames_late(late[first])}"
        for first, end in parts
        for i in range(compared[first], compared[end - 1] + 1)
    }

    kept = np.flatnonzero(late == 0)
    agreements = [
        compare(some, posed.poses[kept])
        for some in (
            [views[i] for i in kept],
            [views[i].of_standing() for i in kept],
        )
    ]
    blamed = _to_blame(agreements)
    left = np.ones(len(kept), bool)
    left[list(blamed)] = False
    first, across = _break(agreements[1].among(left[:, None] & left))
    standing = agreements[1].among(left[:, None] & left)
    # a single frame is left out only where several others agree
    too_many = len(blamed) > (most - (late != 0).sum() if len(frames) >= 5 else 0)
    too_many |= max(_wrong(standing), across) > MUCH_CONTRADICTED
    if too_many or blamed:
        of_single_poses = [
            one.of_single_pose(int(row), names[row])
            for row in kept[sorted(blamed)]
            for one in in_poses(stored.to_world)
            if len(blamed) <= most
        ]
        single = _likeliest(posed, of_single_poses, stored.median_depth)
        if single and too_many:
            raise _disagree(capture, single.sentence, single.name)
        offset = "" if single else _find_offset(posed)
        if offset:
            raise _disagree(capture, offset, "camera offset")
    if too_many:
        wrong = max(one.wrong for one in agreements)
        first, _ = _break(agreements[1])
        hint = "are the poses of another recording, or did the object move in between?"
        if len(capture.cameras) > 1:
            hint = "is the pose of a camera that of another one, or in another world?"
        elif first:
            hint = (
                f"the frames from {names[kept[first]]} on contradict those before: did the object"
                " or the camera's base move there?"
            )
        raise DatasetError(
            f"{capture.folder}: its frames do not agree about one rigid object ({wrong:.0%} of what"
            " they show in common is contradicted), and no usual mistake explains it: "
            + hint
        )
    for i, share in blamed.items():
        refused[names[kept[i]]] = (
            f"it contradicts the other frames ({share:.0%} of what it shows with them): was its"
            " pose lost?"
        )
    return refused


def _stored(capture: Capture, frames: Sequence[Frame]) -> Stored:
    """Return the storage conventions of a capture's layout."""
    of_bop = capture.layout == "BOP"
    told_by = DEPTH_SOURCES.get(capture.layout, "in its files")
    return Stored(
        focal_length=float(capture.frames[0].intrinsics[0, 0]),
        median_depth=float(
            np.median([np.median(frame.depth[frame.depth > 0]) for frame in frames])
        ),
        to_world=not of_bop,
        unit=0.001 if of_bop else 1.0,
        step=capture.frames[0].scale,
        step_told_by="--depth-scale" if capture.scale_given else told_by,
    )


def _disagree(capture: Capture, looks: str, kind: str) -> DatasetError:
    """Return the error for contradictions that a mistake explains."""
    problem = "its frames do not agree about one rigid object, and without this mistake they would"
    return DatasetError(f"{capture.folder}: {problem}: {looks}", kind)


def _find_mistake(posed: PosedViews, stored: Stored) -> Mistake | None:
    """Return the mistake without which frames agree much better; single ones before pairs."""
    as_read = compare(posed.views, posed.poses)
    # correct poses of a real camera leave half of this share contradicted
    if as_read.judged > 0.25 * _judgeable(posed.views) and as_read.wrong < 0.05:
        return None

    single = mistakes(stored)
    found = _likeliest(posed, single, stored.median_depth)
    if found is not None:
        return found

    # pairs take longer: among few frames first
    pairs = (
        one.with_another(other)
        for one, other in combinations([one for one in single if one.combines], 2)
        if not {*one.name.split()} & {*other.name.split()}
    )
    few = _some(posed)
    found = _likeliest(few, pairs, stored.median_depth)
    return found and _likeliest(posed, [found], stored.median_depth)


def _some(posed: PosedViews) -> PosedViews:
    """Return frames among which a search is fast."""
    rows = evenly_spread(len(posed.views), 20)
    return PosedViews([posed.views[row] for row in rows], posed.poses[rows])


def _likeliest(
    posed: PosedViews, tried: Iterable[Mistake], middle: float
) -> Mistake | None:
    """Return the mistake whose correction explains most, if it explains enough.

    Args:
        posed: frames and poses as read.
        tried: candidates.
        middle: median depth of the frames, metres.
    """
    before = compare(posed.views, posed.poses)
    best = None
    most = 0.0
    for mistake in tried:
        right = mistake.undone(posed)
        if in_one_place(right.poses, middle):
            continue
        after = compare(right.views, right.poses)
        # Usual calibration errors leave .12; for real frames with shuffled poses, no mistake leaves
        # less than .8.
        if after.judged < FEWEST_JUDGED or after.wrong > 0.25:
            continue
        # or the frames as read look past each other
        past = before.judged < 0.25 * after.judged
        past &= after.judged > 0.25 * _judgeable(posed.views)
        if after.nats.sum() > most and (past or explains(before, after)):
            most = float(after.nats.sum())
            best = mistake
    return best


def _judgeable(views: Sequence[SurfaceView]) -> float:
    """Return the number of judgements if all frames saw all points, with both tolerances."""
    return 2.0 * sum(len(view.points) for view in views) * (len(views) - 1)


def _find_offset(posed: PosedViews) -> str:
    """Find the constant offset of the camera without which frames agree; "" for none."""

    def moved(some: PosedViews, offset: Float) -> Agreement:
        poses = some.poses.copy()
        poses[:, :3, 3] += poses[:, :3, :3] @ offset
        return compare(some.views, poses)

    few = _some(posed)

    def contradicted(offset: Float) -> float:
        return moved(few, offset).wrong

    starts = np.stack(np.meshgrid(*[(-0.08, 0.0, 0.08)] * 3), -1).reshape(-1, 3)
    start = starts[int(np.argmin([contradicted(offset) for offset in starts]))]
    simplex = start + 0.03 * np.eye(4, 3, -1)
    found = minimize(
        contradicted,
        start,
        method="Nelder-Mead",
        options={"maxfev": 120, "initial_simplex": simplex, "xatol": 1e-3},
    ).x
    large = np.linalg.norm(found) >= 0.02  # smaller ones are calibration errors
    if not large or not explains(
        compare(posed.views, posed.poses), moved(posed, found)
    ):
        return ""
    where = ", ".join(f"{value:+.2f}" for value in found)
    return (
        f"the camera stands some {100 * np.linalg.norm(found):.0f} cm beside its poses, the same"
        f" way in all frames ({where} m along its axes x right, y down, z forward): is the hand-eye"
        " calibration missing or wrong?"
    )


def _wrong(agreement: Agreement) -> float:
    """Return the contradicted share of some frames; 0 if too little was judged."""
    return agreement.wrong if agreement.judged >= FEWEST_JUDGED else 0.0


def _to_blame(agreements: Sequence[Agreement]) -> dict[int, float]:
    """Return frames that contradict the others most, worst first, with contradicted shares.

    Args:
        agreements: of all points, and of those above the largest plane.
    """
    kept = np.ones(len(agreements[0].confirmed), bool)
    blamed: dict[int, float] = {}
    while kept.sum() > 1:
        pairs = kept[:, None] & kept
        own = np.eye(len(kept), dtype=bool)
        wrong = np.array(
            [
                max(
                    _wrong(one.among(pairs & (row[:, None] | row)))
                    for one in agreements
                )
                for row in own
            ]
        )

        usual = float(np.median(wrong[kept]))
        worst = int(wrong.argmax())
        if wrong[worst] <= np.clip(TIMES_USUAL * usual, MUCH_CONTRADICTED, 0.5):
            break
        blamed[worst] = float(wrong[worst])
        kept[worst] = False
    return blamed


def _break(agreement: Agreement) -> tuple[int, float]:
    """Return the first frame that disagrees with those before, and how much; 0 for none."""
    count = len(agreement.confirmed)
    best = 0, 0.0
    largest = 0.0
    for first in range(2, count - 1):
        later = np.arange(count) >= first
        across = agreement.among(later[:, None] != later)
        within = agreement.among(later[:, None] == later)
        if min(across.judged, within.judged) < FEWEST_JUDGED:
            continue
        more = across.wrong - within.wrong
        if across.wrong > TIMES_USUAL * within.wrong and more > largest:
            largest = more
            best = first, across.wrong
    return best


def _frames_late(late: int) -> str:
    """Describe by how many frames poses are late."""
    many = "one frame" if abs(late) == 1 else f"{abs(late)} frames"
    if late > 0:
        return f"{many} late: each frame has the pose of an earlier one"
    return f"{many} early: each frame has the pose of a later one"


def _in_words(late: Index, names: Sequence[str], first: int, end: int) -> str:
    """Describe the frame from which, or up to which, poses are late."""
    what = f"the poses are {_frames_late(late[first])}"
    if first == 0 and end == len(late):
        return what
    if end < len(late):
        return f"from frame {names[first]} to {names[end - 1]} {what}"
    lost = "an image" if late[first] > 0 else "a pose"
    return f"from frame {names[first]} on {what} (was {lost} lost there?)"


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
    return camera_offsets(
        [
            [captured.read(masked=False) for captured in moments[k]]
            for k in evenly_spread(len(moments), 6)  # a second each
        ]
    )
