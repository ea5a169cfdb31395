"""Draw a contact sheet of scenes: one object at three levels, seen from some of the 40 views.

    python -m benchmarks.scene_pictures ModelNet10 docs/images/scenes.png [--target chair_0917
        --seed 0]

The target is orange, what stands around it grey, the table light. Above each picture is the share
of the target that shows; a view to which no camera can be brought is crossed out.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure

from nextview.cli.exit_status import orderly_end
from nextview.data.folders import list_dataset
from nextview.data.scene_drawing import Meshes, draw_scene
from nextview.errors import UsageError
from nextview.geometry.depth import headlight
from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere
from nextview.session.style import FIGURE_STYLE, PAPER
from nextview.simulation.scene import TargetScene, build_scene
from nextview.simulation.scene_layout import CLUTTER_LEVELS
from nextview.simulation.simulated import (
    SHOWS_OTHER,
    SHOWS_TABLE,
    SHOWS_TARGET,
    SceneCamera,
)

SIZE = 240
WIDE = 0.55
"""Of the focal length with which the target fills the picture."""
COLOURS = {
    SHOWS_TARGET: (0.95, 0.55, 0.15),
    SHOWS_OTHER: (0.74, 0.71, 0.67),
    SHOWS_TABLE: (0.95, 0.92, 0.86),
}
VIEWS = (10, 12, 14, 16, 18, 27)


def picture(scene: TargetScene, pose: np.ndarray) -> np.ndarray:
    """What a camera sees, (SIZE, SIZE, 3), in the colours of the owners."""
    intrinsics = pinhole(SIZE, 3.0) * [[WIDE, 1, 1], [1, WIDE, 1], [1, 1, 1]]
    depth, owner = SceneCamera(scene, intrinsics, (SIZE, SIZE)).look(pose)
    shade = headlight(depth, intrinsics)[..., None] / 255
    image = np.tile(np.array([0.98, 0.965, 0.94]), (SIZE, SIZE, 1))
    for which, colour in COLOURS.items():
        image = np.where(
            (owner == which)[..., None],
            np.array(colour) * (0.45 + 0.55 * shade),
            image,
        )
    return np.clip(image, 0, 1)


def main(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    target: str = "chair_0917",
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
    meshes = Meshes(dataset, tuple(sorted(files.values())))
    sphere = ViewSphere.named("40")
    with matplotlib.rc_context(FIGURE_STYLE | {"axes.grid": False}):
        figure = Figure((1.65 * len(VIEWS), 1.85 * len(CLUTTER_LEVELS)))
        axes = figure.subplots(
            len(CLUTTER_LEVELS),
            len(VIEWS),
            gridspec_kw={"wspace": 0.04, "hspace": 0.16},
        )
        for row, level in zip(axes, CLUTTER_LEVELS, strict=True):
            layout = draw_scene(
                files[target],
                meshes,
                level,
                seed,
                f"{target}@{level}-0",
            )
            scene = build_scene(layout, dataset)
            for axis, view in zip(row, VIEWS, strict=True):
                axis.imshow(picture(scene, sphere.poses[view]))
                axis.set_title(
                    f"view {view}: {layout.visible[view]:.0%}",
                    fontsize=8,
                    pad=3,
                )
                axis.set(xticks=[], yticks=[])
                if view in layout.unreachable:
                    axis.plot(
                        [0, SIZE - 1],
                        [0, SIZE - 1],
                        color="#b00020",
                        linewidth=1.2,
                    )
                    axis.plot(
                        [0, SIZE - 1],
                        [SIZE - 1, 0],
                        color="#b00020",
                        linewidth=1.2,
                    )
            row[0].set_ylabel(
                f"{level}, {np.mean(layout.visible):.0%} on average",
                fontsize=8,
            )
        figure.savefig(
            out,
            dpi=120,
            facecolor=PAPER,
            bbox_inches="tight",
            pad_inches=0.05,
        )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
