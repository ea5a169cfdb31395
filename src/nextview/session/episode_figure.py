"""A picture of one episode: what was seen, what the policy decided by, what was believed, and the path."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray

from nextview.errors import UsageError
from nextview.geometry.viewsphere import Viewpoints, ViewSphere, great_circle
from nextview.recognition.belief import Stopping
from nextview.session.style import ACCENT, FAINT, INK, PlainFigure
from nextview.session.view import View


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure into a PNG, PDF or SVG file."""
    try:
        figure.savefig(path, dpi=110, facecolor="white")
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: the figure cannot be written ({error})") from None


def draw_episode(
    views: Sequence[View], classes: Sequence[str], sphere: Viewpoints, stopping: Stopping, heading: str
) -> Figure:
    """One column for each view (image, what the policy valued the views at, belief), and the sphere beside them."""
    valued = any(view.values is not None for view in views)
    heights = [2.7, 2.6, 2.9] if valued else [2.7, 2.9]
    figure = PlainFigure(figsize=(2.5 * len(views) + 5.2, sum(heights)), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[2.5 * len(views), 5.2])[0]
    axes = left.subplots(len(heights), len(views), squeeze=False, gridspec_kw={"height_ratios": heights})
    shown = np.argsort(-np.max([view.belief for view in views], axis=0))[:5]
    names = [name.replace("_", " ") for name in classes]
    for k, view in enumerate(views):
        _draw_image(axes[0, k], view, k + 1)
        if valued:
            _draw_values(axes[1, k], view, sphere, [v.index for v in views[:k]], first=k == 0)
        _draw_belief(axes[-1, k], view, k + 1, float(stopping.threshold_at(k + 1)), names, shown)
    _draw_path(right.add_subplot(projection="3d"), views, sphere)
    figure.suptitle(heading, color=INK, fontsize=13)
    return figure


def _draw_image(axis: Axes, view: View, step: int) -> None:
    elevation, azimuth = view.angles
    axis.imshow(view.observation.picture, cmap="gray", vmin=0, vmax=255)
    where = f"{elevation:.0f}° up, {round(azimuth) % 360}° round"
    axis.set_title(f"step {step}: view {view.index}\n{where}", color=INK, fontsize=10)
    axis.axis("off")


def _draw_values(axis: Axes, view: View, sphere: Viewpoints, visited: list[int], first: bool) -> None:
    """What the policy valued each candidate view at, elevation over azimuth, with here, next and the visited marked."""
    if view.values is None:
        axis.axis("off")
        axis.text(0.5, 0.5, "no other view needed", ha="center", va="center", fontsize=9, color=INK)
        return
    axis.set_title("value of each view", fontsize=9)
    azimuth, elevation = np.degrees(sphere.azimuth), np.degrees(sphere.elevation)
    valued = np.isfinite(view.values)
    shape: dict[str, Any] = {"marker": "s", "s": 120} if isinstance(sphere, ViewSphere) else {"marker": "o", "s": 34}
    axis.scatter(azimuth[~valued], elevation[~valued], color=FAINT, **shape)
    axis.scatter(azimuth[valued], elevation[valued], c=view.values[valued], cmap="viridis", **shape)
    marks = [(index, INK, "x") for index in visited] + [(view.index, INK, "here")]
    if view.next_view is not None:
        marks.append((view.next_view, ACCENT, "next"))
    for index, colour, label in marks:
        if label != "x":
            axis.scatter(azimuth[index], elevation[index], s=160, facecolor="none", edgecolor=colour, linewidth=2)
        axis.text(azimuth[index], elevation[index] + 4, label, ha="center", fontsize=6, color=colour, weight="bold")
    axis.set_xlabel("azimuth", fontsize=8)
    axis.set_xticks([0, 90, 180, 270, 360], [f"{a}°" for a in (0, 90, 180, 270, 360)], fontsize=8)
    axis.tick_params(axis="y", labelsize=8)
    axis.yaxis.set_major_formatter("{x:.0f}°")
    if first:
        axis.set_ylabel("elevation")


def _draw_belief(
    axis: Axes, view: View, step: int, threshold: float, names: Sequence[str], shown: NDArray[np.int64]
) -> None:
    """Bars of the classes shown: the belief so far, and by this view alone."""
    rows = np.arange(len(shown))[::-1]
    axis.barh(rows + 0.18, view.belief[shown], 0.36, color=ACCENT, label="belief after this view")
    axis.barh(rows - 0.18, view.alone[shown], 0.36, color=FAINT, label="this view alone")
    axis.axvline(threshold, color=INK, linewidth=1, linestyle=":", label="threshold")
    axis.set_xlim(0, 1)
    axis.set_yticks(rows, [names[c] for c in shown] if step == 1 else [])
    axis.spines[["top", "right"]].set_visible(False)
    best = int(view.belief.argmax())
    believed = f"{names[best]} {view.belief[best]:.3f}"
    axis.set_title(believed if view.observation.seen else "nothing is seen", fontsize=10, color=ACCENT)
    axis.set_xlabel(f"threshold {threshold:.2f}", fontsize=8)
    if step == 1:
        axis.legend(fontsize=7, loc="lower right", frameon=False)


def _draw_path(axis: Axes3D, views: Sequence[View], sphere: Viewpoints) -> None:
    d = sphere.directions
    axis.scatter(*d.T, s=14, color=FAINT, depthshade=False)
    for elevation in np.radians(sphere.elevations) if isinstance(sphere, ViewSphere) else ():
        around = np.linspace(0, 2 * np.pi, 91)
        ring = np.cos(elevation) * np.cos(around), np.cos(elevation) * np.sin(around), 0 * around + np.sin(elevation)
        axis.plot(*ring, color=FAINT, linewidth=0.6)
    seen = [view.observation.points[::3] for view in views if view.observation.seen]
    cloud = np.concatenate([np.zeros((0, 3)), *seen])
    axis.scatter(*cloud.T, s=1, color=INK, alpha=0.35, depthshade=False)
    path = np.array([view.direction for view in views])
    for a, b in itertools.pairwise(path):
        axis.plot(*great_circle(a, b).T, color=ACCENT, linewidth=2)
    axis.scatter(*path.T, s=46, color=ACCENT, depthshade=False)
    for step, place in enumerate(path, 1):
        axis.text(*(place * 1.16), str(step), color=ACCENT, fontsize=12, weight="bold", ha="center")
    # Look from the side where the path is, a little from above.
    middle = path.sum(0)
    axis.view_init(elev=24, azim=float(np.degrees(np.arctan2(middle[1], middle[0]))) - 25)
    axis.set_box_aspect((1, 1, 0.75), zoom=1.2)  # room for the numbers at its rim
    axis.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-0.5, 1))
    axis.set_axis_off()
    axis.set_title("where it looked from, and the points it saw", fontsize=10, color=INK)
