"""The film of README.md: a real depth frame, what is seen in it, its names, and the next view.

    python workflow/film.py FOLDER [--frame NAME] [--out FILE] [--stages FOLDER]

FOLDER holds real frames that ``nextview_lab.data.real_frames`` reads; the film of README.md is of
``real_taught`` (docs/results_real_frames.md). The file is an animated WebP. ``--stages`` also
writes each stage as a PNG file.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial import ConvexHull

from nextview.figures.style import (
    ACCENT,
    BLUE,
    FIGURE_STYLE,
    INK,
    PAPER,
    WOOD,
    PlainFigure,
    heat,
    rgb,
)
from nextview.geometry.depth import headlight
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.scene.figure import (
    FIGURE_HEIGHT,
    OBJECT_COLOURS,
    draw_frame,
    grey_picture,
)
from nextview.scene.objects import UNKNOWN_NAME
from nextview.scene.scene import Scene
from nextview.sensing.frame import Frame
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Mask
from nextview.viewers.scene_shapes import colour_of, placed_shape
from nextview_lab.data.real_frames import real_frames

OUT = Path(__file__).parents[1] / "docs/images/real_frame.webp"
WIDTH = 800  # pixels
CAPTION = 0.36  # inches, the line above the picture
SHOWN, FADED = 2000, 50  # milliseconds of a stage, and of a step to the next one
STEPS = 4  # between two stages
# from where the last stage is seen: beside the way of the camera, behind it, and above; metres
BESIDE, BEHIND, ABOVE = 0.75, 1.25, 0.7
TORN = 0.015  # metres; a larger step of depth separates surfaces
FINE = 2  # rays per pixel along each axis of the last stage
FRUSTUM = 0.16  # metres, depth of the drawn pyramid of a camera
MARGIN = 0.82  # share of the last stage that cameras and things fill


def main(
    folder: tyro.conf.Positional[Path],
    frame: str = "000002",
    out: Path = OUT,
    stages: Path | None = None,
) -> None:
    """Draw the film of one frame, recognised with the bundled things.

    Args:
        folder: with real frames.
        frame: name of the frame.
        out: file of the film; an existing one is replaced.
        stages: folder for a PNG file of each stage.
    """
    (chosen,) = (one for one in real_frames(folder) if one.name == frame)
    scene = Scene("ycb", None)
    scene.update(chosen.read())
    drawn = [
        picture(f"{number}  {caption}", scene, draw)
        for number, (caption, draw) in enumerate(STAGES.items(), 1)
    ]
    if stages is not None:
        stages.mkdir(parents=True, exist_ok=True)
        for number, image in enumerate(drawn, 1):
            image.save(stages / f"{number}.png")

    frames: list[Image.Image] = []
    for image, after in zip(drawn, [*drawn[1:], drawn[0]], strict=True):
        shares = np.arange(STEPS + 1) / (STEPS + 1)
        frames += [Image.blend(image, after, share) for share in shares]
    frames[0].save(
        out,
        save_all=True,
        append_images=frames[1:],
        duration=[SHOWN, *[FADED] * STEPS] * len(drawn),
        loop=0,
        quality=80,
        method=6,
    )


def picture(
    caption: str, scene: Scene, draw: Callable[[Axes, Scene], None]
) -> Image.Image:
    """Draw a stage: a line of caption, and below it a picture of the frame's shape."""
    height, width = scene.frames[0].shape
    size = FIGURE_HEIGHT * width / height, FIGURE_HEIGHT + CAPTION
    rc = FIGURE_STYLE | {"axes.grid": False, "figure.facecolor": PAPER}
    with matplotlib.rc_context(rc):
        figure = PlainFigure(size)
        middle = 1 - CAPTION / 2 / size[1]
        figure.text(
            0.012, middle, caption, fontsize=11, weight="bold", color=BLUE, va="center"
        )
        axes = figure.add_axes((0, 0, 1, FIGURE_HEIGHT / size[1]))
        axes.axis("off")
        draw(axes, scene)
        drawn = BytesIO()
        figure.savefig(drawn, dpi=WIDTH / size[0])
    return Image.open(drawn).convert("RGB")


def depth_image(axes: Axes, scene: Scene) -> None:
    """Draw the depth, near to far; grey where there is none."""
    depth = scene.frames[0].depth
    far = float(np.quantile(depth[depth > 0], 0.98))
    axes.imshow(heat(np.where(depth > 0, -np.minimum(depth, far), np.nan)))


def segments(axes: Axes, scene: Scene) -> None:
    """Draw the surfaces and each segmented thing in a colour of its own."""
    seen = scene.tops[0].seen
    axes.imshow(grey_picture(seen.frame), cmap="gray", vmin=0, vmax=1)
    axes.imshow(tinted(seen.surface, WOOD))
    for number, mask in enumerate(seen.masks):
        if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            continue
        colour = OBJECT_COLOURS[number % len(OBJECT_COLOURS)]
        axes.imshow(tinted(mask, colour, 0.6))
        shape = ndimage.gaussian_filter(mask.astype(float), 1.5)
        axes.contour(shape, [0.5], colors=["white"], linewidths=1.2)


def tinted(mask: Mask, colour: str, share: float = 0.4) -> Float:
    """Return an image of one colour, (H, W, 4), transparent outside a mask."""
    tint = np.zeros((*mask.shape, 4))
    tint[mask] = (*matplotlib.colors.to_rgb(colour), share)
    return tint


def names(axes: Axes, scene: Scene) -> None:
    """Draw outlines, names and axes of the poses."""
    frame = scene.frames[0]
    colours = {thing.number: colour_of(thing) for thing in scene.objects}
    height, width = frame.shape
    whole = slice(0, height), slice(0, width)
    draw_frame(axes, frame, 0, scene.objects, colours, whole)


def next_view(axes: Axes, scene: Scene) -> None:
    """Draw the things, the camera and its next pose, seen from beside the camera."""
    frame = scene.frames[0]
    target = scene.target
    assert target is not None
    pyramids = [pyramid(frame, pose) for pose in (frame.camera_to_world, target)]
    things = [thing.seen_points for thing in scene.objects if thing.confident]
    beside = viewpoint(scene, target)
    pinhole = fitted(beside, np.concatenate([*pyramids, *things]), frame.shape)

    height, width = frame.shape
    axes.imshow(rendered(scene, beside, pinhole), extent=(0, width, height, 0))
    halo = [withStroke(linewidth=3.0, foreground="white")]
    ends = []
    middle = np.concatenate(things).mean(0)
    for corners, colour, label in zip(
        pyramids, (INK, ACCENT), ("camera", "next view"), strict=True
    ):
        at = pinhole.project((corners - beside[:3, 3]) @ beside[:3, :3])
        reach = np.linalg.norm(middle - corners[0]) / FRUSTUM
        wide = corners[0] + reach * (corners - corners[0])
        cone = pinhole.project((wide - beside[:3, 3]) @ beside[:3, :3])
        hull = cone[ConvexHull(cone).vertices]
        axes.add_patch(Polygon(hull, color=colour, alpha=0.08, linewidth=0))
        order = [0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1]
        axes.plot(*at[order].T, color=colour, lw=1.8, path_effects=halo)
        ends.append(at[0] if ends else at.mean(0))
        axes.text(
            at[0, 0],
            at[0, 1] - 14,
            label,
            color=colour,
            fontsize=11,
            weight="bold",
            ha="center",
            va="bottom",
            path_effects=halo,
        )
    arrow = FancyArrowPatch(
        *ends,
        connectionstyle="arc3,rad=-0.3",
        arrowstyle="-|>",
        mutation_scale=16,
        shrinkA=12,
        shrinkB=16,
        color=ACCENT,
        linewidth=1.8,
        linestyle="--",
    )
    axes.add_patch(arrow)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)


def pyramid(frame: Frame, pose: Float) -> Float:
    """Return the camera's centre and the corners of its image, (5, 3), world, metres."""
    height, width = frame.shape
    (fx, _, cx), (_, fy, cy) = frame.intrinsics[:2]
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    rays = [((x - cx) / fx, (y - cy) / fy, 1.0) for x, y in corners]
    points = FRUSTUM * np.array([(0.0, 0.0, 0.0), *rays])
    return points @ pose[:3, :3].T + pose[:3, 3]


def viewpoint(scene: Scene, target: Float) -> Float:
    """Return the pose from which the last stage is seen, (4, 4): camera left, next view right."""
    up = scene.tops[0].up
    camera = scene.frames[0].camera_to_world[:3, 3]
    middle = np.mean([thing.place for thing in scene.objects if thing.confident], 0)
    beside = np.cross(target[:3, 3] - camera, up)
    behind = camera - middle
    behind -= (behind @ up) * up
    away = ABOVE * up + BESIDE * beside / np.linalg.norm(beside)
    away += BEHIND * behind / np.linalg.norm(behind)
    pose = np.eye(4)
    forward = -away / np.linalg.norm(away)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = middle + away
    return pose


def fitted(pose: Float, points: Float, shape: tuple[int, int]) -> PinholeCamera:
    """Return a camera in a pose whose image points fill, but for a margin."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    at = local[:, :2] / local[:, 2:]
    low, high = at.min(0), at.max(0)
    size = np.array(shape[::-1])
    focal = MARGIN * float((size / (high - low)).min())
    cx, cy = size / 2 - focal * (low + high) / 2
    return PinholeCamera(focal, focal, cx, cy, width=shape[1], height=shape[0])


def rendered(scene: Scene, pose: Float, pinhole: PinholeCamera) -> NDArray[np.uint8]:
    """Render the measured surfaces and unknown things, and the scans of the known ones."""
    frame = scene.frames[0]
    top = scene.tops[0]
    table = [level.pixels for level in top.seen.levels if level.plane is top.plane]
    shapes = [(measured(frame, pixels), WOOD) for pixels in table]
    for thing in scene.objects:
        shape = None if thing.name == UNKNOWN_NAME else placed_shape(thing)
        if shape is None:
            shape = measured(frame, thing.pixels[0])
        shapes.append((shape, colour_of(thing)))

    fine = PinholeCamera(
        FINE * pinhole.fx,
        FINE * pinhole.fy,
        FINE * pinhole.cx,
        FINE * pinhole.cy,
        FINE * pinhole.width,
        FINE * pinhole.height,
    )
    caster = RayCaster([triangles for triangles, _ in shapes])
    rays = fine.rays.reshape(-1, 3) @ pose[:3, :3].T
    far, which = caster.cast(pose[:3, 3], rays)
    depth = np.where(which >= 0, far, 0).reshape(fine.height, fine.width)
    light = headlight(depth.astype(np.float32), fine.matrix).reshape(-1, 1) / 255
    colours = np.array([rgb(colour) for _, colour in shapes] + [rgb(PAPER)], float)
    image = colours[which] * np.where(which[:, None] >= 0, 0.45 + 0.55 * light, 1)
    blocks = image.reshape(pinhole.height, FINE, pinhole.width, FINE, 3)
    return blocks.mean((1, 3)).round().astype(np.uint8)


def measured(frame: Frame, mask: Mask) -> Triangles:
    """Triangulate the measured pixels of a mask, world, metres."""
    depth = np.where(mask, ndimage.median_filter(frame.depth, 5), 0)
    points = frame.pinhole.rays.reshape(-1, 3) * depth.reshape(-1, 1)
    number = np.arange(depth.size).reshape(depth.shape)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    below = depth.shape[1]
    faces = np.concatenate(
        [np.stack([a, a + below, b], 1), np.stack([b, a + below, b + below], 1)]
    )
    corners = depth.ravel()[faces]
    faces = faces[(corners.min(1) > 0) & (np.ptp(corners, axis=1) < TORN)]
    pose = frame.camera_to_world
    return points @ pose[:3, :3].T + pose[:3, 3], faces.astype(np.int32)


STAGES: dict[str, Callable[[Axes, Scene], None]] = {
    "One depth image of the camera (grey: no depth)": depth_image,
    "The network separates the things from the table": segments,
    "Names and poses; unknown if no taught thing fits": names,
    "Where to look next, to settle what is uncertain": next_view,
}


if __name__ == "__main__":
    tyro.cli(main)
