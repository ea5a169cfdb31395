"""The pictures of concepts, sensors and sizes, from real runs on the sample objects.

python docs/site/pictures.py [FOLDER]
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import nextview
from nextview.data.samples import sample_mesh
from nextview.figures.style import ACCENT, BLUE, FAINT, FIGURE_STYLE, INK, PlainFigure
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.maps import local_peaks
from nextview.recognition.model_card import find_card
from nextview.session.view import View
from nextview.simulation.sensed_camera import SensedCamera
from nextview_lab.data.measures import depth_entropy

IMAGES = Path(__file__).parents[1] / "images"
RESULTS = Path(__file__).parents[1] / "results_classes.md"
START = 33
"""A view from above, in which a table could be a desk."""
SPHERE = ViewSphere.named("40")


def main(out: tyro.conf.Positional[Path] = IMAGES) -> None:
    """Draw all of them into a folder."""
    view = nextview.load().recognise(sample_mesh("table"), start=START).views[0]
    figures = {
        "concept_viewpoints": viewpoints(13),
        "concept_belief": belief(),
        "concept_calibration": calibration(),
        "concept_maps": maps(19),
        "concept_gain": gain(view),
        "gallery_samples": samples((33, 17, 3, 22)),
        "sensors": sensors(17),
        "sizes": sizes(),
    }
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=110, facecolor="white")


def new(
    columns: int,
    height: float = 3.0,
    width: float = 9.6,
) -> tuple[Figure, list[Axes]]:
    """A row of axes."""
    figure = PlainFigure((width, height), layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def grid(axes: Axes, values: np.ndarray, title: str, **options: object) -> None:
    """A map of the sphere: a row for each ring, the horizon below."""
    axes.imshow(
        np.ma.masked_invalid(values.reshape(5, 8)),
        origin="lower",
        aspect="auto",
        **options,
    )  # type: ignore[arg-type]
    axes.set_facecolor("#eef1f4")
    axes.set_xticks(range(0, 8, 2), [f"{45 * k}°" for k in range(0, 8, 2)])
    axes.set_yticks(range(5), [f"{18 * k}°" for k in range(5)])
    axes.set(xlabel="azimuth", ylabel="elevation")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(visible=False)


def mark(axes: Axes, view: int, label: str, colour: str) -> None:
    """Frame a cell of a map."""
    ring, column = divmod(view, 8)
    axes.add_patch(
        Rectangle(
            (column - 0.46, ring - 0.46),
            0.92,
            0.92,
            fill=False,
            edgecolor=colour,
            linewidth=2.2,
        )
    )
    axes.text(
        column,
        ring,
        label,
        ha="center",
        va="center",
        fontsize=7,
        color=colour,
        weight="bold",
    )


def picture(axes: Axes, view: int, mesh: nextview.Mesh, title: str) -> None:
    """What the camera sees from a view."""
    axes.imshow(
        nextview.SimulatedCamera(mesh).observe(SPHERE.poses[view]).picture,
        cmap="gray",
        vmin=0,
        vmax=255,
    )
    axes.set_title(title, fontsize=10, loc="left")
    axes.axis("off")


def viewpoints(here: int) -> Figure:
    """The 40 views in space and as a map, with the local window of one of them."""
    figure = PlainFigure((9.6, 3.6), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    window = np.unique(SPHERE.windows[here])
    colours = np.full(len(SPHERE), FAINT)
    colours[window], colours[here] = "#7fa6c9", ACCENT
    space.scatter(*SPHERE.directions.T, c=colours, s=34, depthshade=False)
    camera = nextview.SimulatedCamera(sample_mesh("chair"))
    points = np.concatenate(
        [
            camera.observe(SPHERE.poses[view]).points[::2]
            for view in (1, 3, 5, 7, 33, 37)
        ]
    )
    space.scatter(*0.6 * points.T, s=0.6, color=INK)
    space.set_box_aspect((1, 1, 0.6), zoom=1.35)
    space.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-0.3, 0.9))
    space.view_init(elev=20, azim=-112)
    space.set_axis_off()
    axes = figure.add_subplot(1, 2, 2)
    shown = np.full(len(SPHERE), np.nan)
    shown[window] = 0.35
    grid(
        axes,
        shown,
        f"their numbers; view {here} and its window",
        cmap="Blues",
        vmin=0,
        vmax=1,
    )
    for view in range(len(SPHERE)):
        if view != here:
            axes.text(
                view % 8,
                view // 8,
                str(view),
                ha="center",
                va="center",
                fontsize=8,
                color=INK,
            )
    mark(axes, here, str(here), ACCENT)
    return figure


def belief() -> Figure:
    """Belief in the likeliest classes after each of five views, against the threshold, which
    comes down.
    """
    system = nextview.load(threshold=1.0, max_views=5)
    result, usual = (
        system.recognise(sample_mesh("table"), start=START),
        nextview.load().stopping,
    )
    steps = np.arange(1, len(result.views) + 1)
    beliefs = np.array([view.belief for view in result.views])
    alone = np.array([view.alone for view in result.views])
    figure, (left, right) = new(2, 3.2)
    for axes, values, title in (
        (left, alone, "each view alone"),
        (right, beliefs, "fused over the views so far"),
    ):
        for c in np.argsort(-beliefs.max(0))[:3]:
            axes.plot(
                steps,
                values[:, c],
                marker="o",
                label=result.classes[c].replace("_", " "),
            )
        axes.set_title(title, fontsize=10, loc="left")
        axes.set(ylim=(0, 1.03), xlabel="view", ylabel="belief", xticks=steps)
    right.plot(
        steps,
        usual.threshold_at(steps),
        color=INK,
        linestyle=":",
        label="threshold",
    )
    right.legend()
    return figure


def maps(here: int) -> Figure:
    """True depth entropy of all views with its highest and lowest, and what the network predicts
    of the window.
    """
    mesh = sample_mesh("table")
    camera = nextview.SimulatedCamera(mesh)
    true = np.array(
        [depth_entropy(camera.observe(pose).depth) for pose in SPHERE.poses]
    )
    session = nextview.load(policy="lem").session(here)
    seen = session.update(camera.observe(session.pose))
    values = np.full(len(SPHERE), np.nan)
    values[SPHERE.windows[here].ravel()] = seen.maps["lem"].ravel()
    figure, (low, high, whole, window) = new(4, 2.8, 11.5)
    picture(
        low,
        int(true.argmin()),
        mesh,
        f"view {true.argmin()}: {true.min():.1f} bits",
    )
    picture(
        high,
        int(true.argmax()),
        mesh,
        f"view {true.argmax()}: {true.max():.1f} bits",
    )
    grid(whole, true, "depth entropy, bits", cmap="viridis")
    figure.colorbar(whole.images[0], ax=whole)
    mark(whole, int(true.argmin()), "low", "white")
    mark(whole, int(true.argmax()), "high", ACCENT)
    grid(window, values, f"predicted from view {here} (LEM)", cmap="viridis")
    figure.colorbar(window.images[0], ax=window)
    mark(window, here, "here", "white")
    for ring, column in np.argwhere(local_peaks(seen.maps["lem"][None])[0]):
        cell = int(SPHERE.windows[here][ring, column])
        if cell != here:
            mark(window, cell, "peak", ACCENT)
    return figure


def gain(view: View) -> Figure:
    """What is seen, what it costs to go to each view, and what each is worth."""
    assert view.values is not None
    assert view.next_view is not None
    figure, (seen, cost, value) = new(3, 3.0)
    picture(
        seen,
        view.index,
        sample_mesh("table"),
        f"view {view.index}: a table, or a desk?",
    )
    grid(cost, SPHERE.travel[view.index], "travel from here, cells", cmap="Greys")
    figure.colorbar(cost.images[0], ax=cost)
    grid(value, view.values, "value of each view", cmap="viridis")
    figure.colorbar(value.images[0], ax=value)
    for axes in (cost, value):
        mark(axes, view.index, "here", "#2f7ab9" if axes is cost else "white")
        mark(axes, view.next_view, "next", ACCENT)
    return figure


def calibration() -> Figure:
    """Mean belief in the answer and how often it is right, by views fused: the measurements of
    docs/results_classes.md.
    """
    part = RESULTS.read_text().split("\n## Calibration\n")[1].split("\n## ")[0]
    rows = re.findall(
        r"^\| (\d+) \| ([\d.]+) \(([\d.]+)-([\d.]+)\) \| [\d.]+ \| ([\d.]+) \|",
        part,
        re.M,
    )
    n_views, accuracy, low, high, confidence = np.array(rows, float).T
    figure, (axes,) = new(1, 3.4, 5.6)
    axes.fill_between(n_views, low, high, color=BLUE, alpha=0.15, linewidth=0)
    axes.plot(
        n_views,
        accuracy,
        marker="o",
        color=BLUE,
        label="how often it is right, 95 % interval",
    )
    axes.plot(
        n_views,
        confidence,
        marker="o",
        color=ACCENT,
        label="mean belief in the answer",
    )
    axes.set_xscale("log", base=2)
    axes.set_xticks(n_views, [f"{n:.0f}" for n in n_views])
    axes.minorticks_off()
    axes.set(xlabel="random views fused", ylim=(0.88, 1.0))
    axes.legend(loc="upper left")
    return figure


def samples(views: tuple[int, ...]) -> Figure:
    """The bundled sample objects from some views."""
    figure = PlainFigure((9.6, 7.4), layout="constrained")
    axes = figure.subplots(3, len(views))
    for row, name in zip(axes, ("chair", "monitor", "table"), strict=True):
        for each, view in zip(row, views, strict=True):
            elevation, azimuth = SPHERE.angles(view)
            picture(
                each,
                view,
                sample_mesh(name),
                f"{name}, {elevation:.0f}° up, {azimuth:.0f}° around",
            )
    return figure


def sensors(view: int) -> Figure:
    """The depth of each sensor, and what the networks get of it, raw and denoised."""
    names = ("none", "kinect", "stereo", "tof", "scanner", "wrist")
    figure = PlainFigure((7.0, 3.8), layout="constrained")
    axes = figure.subplots(3, len(names))
    for column, name in zip(axes.T, names, strict=True):
        cameras = [
            SensedCamera(
                sample_mesh("chair"), name, np.random.default_rng(0), denoise=denoise
            )
            for denoise in (False, True)  # both draw the same errors
        ]
        sensor = cameras[0].sensor
        frame = cameras[0].frame(SPHERE.poses[view])
        half = int(1.2 * sensor.focal * sensor.radius / sensor.distance)
        middle = sensor.height // 2, sensor.width // 2
        around = tuple(slice(at - half, at + half) for at in middle)
        depth = np.where(frame.depth > 0, frame.depth, np.nan)[around]
        near, far = (sensor.distance + sign * sensor.radius for sign in (-1, 1))
        column[0].imshow(depth, cmap="viridis_r", vmin=near, vmax=far)
        column[0].set_title(name, fontsize=10)
        for each, camera in zip(column[1:], cameras, strict=True):
            seen = camera.observe(SPHERE.poses[view]).picture
            each.imshow(seen, cmap="gray", vmin=0, vmax=255)
        for each in column:
            each.set(xticks=[], yticks=[])
            each.grid(visible=False)
            each.spines[:].set_visible(False)
    for each, label in zip(axes[:, 0], ("depth", "raw", "denoised"), strict=True):
        each.set_ylabel(label, fontsize=10)
    return figure


def sizes() -> Figure:
    """What the bundled recogniser knows of sizes: a density for each class, largest above."""
    card = find_card("recogniser-modelnet10")
    assert card.size is not None
    radii, density = np.array(card.size.radii_m), np.exp(card.size.log_density)
    order = np.argsort((density * np.log(radii)).sum(1) / density.sum(1))[::-1]
    figure, (axes,) = new(1, 3.8, 6.4)
    for row, label in enumerate(order):
        top = row + 1.6 * density[label] / density.max()
        over = {"zorder": 30 - row}
        axes.fill_between(
            radii, row, top, color=f"C{label}", alpha=0.75, linewidth=0, **over
        )
        axes.plot(radii, top, color=INK, linewidth=0.8, **over)
    axes.set_xscale("log")
    axes.set_xlim(0.08, 8)
    axes.set_xticks(ticks := [0.1, 0.2, 0.5, 1, 2, 5], [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    names = [card.classes[label].replace("_", " ") for label in order]
    axes.set_yticks(range(len(order)), names)
    axes.set_xlabel("object radius, metres")
    return figure


if __name__ == "__main__":
    with matplotlib.rc_context(FIGURE_STYLE):
        tyro.cli(main)
