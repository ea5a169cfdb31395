"""Draw a scene: the last frame with the recognised objects, and a top view of the table."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon
from matplotlib.patheffects import withStroke
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.figures.style import (
    ACCENT,
    BLUE,
    FAINT,
    FIGURE_STYLE,
    GREY,
    INK,
    PAPER,
    PlainFigure,
)
from nextview.geometry.axes import upright_axes
from nextview.geometry.ray_caster import RayCaster
from nextview.scene.name_places import Labelled, name_places
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.sensing.frame import Frame, within
from nextview.sensing.tabletop import TableTop
from nextview.types import Float, Floats, Mask

FIGURE_HEIGHT = 4.0  # inches, of both panels: names are legible on a page
FIGURE_MARGIN = 0.25  # inches
TOP = 0.75  # inches, for the heading
OBJECT_COLOURS = (
    "#0b6e99",
    "#c4532d",
    "#4b8b3b",
    "#7a5195",
    "#b8860b",
    "#008b8b",
    "#a8326b",
    "#5c6b1f",
    "#3c5fbf",
    "#8c4a2f",
)
AXIS_COLOURS = ("#d1495b", "#3f9b4f", "#2f6fd0")  # x, y and z: red, green, blue
AXIS_LENGTH = 0.7  # as a share of the radius of a thing
NEAREST_SHADE, FARTHEST_SHADE = 0.25, 0.95  # grey levels, if the frame has no image
FIGURE_BORDER = 0.12  # metres around the contents of the top view
NAME_FONT = 10.0  # points
SMALL_FONT = 8.5  # points, of notes
POINTS = 72  # per inch
CONTEXT = (
    0.1  # margin around the objects, as a share of the height and width of the image
)
CLOSED_GAPS = 3  # pixels; gaps in the outline of an object that are closed
RELIEF_BLUR = 2.5  # pixels over which slopes are smoothed
FIGURE_CELL = 0.002  # metres, side of a cell of the top view
SHORT_CAMERA = 0.06  # length of the arrow of a camera, as a share of the panel's width


def draw_scene(
    tops: Sequence[TableTop],
    objects: Sequence[SceneObject],
    target: Float | None = None,
    title: str = "",
) -> Figure:
    """Draw the last frame with outlines, names and axes of poses, and a top view of the table.

    Args:
        tops: support surfaces of each frame, at least one.
        objects: recognised objects.
        target: next camera pose, camera-to-world, (4, 4); None for no next view.
        title: of the figure.
    """
    top = tops[-1]
    number = len(tops) - 1
    colours = {
        thing.number: GREY
        if thing.name == UNKNOWN_NAME
        else OBJECT_COLOURS[k % len(OBJECT_COLOURS)]
        for k, thing in enumerate(objects)
    }
    rc = FIGURE_STYLE | {
        "axes.grid": False,
        "figure.facecolor": PAPER,
        "axes.facecolor": PAPER,
    }
    with matplotlib.rc_context(rc):
        rows, columns = _part(
            top.frame,
            [thing.pixels.get(number) for thing in objects],
        )
        aspect = (columns.stop - columns.start) / (rows.stop - rows.start)
        width = FIGURE_HEIGHT * (aspect + 1) + 3 * FIGURE_MARGIN
        height = FIGURE_HEIGHT + TOP + FIGURE_MARGIN
        figure = PlainFigure(figsize=(width, height))
        _heading(figure, len(tops), objects, title, width, height)

        high = FIGURE_HEIGHT / height
        left = figure.add_axes(
            (
                FIGURE_MARGIN / width,
                FIGURE_MARGIN / height,
                FIGURE_HEIGHT * aspect / width,
                high,
            )
        )
        draw_frame(left, top.frame, number, objects, colours, (rows, columns))
        start = (2 * FIGURE_MARGIN + FIGURE_HEIGHT * aspect) / width
        right = figure.add_axes(
            (start, FIGURE_MARGIN / height, FIGURE_HEIGHT / width, high)
        )
        _draw_from_above(right, tops, objects, colours, target)
        above = 1 - 0.5 / height
        caption = "from above; numbered arrows: the cameras"
        figure.text(start, above, caption, fontsize=9.5, color=GREY, va="top")
        return figure


def _heading(
    figure: Figure,
    frames: int,
    objects: Sequence[SceneObject],
    title: str,
    width: float,
    height: float,
) -> None:
    """Write how many objects were found, and in how many frames."""
    named = sum(thing.name != UNKNOWN_NAME for thing in objects)
    said = f"{named} known thing{'s' * (named != 1)}"
    doubtful = sum(
        thing.name != UNKNOWN_NAME and not thing.confident for thing in objects
    )
    if doubtful:
        said += f", {doubtful} of them not confident"
    if named < len(objects):
        said += f"; {len(objects) - named} unknown"
    if not objects:
        said = "nothing on the plane"
    more = f"{title}: " if title else ""
    more += f"{frames} frame{'s' * (frames > 1)}"
    more += "; names in italics with ? are not confident" if doubtful else ""
    x = FIGURE_MARGIN / width
    figure.text(
        x,
        1 - 0.16 / height,
        said,
        fontsize=15,
        weight="bold",
        color=BLUE,
        va="top",
    )

    figure.text(x, 1 - 0.5 / height, more, fontsize=9.5, color=GREY, va="top")


def _part(frame: Frame, masks: Sequence[Mask | None]) -> tuple[slice, slice]:
    """Return the rows and columns that contain all objects, with some context around them."""
    shown = [mask for mask in masks if mask is not None]
    if not shown:
        return slice(0, frame.shape[0]), slice(0, frame.shape[1])
    margin = int(CONTEXT * max(frame.shape))
    return within(np.any(shown, axis=0), margin)


def draw_frame(
    axes: Axes,
    frame: Frame,
    number: int,
    objects: Sequence[SceneObject],
    colours: dict[int, str],
    part: tuple[slice, slice],
) -> None:
    """Draw the frame with outlines, names, and axes of the poses.

    Args:
        axes: to draw on; ``FIGURE_HEIGHT`` inches high, for the places of the names.
        frame: the frame.
        number: of the frame in the scene.
        objects: recognised objects.
        colours: of each object, by its number.
        part: rows and columns of the frame that are shown.
    """
    axes.imshow(
        grey_picture(frame),
        cmap="gray",
        vmin=0,
        vmax=1,
        interpolation="bilinear",
    )
    axes.set_xlim(part[1].start - 0.5, part[1].stop - 0.5)
    axes.set_ylim(part[0].stop - 0.5, part[0].start - 0.5)
    axes.axis("off")

    for thing in objects:
        mask = thing.pixels.get(number)
        if mask is None:
            continue
        colour = colours[thing.number]
        mask = _without_holes(mask)
        shape = ndimage.gaussian_filter(mask.astype(float), 1.5)
        style = ":" if thing.name == UNKNOWN_NAME else "-"
        axes.contour(shape, [0.5], colors=[colour], linewidths=1.8, linestyles=style)
        tint = np.zeros((*mask.shape, 4))
        tint[mask] = (*matplotlib.colors.to_rgb(colour), 0.22)
        axes.imshow(tint, interpolation="nearest")
    for thing in objects:
        if thing.pose is not None and number in thing.pixels:
            _draw_axes(axes, frame, thing)
    shown = [thing for thing in objects if number in thing.pixels]
    labels = []
    for thing in shown:
        rows, columns = np.nonzero(thing.pixels[number])
        low = np.array([columns.min(), rows.min()], float)
        high = np.array([columns.max(), rows.max()], float)
        labels.append(Labelled(_name_of(thing), low, high))
    low = np.array([part[1].start, part[0].start], float)
    high = np.array([part[1].stop, part[0].stop], float)
    font = NAME_FONT / POINTS / FIGURE_HEIGHT * float(high[1] - low[1])

    places = name_places(labels, low, high, font)
    for thing, (x, y) in zip(shown, places, strict=True):
        _name(axes, thing, x, y, colours)


def _without_holes(mask: Mask) -> Mask:
    """Close the gaps that missing depth leaves in a mask, (H, W)."""
    padded = np.pad(mask, CLOSED_GAPS)
    closed = ndimage.binary_closing(padded, iterations=CLOSED_GAPS)
    inner = (slice(CLOSED_GAPS, -CLOSED_GAPS),) * 2
    return np.asarray(ndimage.binary_fill_holes(closed[inner]))


def grey_picture(frame: Frame) -> Floats:
    """Return a grey image of a frame, (H, W), 0 to 1."""
    if frame.image is not None:
        # pale, so that outlines and names stay readable
        return 0.25 + 0.75 * frame.image / 255
    seen = frame.depth > 0
    nearest = ndimage.distance_transform_edt(
        ~seen,
        return_distances=False,
        return_indices=True,
    )
    depth = ndimage.median_filter(frame.depth[tuple(nearest)], 5)
    inverse = 1 / depth
    low, high = np.quantile(inverse, [0.02, 0.98])
    share = np.clip((inverse - low) / max(high - low, 1e-9), 0, 1)
    grey = FARTHEST_SHADE - 0.35 * share
    # shaded relief, lit from the upper left
    smooth = ndimage.gaussian_filter(depth, RELIEF_BLUR)
    down, right = np.gradient(smooth)
    pitch = smooth / frame.intrinsics[0, 0]
    lit = np.clip((down + 0.6 * right) / pitch, -3, 3) / 3
    return np.asarray(np.clip(grey - 0.16 * lit, NEAREST_SHADE, 1))


def _draw_axes(axes: Axes, frame: Frame, thing: SceneObject) -> None:
    """Draw the x, y and z axes of a scan's frame at its centre in red, green and blue."""
    pose = thing.pose
    assert pose is not None
    radius = float(np.linalg.norm(thing.size)) / 2
    ends = np.stack(
        [thing.place, *(thing.place + AXIS_LENGTH * radius * pose[:3, :3].T)]
    )
    camera = frame.camera_to_world
    in_camera = (ends - camera[:3, 3]) @ camera[:3, :3]
    if (in_camera[:, 2] < 0.01).any():
        return
    at = frame.pinhole.project(in_camera) - 0.5

    for end, colour in zip(at[1:], AXIS_COLOURS, strict=True):
        line = axes.plot(
            *np.stack([at[0], end]).T,
            color=colour,
            lw=1.8,
            solid_capstyle="round",
        )
        line[0].set_path_effects([withStroke(linewidth=3.0, foreground="white")])


def _name_of(thing: SceneObject) -> str:
    """Return the name of an object, with a question mark if it is not confident."""
    doubt = " ?" * (thing.name != UNKNOWN_NAME and not thing.confident)
    return thing.name.replace("_", " ") + doubt


def _name(
    axes: Axes,
    thing: SceneObject,
    x: float,
    y: float,
    colours: dict[int, str],
) -> None:
    """Write the name of an object, in italics if it is not confident."""
    unknown = thing.name == UNKNOWN_NAME

    axes.text(
        x,
        y,
        _name_of(thing),
        fontsize=NAME_FONT,
        color=INK if unknown else colours[thing.number],
        style="normal" if thing.confident or unknown else "italic",
        weight="bold" if thing.confident and not unknown else "normal",
        ha="center",
        va="center",
        clip_on=True,
        path_effects=[withStroke(linewidth=2.8, foreground="white")],
        zorder=20,
    )


def _draw_from_above(
    axes: Axes,
    tops: Sequence[TableTop],
    objects: Sequence[SceneObject],
    colours: dict[int, str],
    target: Float | None,
) -> None:
    """Draw the top view: objects and camera positions, metres.

    The viewing direction of the last camera points up, so that left and right match the frame
    beside it.
    """
    cameras = np.stack([top.frame.camera_to_world for top in tops])
    up = tops[0].up
    ahead = cameras[-1, :3, 2]
    behind = -ahead if abs(ahead @ up) < 0.99 else cameras[-1, :3, 1]
    front = upright_axes(up, behind)
    upright = np.stack([front[1], -front[0], front[2]])

    outlines = [seen_from_above(thing, upright) for thing in objects]
    everything = np.concatenate(
        [*(corners for corners, _ in outlines), np.zeros((0, 2))]
    )
    if not len(everything):
        everything = (cameras[:, :3, 3] + cameras[:, :3, 2]) @ upright[:2].T
    ends = np.stack([everything.min(0), everything.max(0)])
    side = float(np.ptp(ends, axis=0).max()) + 2 * FIGURE_BORDER
    low = ends.mean(0) - side / 2
    high = ends.mean(0) + side / 2

    for thing, (corners, picture) in zip(objects, outlines, strict=True):
        _draw_outline(
            axes,
            corners,
            picture,
            colours[thing.number],
            thing.name != UNKNOWN_NAME,
        )
    labels = [
        Labelled(_name_of(thing), corners.min(0), corners.max(0))
        for thing, (corners, _) in zip(objects, outlines, strict=True)
    ]
    font = NAME_FONT / POINTS / FIGURE_HEIGHT * side
    places = name_places(labels, low, high, font, inside=True)
    for thing, (x, y) in zip(objects, places, strict=True):
        _name(axes, thing, x, y, colours)

    arrows = [
        _draw_camera(axes, upright, pose, low, high, INK, str(number))
        for number, pose in enumerate(cameras, 1)
    ]
    if target is not None:
        arrows.append(_draw_camera(axes, upright, target, low, high, ACCENT, "next"))

    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(FAINT)
    _scale_bar(axes, low, side, np.array(arrows))


def seen_from_above(thing: SceneObject, upright: Float) -> tuple[Float, Mask | None]:
    """Project an object onto the plane.

    The grid of cells starts two cells before the lowest corner; its first index is along x.

    Args:
        thing: object to project.
        upright: rotation from the world to upright axes, (3, 3).

    Returns:
        The corners of its convex hull, (K, 2), metres; and the grid cells covered by its scan, None
        without a scan.
    """
    posed = thing.candidates[0] if thing.pose is not None else None
    if posed is None or posed.vertices is None or posed.faces is None:
        flat = thing.seen_points @ upright[:2].T
        try:
            return flat[ConvexHull(flat).vertices], None
        except QhullError:  # collinear points
            return flat, None
    placed = posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3]
    corners = placed @ upright.T
    low = corners[:, :2].min(0) - 2 * FIGURE_CELL
    count = (
        np.ceil((corners[:, :2].max(0) + 2 * FIGURE_CELL - low) / FIGURE_CELL).astype(
            int
        )
        + 1
    )
    at = np.stack(
        np.meshgrid(*(np.arange(n) for n in count), indexing="ij"),
        -1,
    ).reshape(-1, 2)
    start = np.column_stack(
        [low + at * FIGURE_CELL, np.full(len(at), corners[:, 2].max() + 1.0)]
    )
    caster = RayCaster([(corners, posed.faces)])
    away, _ = caster.cast(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape))

    return corners[:, :2], np.isfinite(away).reshape(count)


def _draw_outline(
    axes: Axes,
    corners: Float,
    picture: Mask | None,
    colour: str,
    known: bool,
) -> None:
    """Draw the outline of an object in the top view."""
    style = "-" if known else ":"
    if picture is None:
        face = (*matplotlib.colors.to_rgb(colour), 0.25)
        patch = Polygon(
            corners,
            closed=True,
            facecolor=face,
            edgecolor=colour,
            linewidth=1.6,
            linestyle=style,
        )
        axes.add_patch(patch)
        return

    low = corners.min(0) - 2 * FIGURE_CELL
    x, y = (low[k] + FIGURE_CELL * np.arange(picture.shape[k]) for k in (0, 1))
    shape = ndimage.gaussian_filter(picture.astype(float), 0.8).T
    axes.contourf(x, y, shape, [0.5, 2.0], colors=[colour], alpha=0.25)
    axes.contour(x, y, shape, [0.5], colors=[colour], linewidths=1.6, linestyles=style)


def _draw_camera(
    axes: Axes,
    upright: Float,
    pose: Float,
    low: Float,
    high: Float,
    colour: str,
    label: str,
) -> Float:
    """Draw an arrow at a camera position, moved to the border if it is outside.

    Args:
        axes: of the top view.
        upright: rotation from the world to the axes of the top view, (3, 3).
        pose: camera-to-world, (4, 4), metres.
        low: least x and y of the panel, metres.
        high: greatest x and y.
        colour: of the arrow.
        label: text behind the arrow.

    Returns:
        Position of the arrow, (2,).
    """
    place = upright @ pose[:3, 3]
    ahead = upright @ pose[:3, 2]
    size = float((high - low).max())
    inset = 0.07 * size
    at = np.clip(place[:2], low + inset, high - inset)
    level = np.linalg.norm(ahead[:2])
    way = ahead[:2] / level if level > 0.05 else np.array([0.0, -1.0])
    end = at + SHORT_CAMERA * size * way
    arrow = FancyArrowPatch(
        (at[0], at[1]),
        (end[0], end[1]),
        arrowstyle="-|>",
        mutation_scale=13,
        color=colour,
        linewidth=1.6,
        zorder=15,
    )
    axes.add_patch(arrow)

    behind = at - 0.03 * size * way
    axes.text(
        behind[0],
        behind[1],
        label,
        fontsize=SMALL_FONT,
        color=colour,
        ha="center",
        va="center",
        zorder=25,
        path_effects=[withStroke(linewidth=2.4, foreground="white")],
    )
    return np.asarray(at)


def _scale_bar(axes: Axes, low: Float, side: float, arrows: Float) -> None:
    """Draw a scale bar of 1 cm, 10 cm or 1 m, depending on the extent of the panel.

    The bar is in the lower corner that is farther from the camera arrows.
    """
    length = next((step for step in (0.01, 0.1, 1.0) if step > 0.08 * side), 1.0)
    words = {0.01: "1 cm", 0.1: "10 cm", 1.0: "1 m"}[length]

    starts = low + np.array([[0.04, 0.04], [0.96 - length / side, 0.04]]) * side
    middles = starts + np.array([length / 2, 0.0])
    away = np.linalg.norm(arrows[:, None] - middles, axis=2).min(0)
    start = starts[away.argmax()]

    axes.plot([start[0], start[0] + length], [start[1], start[1]], color=INK, lw=1.6)
    axes.text(
        start[0] + length / 2,
        start[1] + 0.012 * side,
        words,
        fontsize=SMALL_FONT,
        color=INK,
        ha="center",
    )
