"""Check captured frames: leave out and count what cannot be used, and refuse poses that cannot be right."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nextview.errors import DatasetError, ObservationError
from nextview.sensing.agreement import Agreement, compare, surface_view
from nextview.sensing.frame import Frame
from nextview.simulation.captured import Capture, CapturedFrame
from nextview.simulation.pose_mistakes import (
    FEWEST_JUDGED,
    UNIT_NAMES,
    Posed,
    PoseMistake,
    find_mistake,
)

MOST_COMPARED = 60  # frames of a capture that are compared with each other, evenly spread
MOST_REFUSED = 0.1  # share of the frames that may be left out; a single one always may
CONTRADICTED_SHARE = 0.5  # a frame of which less is confirmed contradicts the others
FEWEST_TO_BLAME = 5  # frames of which one may be blamed if they disagree
PLAUSIBLE_DEPTH = (0.05, 15.0)  # metres that a capture of an object may have as its median depth
NEVER_A_DEPTH = 25  # times by which a depth scale is hardly ever wrong, and a unit of length often
NAMED_FRAMES = 3  # frames that are named in a sentence; of others the number is told
DEPTH_SOURCES = {
    "BOP": "depth_scale in scene_camera.json",
    "TUM RGB-D": "this layout, 5000 per metre",
    "7-Scenes": "this layout, 1000 per metre",
}


def check_capture(capture: Capture, masked: bool = True) -> tuple[Capture, dict[str, str]]:
    """Find out which frames of a capture can be used, and whether their poses fit together.

    Args:
        capture: its images are read.
        masked: whether the masks of the folder will be used.

    Returns:
        The capture with the frames that can be used, and why the others cannot, by name.

    Raises:
        DatasetError: more than a tenth of the frames cannot be used, or what they show does not
            agree about one rigid scene: what it looks like, in one sentence.
    """
    refused = dict(capture.unreadable)
    compared, frames = _read_some(capture, masked, refused)
    refuse_many(capture, refused, len(capture.frames) + len(capture.unreadable))

    if capture.object_is_world:  # then only masks tell what does not move
        with_mask = [i for i, frame in enumerate(frames) if frame.mask is not None]
        compared = compared[with_mask]
        frames = [frames[i] for i in with_mask]
    if len(frames) > 1:
        refused |= _contradicting(capture, compared, frames)
        refuse_many(capture, refused, len(capture.frames) + len(capture.unreadable))

    usable = tuple(frame for frame in capture.frames if frame.name not in refused)
    return replace(capture, frames=usable), refused


def refuse_many(capture: Capture, refused: Mapping[str, str], total: int) -> None:
    """Raise DatasetError if more than a tenth of so many frames, and more than one, are refused."""
    if len(refused) == total or len(refused) > max(1, MOST_REFUSED * total):
        what = f"{len(refused)} of {total} frames cannot be used"
        raise DatasetError(f"{capture.folder}: {what}: {summary(refused)}")


def summary(refused: Mapping[str, str]) -> str:
    """Which frames are refused and why, in one phrase; of many reasons the commonest."""
    reasons = list(refused.values())
    commonest = max(reasons, key=reasons.count)
    names = [name for name, reason in refused.items() if reason == commonest]
    listed = ", ".join(names[:NAMED_FRAMES])
    if len(names) > NAMED_FRAMES:
        listed += f" and {len(names) - NAMED_FRAMES} more"
    others = len(refused) - len(names)
    return f"{listed}: {commonest}" + (f"; {others} for other reasons" if others else "")


def _read_some(capture: Capture, masked: bool, refused: dict[str, str]) -> tuple[np.ndarray, list[Frame]]:
    """Read frames that are spread evenly; those that cannot be read are added to ``refused``."""
    count = len(capture.frames)
    spread = np.unique(np.linspace(0, count - 1, min(count, MOST_COMPARED)).astype(int))
    indices, frames = [], []
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


def _read(captured: CapturedFrame, masked: bool) -> Frame | None:
    """A frame; None if its mask is empty: then it does not show the object, which is no mistake."""
    try:
        return captured.read(masked)
    except ObservationError:
        if not masked or captured.mask is None:
            raise
        captured.read(masked=False)
        return None


def _contradicting(capture: Capture, compared: np.ndarray, frames: list[Frame]) -> dict[str, str]:
    """Frames that contradict the others and why; DatasetError if it is not only a few."""
    rng = np.random.default_rng(0)
    views = [surface_view(frame, rng) for frame in frames]
    poses = np.stack([frame.pose for frame in capture.frames])
    unit = 0.001 if capture.layout == "BOP" else 1.0
    posed = Posed(views, compared, poses, capture.layout != "BOP", unit)

    agreement = compare(views, posed.as_read())
    mistake = find_mistake(posed, agreement)
    if mistake is not None:
        depth = float(np.median([np.median(v.points[:, 2]) for v in views if len(v.points)]))
        looks = _in_words(capture, mistake, depth, unit)
        problem = "its frames do not agree about one rigid object, and without this mistake they would"
        raise DatasetError(f"{capture.folder}: {problem}: {looks}")

    blamed = _to_blame(agreement)
    if not blamed:
        return {}
    if len(frames) < FEWEST_TO_BLAME or len(blamed) > max(1, MOST_REFUSED * len(frames)):
        contradicted = 1 - agreement.share
        problem = f"its frames do not agree about one rigid object ({contradicted:.0%} of what they "
        problem += "show in common is contradicted), and no usual mistake explains it"
        hint = "are the poses of another recording, or did the object move in between?"
        raise DatasetError(f"{capture.folder}: {problem}: {hint}")
    return {
        capture.frames[compared[i]].name: f"it contradicts the other frames ({1 - share:.0%} of "
        "what it shows with them): was its pose lost?"
        for i, share in blamed.items()
    }


def _to_blame(agreement: Agreement) -> dict[int, float]:
    """Frames of which most is contradicted, the worst first, with the share that is confirmed."""
    kept = np.ones(len(agreement.confirmed), bool)
    blamed: dict[int, float] = {}
    while kept.any():
        share, judged = agreement.among(kept[:, None] & kept).of_each()
        share = np.where(kept & (judged >= FEWEST_JUDGED), share, 1.0)
        worst = int(share.argmin())
        if share[worst] >= CONTRADICTED_SHARE:
            break
        blamed[worst] = float(share[worst])
        kept[worst] = False
    return blamed


def _in_words(capture: Capture, mistake: PoseMistake, depth: float, unit: float) -> str:
    """What a mistake looks like; of a scale whether it is that of the translations or of the depth."""
    if mistake.scale == 1:
        return mistake.sentence
    said = [mistake.sentence] if mistake.sentence else []
    return " and ".join([*said, _scale_in_words(capture, mistake.scale, depth, unit)])


def _scale_in_words(capture: Capture, scale: float, depth: float, unit: float) -> str:
    """Translations have to be multiplied by a scale, or depths, of some median, divided by it."""
    other = min(UNIT_NAMES, key=lambda each: abs(np.log(each / (unit * scale))))
    translations = ""
    if abs(np.log(other / (unit * scale))) < 0.01:
        expected = "millimetres" if capture.layout == "BOP" else "metres"
        translations = f"the translations are in {UNIT_NAMES[other]}, where {expected} are expected"

    times = scale if scale > 1 else 1 / scale
    step = 1000 * capture.frames[0].scale
    depths = f"the depth is {times:g} times too {'large' if scale > 1 else 'small'}: its steps are of "
    depths += f"{step / scale:.3g} mm, not of {step:.3g} mm ({DEPTH_SOURCES.get(capture.layout, 'in its files')})"

    plausible = PLAUSIBLE_DEPTH[0] <= depth <= PLAUSIBLE_DEPTH[1]
    if translations and plausible and times >= NEVER_A_DEPTH:
        return translations
    if translations and plausible:
        return f"{depths}; or {translations}"
    return depths
