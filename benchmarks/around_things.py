"""Draw one object behind others, and what two policies show of it: the same first view, then their
own ways.

    python benchmarks/around_things.py ModelNet10 docs/images/around_things.png [--target chair_0917
        --level heavy]

Each row is a session through a simulated depth camera: its views in order, with the share of the
target that shows and what is believed after each; and the table from above, with the way of the
camera. The target is orange, what stands around it grey. The first view is that from which least of
the target shows, of those that can be reached and show some.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scene_pictures import COLOURS, SIZE, picture

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.data.folders import list_dataset
from nextview.data.scene_drawing import Meshes, draw_scene
from nextview.errors import UsageError
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.recognition.belief import FixedLength
from nextview.session.result import Recognition
from nextview.session.session import Session
from nextview.session.style import BLUE, FIGURE_STYLE, GREY, PAPER
from nextview.simulation.robot_camera import RobotCamera
from nextview.simulation.scene import TargetScene, build_scene, footprint
from nextview.simulation.simulated import SHOWS_OTHER, SHOWS_TARGET

SHOWS = 0.15
"""Share of the target that the first view shows at least."""
SPHERE = ViewSphere.named("40")


def session(
    scene: TargetScene,
    policy: str,
    models: str,
    start: int,
    views: int,
    seed: int,
) -> Recognition:
    """What a policy makes of a scene."""
    system = nextview.load(models, policy=policy)
    camera = RobotCamera(scene, named="box")
    rng = np.random.default_rng(seed)
    rule = FixedLength(max_views=views)
    made = Session(
        system.models,
        system.policy,
        system.sphere,
        start,
        rule,
        rng,
        camera.object,
    )
    made.reachable = camera.reachable
    return made.run(camera)


def from_above(axis: Axes, scene: TargetScene, directions: list[np.ndarray]) -> None:
    """The table, and the way of the camera above it."""
    for outline, colour in [
        (footprint(scene.target.vertices), SHOWS_TARGET),
        *((i.footprint, SHOWS_OTHER) for i in scene.items),
    ]:
        axis.add_patch(Polygon(outline, color=COLOURS[colour]))
    at = 3 * np.array(directions)
    axis.plot(at[:, 0], at[:, 1], "-", color=BLUE, linewidth=2)
    for k, place in enumerate(at, 1):
        axis.text(
            place[0],
            place[1],
            str(k),
            ha="center",
            va="center",
            fontsize=9,
            weight="bold",
            color="w",
            bbox={"boxstyle": "circle,pad=0.15", "color": BLUE},
        )
    axis.set(xlim=(-3.6, 3.6), ylim=(-3.6, 3.6), xticks=[], yticks=[], aspect="equal")
    axis.set_title("from above", fontsize=10, loc="left", color=GREY)
    axis.spines[:].set_visible(False)


def main(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    target: str = "chair_0917",
    level: str = "heavy",
    policies: tuple[str, ...] = ("random-all", "visible-gain"),
    models: str = "modelnet10",
    views: int = 3,
    split: str = "test",
    seed: int = 0,
) -> None:
    """Draw it."""
    files = {
        e.name: e.path.relative_to(dataset).as_posix()
        for e in list_dataset(dataset)
        if e.split == split
    }
    if target not in files:
        raise UsageError(
            f"{dataset}: no object of the split {split} is called {target}"
        )
    layout = draw_scene(
        files[target],
        Meshes(dataset, tuple(sorted(files.values()))),
        level,
        seed,
        f"{target}@{level}-0",
    )
    scene = build_scene(layout, dataset)
    shows = np.array(layout.visible)
    may = (shows >= SHOWS) & ~np.isin(np.arange(len(shows)), layout.unreachable)
    start = int(np.where(may, shows, np.inf).argmin())
    what = target.rpartition("_")[0].replace("_", " ")
    with matplotlib.rc_context(
        FIGURE_STYLE | {"axes.grid": False, "axes.facecolor": PAPER}
    ):
        figure = Figure((3.1 * (views + 1), 3.5 * len(policies)))
        axes = figure.subplots(
            len(policies),
            views + 1,
            squeeze=False,
            gridspec_kw={"wspace": 0.06, "hspace": 0.2},
        )
        for row, policy in zip(axes, policies, strict=True):
            found = session(scene, policy, models, start, views, seed)
            for k, (axis, view) in enumerate(zip(row, found.views, strict=False), 1):
                elevation, azimuth = np.radians(view.angles)
                axis.imshow(picture(scene, look_at_origin(elevation, azimuth)))
                best = int(view.belief.argmax())
                believed = (
                    f"{found.classes[best].replace('_', ' ')} "
                    f"{100 * view.belief[best]:.0f} %"
                )
                after = f"after {k} view{'s' * (k > 1)}: {believed}"
                axis.set_title(
                    f"{after}\n{100 * shows[view.index]:.0f} % of the {what} shows",
                    fontsize=10,
                    loc="left",
                )
            for axis in row[:-1]:
                axis.set(xticks=[], yticks=[], xlim=(0, SIZE - 1), ylim=(SIZE - 1, 0))
                axis.spines[:].set_visible(False)
            row[0].set_ylabel(
                policy,
                fontsize=13,
                weight="bold",
                color=BLUE if policy != policies[0] else GREY,
            )
            from_above(row[-1], scene, [view.direction for view in found.views])
        figure.savefig(
            out,
            dpi=125,
            facecolor=PAPER,
            bbox_inches="tight",
            pad_inches=0.15,
        )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
