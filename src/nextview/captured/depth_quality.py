"""What the depth of captured frames is good for: its noise, how flat planes are, and its scale.

What is measured along a ray is taken to be off by a factor and a constant, true = factor * measured
+ offset. A plane that posed frames see from different distances tells the factor: the heights of
the cameras above it differ, by their poses, as much as those by the right depth. The offset, which
looks as if the plane were elsewhere, is taken into account, and is not told.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nextview.captured.check import evenly_spread
from nextview.captured.frames import Capture
from nextview.files import new_file
from nextview.sensing.frame import Frame
from nextview.sensing.noise import MEDIAN_OF_NORMAL
from nextview.sensing.planes import TILT, Plane, Samples, find_plane, sample
from nextview.sensing.registration import CAMERA_AIM, CAMERA_PLACE
from nextview.types import Float

FRAMES_READ = 12  # of each camera, at most: a second
SPARSE = 101  # each so manyth pixel is asked for its depth
# metres, and such a share of the distance, between sightings of one plane
SAME_PLANE = 0.05
# standard deviations before anything is measured
FACTOR_SPREAD = 0.1
OFFSET_SPREAD = 0.02  # metres
USUAL_MISFITS = 4  # so many sightings count for the usual errors of poses
TOLD = 0.015  # largest uncertainty of a scale that is told
# pixels of single things from which on most are named, docs/your_camera.md
NAMED_PIXELS = 1000
GUIDES = {"die": 1.6, "golf ball": 4.3, "mug": 9.0, "bottle": 25.0}  # centimetres
Sighting = tuple[Plane, Samples]  # those on the plane


@dataclass(frozen=True)
class ScaleError:
    """By which share of it the depth of a camera is too long.

    Attributes:
        share: below 0 if the depth is too short.
        uncertainty: its standard deviation.
    """

    share: float
    uncertainty: float

    def __str__(self) -> str:
        share = 100 * abs(self.share)
        within = 200 * self.uncertainty
        if share <= within:
            return f"the scale of the depth is right within {share + within:.1f} %"
        long = "long" if self.share > 0 else "short"
        return f"the depth is {share:.1f} % too {long}, within {within:.1f} %"


@dataclass(frozen=True, eq=False)
class DepthQuality:
    """What the depth of some frames is like.

    Attributes:
        depths: near, middle and far depth, (3,), metres.
        noise: standard deviation of a pixel at each, (3,), metres.
        focal: focal length, pixels.
        uneven: standard deviation of the largest plane from a plane, metres; None if none is seen.
        scale: by how much that of the depth is wrong; None if that cannot be told.
    """

    depths: Float
    noise: Float
    focal: float
    uneven: float | None
    scale: ScaleError | None

    def smallest(self) -> Float:
        """Side of the smallest things of which most get a name, at each of ``depths``, metres."""
        return np.sqrt(NAMED_PIXELS) * self.depths / self.focal

    def detail(self) -> Float:
        """Smallest difference of shape that a pixel shows, at each of ``depths``, metres."""
        return 2 * np.maximum(self.noise, self.depths / self.focal)

    def sentences(self) -> list[str]:
        """What is to be said of the depth, in words."""
        said = [
            f"at {depth:.2f} m: noise {noise:.1f} mm, a pixel covers {pixel:.1f} mm; most things"
            f" get a name from {side:.1f} cm on, and two that differ by less than {detail:.0f} mm"
            " look alike"
            for depth, noise, pixel, side, detail in zip(
                self.depths,
                1000 * self.noise,
                1000 * self.depths / self.focal,
                100 * self.smallest(),
                1000 * self.detail(),
                strict=True,
            )
        ]

        if self.uneven is not None:
            said.append(f"the largest plane is flat within {1000 * self.uneven:.1f} mm")
        said.append(
            "whether the depth is too long or too short cannot be told: that takes frames with"
            " poses that see one plane from different distances, or a thing of known size"
            if self.scale is None
            else str(self.scale)
        )
        return said


def draw_quality(quality: DepthQuality, path: Path, overwrite: bool) -> None:
    """Draw which things can be told apart at which distance.

    Args:
        quality: of the depth of a camera.
        path: output file, PNG.
        overwrite: whether to replace an existing one.
    """
    from nextview.figures.style import (  # slow to import
        ACCENT,
        BLUE,
        GREY,
        legend,
        new_figure,
        to_png,
    )

    figure, axes = new_figure(5.6, 3.6)
    for size, colour, label in (
        (quality.smallest(), BLUE, "smallest thing that gets a name"),
        (quality.detail(), ACCENT, "smallest difference"),
    ):
        axes.plot(quality.depths, 100 * size, "o-", color=colour, label=label)
    axes.set_yscale("log")
    axes.set_ylim(0.05, 50)
    axes.set_yticks([0.1, 1, 10], ["1 mm", "1 cm", "10 cm"])
    axes.minorticks_off()
    for name, guide in GUIDES.items():
        axes.axhline(guide, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(
            name,
            (0, guide),
            (3, 2),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            color=GREY,
            fontsize=8.5,
        )
    axes.set_xlabel("distance, m")
    legend(axes)
    with new_file(path, overwrite) as part:
        to_png(figure, part)


def quality_of(capture: Capture, camera: str = "") -> DepthQuality:
    """Measure the depth of a camera by some of its frames, evenly spread.

    Args:
        capture: its images are read.
        camera: its name.
    """
    own = [frame for frame in capture.frames if frame.camera == camera]
    some = [own[i].read(masked=False) for i in evenly_spread(len(own), FRAMES_READ)]
    return depth_quality(some, still=not capture.object_is_world)


def depth_quality(frames: Sequence[Frame], still: bool = True) -> DepthQuality:
    """Measure the depth of some frames of one camera.

    Args:
        frames: with poses in one world, if there are several.
        still: whether what they show stands still in this world.
    """
    rng = np.random.default_rng(0)
    noises = [frame.noise for frame in frames]
    seen = np.concatenate([frame.depth[frame.depth > 0][::SPARSE] for frame in frames])
    depths = np.percentile(seen, (10, 50, 90))

    # the largest plane of each
    sightings = []
    for frame, noise in zip(frames, noises, strict=True):
        samples = sample(frame, frame.depth > 0, noise)
        plane = find_plane(samples, rng)
        if plane is not None:
            sightings.append((plane, samples.some(plane.holds(samples))))

    uneven = [
        np.median(np.abs(plane.height(samples.points))) / MEDIAN_OF_NORMAL
        for plane, samples in sightings
    ]
    return DepthQuality(
        depths,
        np.median([noise.at(depths) * depths**2 for noise in noises], axis=0),
        float(frames[0].intrinsics[0, 0]),
        float(np.median(uneven)) if uneven else None,
        _scale_error(sightings) if still else None,
    )


def _scale_error(sightings: Sequence[Sighting]) -> ScaleError | None:
    """Compare the heights of cameras above the plane that most of them see; None if too few do."""
    seen: list[Sighting] = []
    for plane, samples in sightings:
        here = [other for other in sightings if _same(plane, samples, other[0])]
        seen = max(seen, here, key=len)
    if len(seen) < 2:
        return None
    normal = np.mean([plane.normal for plane, _ in seen], axis=0)
    normal /= np.linalg.norm(normal)

    rows = []
    heights = []
    deviations = []
    for plane, samples in seen:
        above = float(plane.height(samples.camera))
        points = samples.points - samples.camera
        aside = np.linalg.norm(points.mean(0) + above * plane.normal)
        along = np.mean(above / np.linalg.norm(points, axis=1))
        rows.append([above, along, 1.0])
        heights.append(normal @ samples.camera)
        deviations.append(np.hypot(CAMERA_PLACE, CAMERA_AIM * aside))

    # the factor, the offset, and the place of the plane, with what is known of the first two before
    weighed = np.array(rows) / np.array(deviations)[:, None]
    goal = np.array(heights) / deviations
    prior = np.array([FACTOR_SPREAD, OFFSET_SPREAD, np.inf]) ** -2.0
    precision = weighed.T @ weighed + np.diag(prior)
    found = np.linalg.solve(precision, weighed.T @ goal + prior * [1, 0, 0])
    misfit = float(((weighed @ found - goal) ** 2).sum())
    usual = (USUAL_MISFITS + misfit) / (USUAL_MISFITS + max(0, len(seen) - 3))
    deviation = float(np.sqrt(usual * np.linalg.inv(precision)[0, 0]))
    return ScaleError(1 / found[0] - 1, deviation) if deviation < TOLD else None


def _same(plane: Plane, samples: Samples, other: Plane) -> bool:
    """Whether a plane is another one, by its samples."""
    apart = abs(float(other.height(samples.points.mean(0))))
    near = SAME_PLANE * (1 + float(plane.height(samples.camera)))
    return float(plane.normal @ other.normal) > TILT and apart < near
