"""Draw an episode: views, beliefs, values of the candidate views, and the camera path."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill, shorten
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Wedge
from matplotlib.patheffects import withStroke
from scipy.ndimage import label

from nextview.errors import UsageError
from nextview.figures.soft_light import SoftLight
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
from nextview.files import new_file
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles
from nextview.geometry.viewsphere import (
    Viewpoints,
    ViewSphere,
    great_circle,
    look_at_origin,
)
from nextview.recognition.belief import Stopping
from nextview.session.view import View
from nextview.types import Float, Floats, Index, Mask

# inches: width of a column, gap between columns, and largest size of the large panel
COLUMN_WIDTH = 2.2
COLUMN_GAP = 0.3
LARGE_PICTURE = 6.0
CLASSES_SHOWN = 4  # classes
FIGURE_FORMATS = (".png", ".pdf", ".svg")
# parts and holes below this share of the silhouette are artefacts of the scan
SPECK_SHARE = 0.002
# colours of the view dome: its lines and its candidate views
RING = "#cdbfa6"
RIM = "#a8977a"
VALUES = LinearSegmentedColormap.from_list("value", ["#f1e9da", "#9cc3dc", BLUE])
# distances of the drawn candidate views and of the virtual camera, object radii
DOME = 1.35
FIGURE_DISTANCE = 10.0
NUMBER: dict[str, Any] = {
    "ha": "center",
    "va": "center_baseline",
    "color": "white",
    "weight": "bold",
}


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a PNG, PDF or SVG file. The file is written completely or not at all.

    Args:
        figure: the figure.
        path: of the file; an existing file is replaced.

    Raises:
        UsageError: the format is not supported.
        ResultsError: the path is a link or a folder, or cannot be written.
    """
    if path.suffix.lower() not in FIGURE_FORMATS:
        raise UsageError(f"{path}: a figure is written as {', '.join(FIGURE_FORMATS)}")
    with new_file(path, overwrite=True) as part:
        try:
            figure.savefig(part, dpi=120)
        except ValueError as error:
            raise UsageError(
                f"{path}: the figure cannot be written ({error})"
            ) from None


@matplotlib.rc_context(
    FIGURE_STYLE
    | {"axes.grid": False, "figure.facecolor": PAPER, "axes.facecolor": PAPER}
)
def draw_episode(
    views: Sequence[View],
    classes: Sequence[str],
    sphere: Viewpoints,
    stopping: Stopping,
    heading: str,
    posed: Triangles | None = None,
) -> Figure:
    """Draw a column for each view, and beside them the object and the camera path.

    Each column shows the image, the belief, and the values that the policy assigns to the candidate
    views.

    Args:
        views: of the episode, in order.
        classes: names of the classes.
        sphere: the candidate views.
        stopping: the rule that ended the episode.
        heading: of the figure.
        posed: surface whose outline is drawn over the images, object frame, object radii; None for
            none.

    Returns:
        The figure.
    """
    caster = None if posed is None else RayCaster([posed])
    valued = any(view.values is not None for view in views)
    light = SoftLight([view.observation for view in views])
    path = np.array([view.direction for view in views])
    seen_from = _best_side(path)
    rows = [
        ("", COLUMN_WIDTH),
        ("what it believes", 1.5),
        ("values of views", COLUMN_WIDTH),
    ]
    rows = rows if valued else rows[:2]
    large = LARGE_PICTURE if valued else LARGE_PICTURE - 1
    width = COLUMN_GAP + len(views) * (COLUMN_WIDTH + COLUMN_GAP) + large + COLUMN_GAP
    said, _, more = (
        heading.rpartition(" (") if heading.endswith(")") else (heading, "", "")
    )
    said = fill(said, int(7.6 * width))
    more = fill(more[:-1], int(11 * width))
    top = 0.42 + 0.27 * said.count("\n") + 0.24 * (more.count("\n") + 1)
    height = top + sum(0.42 + high for _, high in rows) + 0.2
    figure = PlainFigure(figsize=(width, height))
    figure.text(
        COLUMN_GAP / width,
        1 - 0.2 / height,
        said,
        fontsize=16,
        weight="bold",
        color=BLUE,
        va="top",
    )
    figure.text(
        COLUMN_GAP / width,
        1 - (top - 0.08) / height,
        more,
        fontsize=10,
        color=GREY,
        va="bottom",
    )
    shown = np.argsort(-np.max([view.belief for view in views], axis=0), kind="stable")[
        :CLASSES_SHOWN
    ]

    def axes(x: float, y: float, wide: float, high: float) -> Axes:
        made = figure.add_axes((x / width, y / height, wide / width, high / height))
        made.axis("off")
        return made

    y = height - top
    for title, high in rows:
        y -= 0.42 + high
        figure.text(
            COLUMN_GAP / width,
            (y + high + 0.1) / height,
            title,
            fontsize=10,
            color=GREY,
        )
        if title == rows[-1][0] and valued:
            _draw_scale(axes(COLUMN_GAP + 1.1, y + high + 0.08, 1.3, 0.15))
        for k, view in enumerate(views):
            axis = axes(
                COLUMN_GAP + k * (COLUMN_WIDTH + COLUMN_GAP),
                y,
                COLUMN_WIDTH,
                high,
            )
            if title == rows[0][0]:
                _draw_image(axis, view, k + 1, light)
                if caster is not None:
                    _draw_outline(axis, view, caster)
            elif title == rows[1][0]:
                _draw_belief(
                    axis,
                    view,
                    float(stopping.threshold_at(k + 1)),
                    classes,
                    shown,
                )
            else:
                _draw_values(axis, views[: k + 1], sphere, seen_from)
    x = COLUMN_GAP + len(views) * (COLUMN_WIDTH + COLUMN_GAP)
    figure.text(
        x / width,
        (height - top - 0.32) / height,
        "where it looked from",
        fontsize=10,
        color=GREY,
    )
    _draw_path(
        axes(x, y, large, height - top - 0.42 - y),
        path,
        sphere,
        light,
        seen_from,
    )
    return figure


def _best_side(path: Float) -> float:
    """Return the azimuth, radians, from which the camera path is best visible."""
    found = []
    for azimuth in np.radians(np.arange(20, 380, 45)):
        pose = look_at_origin(np.radians(25), azimuth, FIGURE_DISTANCE)
        facing = path @ pose[:3, 3] / FIGURE_DISTANCE
        flat = path @ pose[:3, :2]
        apart = [
            float(np.linalg.norm(a - b)) for a, b in itertools.combinations(flat, 2)
        ]
        found.append((min([*apart, 0.6]) - ((facing - 0.8) ** 2).mean(), azimuth))
    return float(max(found)[1])


def _draw_image(axis: Axes, view: View, step: int, light: SoftLight) -> None:
    """Draw the object as seen in a view: the camera image if there is one, else shaded depth."""
    seen = view.observation
    elevation, azimuth = view.angles
    times = (
        1
        if seen.image is not None and not seen.exact
        else max(1, round(400 / max(seen.depth.shape)))
    )

    height, width = seen.depth.shape
    larger = seen.intrinsics * [[times], [times], [1]]
    pixels, _ = light.picture(
        [light.surfaces[step - 1]],
        seen.pose,
        larger,
        (times * height, times * width),
    )
    if times == 1 and seen.image is not None:
        taken = seen.image[..., None] / 255 * (255, 250, 240)
        pixels = np.where(seen.depth[..., None] > 0, taken, pixels).astype(np.uint8)
    axis.imshow(pixels, interpolation="antialiased")

    inside: dict[str, Any] = {"transform": axis.transAxes, "fontsize": 9}
    axis.text(
        0.05,
        1.08,
        str(step),
        **inside,
        **NUMBER,
        bbox={"boxstyle": "circle,pad=0.25", "color": BLUE},
    )
    where = f"view {view.index}: {round(elevation)}° up, {round(azimuth) % 360}° around"
    axis.text(0.13, 1.08, where, va="center_baseline", color=INK, **inside)

    said = [] if seen.seen else ["nothing is seen"]
    said += [warning.name for warning in view.warnings]
    axis.text(0.04, 0.03, "\n".join(said), va="bottom", color=ACCENT, **inside)


def _draw_outline(
    axis: Axes,
    view: View,
    caster: RayCaster,
) -> None:
    """Draw the outline of a surface over the image of a view."""
    seen = view.observation
    height, width = axis.get_images()[0].get_size()
    shape = (int(height), int(width))
    times = shape[0] / seen.depth.shape[0]
    rays = PinholeCamera.of(
        seen.intrinsics * [[times], [times], [1]],
        shape,
    ).rays.reshape(-1, 3)

    along = rays @ seen.pose[:3, :3].T.astype(np.float32)
    depth, _ = caster.cast(seen.pose[:3, 3], along)
    shows = without_specks(np.isfinite(depth).reshape(shape))
    if shows.any() and not shows.all():
        drawn = axis.contour(shows, levels=[0.5], colors=[ACCENT], linewidths=1.3)
        drawn.set_path_effects([withStroke(linewidth=2.8, foreground=PAPER)])


def without_specks(silhouette: Mask) -> Mask:
    """Remove tiny parts from a silhouette, (H, W), and fill its tiny holes."""
    least = SPECK_SHARE * silhouette.sum()
    cleaned = silhouette.copy()
    for shows in (True, False):
        parts, _ = label(cleaned == shows)
        tiny = np.bincount(parts.ravel()) < least
        tiny[0] = False  # label 0 is the complement
        cleaned[tiny[parts]] = not shows
    return cleaned


def _draw_belief(
    axis: Axes,
    view: View,
    threshold: float,
    classes: Sequence[str],
    shown: Index,
) -> None:
    """Draw a bar for each listed class, with a mark at the stopping threshold."""
    best = int(view.belief.argmax())
    at = 0.015 + 0.97 * threshold

    for row, c in enumerate([*shown, *[best][: best not in shown]]):
        share = float(view.belief[c])
        colour = BLUE if c == best else GREY
        axis.text(
            0,
            row - 0.22,
            shorten(classes[c].replace("_", " "), 26, placeholder="…"),
            fontsize=10,
        )
        axis.text(1, row - 0.22, f"{100 * share:.0f} %", fontsize=10, ha="right")
        axis.plot(
            [0.015, 0.985],
            [row, row],
            color=FAINT,
            linewidth=5,
            solid_capstyle="round",
        )
        if share >= 0.005:
            axis.plot(
                [0.015, 0.015 + 0.97 * share],
                [row, row],
                color=colour,
                linewidth=5,
                solid_capstyle="round",
            )
        if np.isfinite(threshold):
            axis.plot([at, at], [row - 0.14, row + 0.14], color=INK, linewidth=1.6)
    if np.isfinite(threshold):  # custom stopping rules may have no threshold
        enough = f"enough: {100 * threshold:.0f} %"
        axis.text(
            min(at + 0.02, 1),
            row + 0.72,
            enough,
            fontsize=8.5,
            color=GREY,
            ha="right",
        )
    axis.set(xlim=(0, 1), ylim=(CLASSES_SHOWN - 0.2, -0.62))


def _draw_values(
    axis: Axes,
    views: Sequence[View],
    sphere: Viewpoints,
    seen_from: float,
) -> None:
    """Draw the dome of candidate views from above, coloured by value."""
    view = views[-1]
    turned = sphere.azimuth - seen_from - np.pi / 2
    out = 90 - np.degrees(sphere.elevation)

    values = np.full(len(sphere), np.nan) if view.values is None else view.values
    known = np.isfinite(values)
    low, high = (
        (values[known].min(), values[known].max()) if known.any() else (0.0, 1.0)
    )
    colours = np.where(
        known[:, None],
        VALUES((values - low) / (high - low or 1)),
        to_rgba("#ece9e3"),
    )

    flat = np.stack([out * np.cos(turned), out * np.sin(turned)], 1)
    limit = max(97.0, float(out.max()) + 10)
    if isinstance(sphere, ViewSphere):
        farthest = _draw_cells(axis, sphere, np.degrees(turned), colours)
        limit = max(limit, farthest + 2)
    else:
        axis.scatter(
            flat[:, 0],
            flat[:, 1],
            c=colours,
            s=float(np.clip(7000 / len(sphere), 6, 130)),
            edgecolor=PAPER,
        )

    for step, past in enumerate(views, 1):
        axis.add_patch(
            Circle(
                flat[past.index],
                8,
                facecolor=BLUE if past is view else GREY,
                edgecolor=PAPER,
            )
        )
        axis.text(
            flat[past.index, 0],
            flat[past.index, 1],
            str(step),
            fontsize=8,
            **NUMBER,
        )

    axis.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    if view.next_view is None:
        axis.text(
            0,
            1.05,
            "the last view",
            fontsize=10,
            color=GREY,
            transform=axis.transAxes,
        )
        return

    here = flat[view.index]
    there = flat[view.next_view]
    axis.add_patch(Circle(there, 8, facecolor=PAPER, edgecolor=ACCENT, linewidth=2.2))
    side = 1 if there[1] >= here[1] else -1
    for name, at, colour, off in (
        ("here", here, BLUE, -17 * side),
        ("next", there, ACCENT, 17 * side),
    ):
        axis.text(
            at[0],
            at[1] + off,
            name,
            fontsize=9,
            weight="bold",
            color=colour,
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=3, foreground=PAPER)],
        )


def _draw_cells(
    axis: Axes,
    sphere: ViewSphere,
    angles: Floats,
    colours: Floats,
) -> float:
    """Draw a coloured cell around each view of a grid.

    Returns the angle from the zenith that the cells reach, degrees.
    """
    out = 90 - np.degrees(sphere.elevation)
    rings = np.sort(90 - np.asarray(sphere.elevations, float))
    between = (rings[1:] + rings[:-1]) / 2
    first = 9.0
    last = 9.0
    if len(rings) > 1:
        first = between[0] - rings[0]
        last = rings[-1] - between[-1]
    edges = np.array([max(rings[0] - first, 0), *between, rings[-1] + last])

    half = 180 / sphere.azimuths
    for radius, angle, colour in zip(out, angles, colours, strict=True):
        inner, outer = edges[np.searchsorted(edges, radius) - 1 :][:2]
        shape: dict[str, Any] = {
            "width": outer - inner,
            "facecolor": colour,
            "edgecolor": PAPER,
            "linewidth": 1.2,
        }
        axis.add_patch(Wedge((0, 0), outer, angle - half, angle + half, **shape))
    return float(edges[-1])


def _draw_scale(axis: Axes) -> None:
    """Draw the colour scale of the values, from low to high."""
    axis.imshow(
        VALUES(np.linspace(0, 1, 64))[None],
        aspect="auto",
        extent=(0.25, 0.72, 0, 1),
    )
    axis.set(xlim=(0, 1), ylim=(0, 1))
    axis.text(
        0.22,
        0.5,
        "low",
        fontsize=9,
        color=GREY,
        ha="right",
        va="center_baseline",
    )

    axis.text(
        0.75,
        0.5,
        "high",
        fontsize=9,
        color=GREY,
        ha="left",
        va="center_baseline",
    )


def _draw_path(
    axis: Axes,
    path: Float,
    sphere: Viewpoints,
    light: SoftLight,
    seen_from: float,
) -> None:
    """Draw the visible part of the object, the candidate views, and the camera path."""
    figure = axis.figure
    assert isinstance(figure, Figure)
    wide = axis.get_position().width * figure.get_figwidth()
    high = axis.get_position().height * figure.get_figheight()
    shape = round(130 * high), round(130 * wide)
    pose = look_at_origin(np.radians(25), seen_from, FIGURE_DISTANCE)
    focal = 0.5 * FIGURE_DISTANCE / 1.5 * min(shape)
    camera = PinholeCamera(
        focal,
        focal,
        shape[1] / 2,
        0.56 * shape[0],
        width=shape[1],
        height=shape[0],
    )
    pixels, far = light.picture(light.surfaces, pose, camera.matrix, shape)
    axis.imshow(pixels, interpolation="antialiased", aspect="auto")

    def place(points: Float) -> tuple[Float, Float]:
        """Return the pixels of points of the dome, and their opacity.

        It is lower behind the object and at the back.
        """
        inside = (DOME * points - pose[:3, 3]) @ pose[:3, :3]
        flat = camera.project(inside)
        row, column = np.clip(flat[:, ::-1].astype(int), 0, np.array(shape) - 1).T
        return flat, np.where(
            far[row, column] < inside[:, 2],
            0.15,
            np.where(points @ pose[:3, 3] < 0, 0.45, 1.0),
        )

    def line(points: Float, colour: str, width: float) -> None:
        flat, plain = place(points)
        for share in np.unique(plain):
            part = (plain == share) | np.append(False, plain[:-1] == share)
            shown = np.where(part[:, None], flat, np.nan)
            axis.plot(
                *shown.T,
                color=colour,
                linewidth=width,
                alpha=share,
                solid_capstyle="butt",
            )

    around = np.linspace(0, 2 * np.pi, 181)
    for up in np.radians(
        sphere.elevations if isinstance(sphere, ViewSphere) else (0, 30, 60)
    ):
        ring = [
            np.cos(up) * np.cos(around),
            np.cos(up) * np.sin(around),
            0 * around + np.sin(up),
        ]
        line(np.stack(ring, 1), RING, 0.9)
    for turn in np.arange(8) * np.pi / 4:  # meridians
        line(
            great_circle(
                np.array([np.cos(turn), np.sin(turn), 0]),
                np.array([0.0, 0, 1]),
                61,
            ),
            RING,
            0.5,
        )
    flat, plain = place(sphere.directions)
    rims = [to_rgba(RIM, share) for share in plain]
    axis.scatter(
        flat[:, 0],
        flat[:, 1],
        s=22,
        color=PAPER,
        edgecolor=rims,
        linewidth=1.2,
        zorder=3,
    )
    for a, b in itertools.pairwise(path):
        line(great_circle(a, b, 61), BLUE, 2.6)
    for step, at in enumerate(place(path)[0], 1):
        axis.scatter(
            [at[0]],
            [at[1]],
            s=230,
            color=BLUE,
            edgecolor=PAPER,
            linewidth=1.5,
            zorder=4,
        )
        axis.text(at[0], at[1], str(step), fontsize=10, zorder=5, **NUMBER)
    axis.set(xlim=(-0.5, shape[1] - 0.5), ylim=(shape[0] - 0.5, -0.5))
