"""Two taught things that touch on a table, through the wrist sensor, one named by a point: what it
is called.

    python -m research.touching_things YCB [--scenes 30]

YCB holds the scans, metres. Prints the share that is named right, called unknown, and wrong and
confident.
"""

from pathlib import Path

import numpy as np
import tyro

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.simulation.robot_camera import Named, RobotCamera
from nextview.simulation.scene import (
    build_scene,
    cached_mesh,
    footprint,
    mesh_hash,
    place,
    separation,
)
from nextview.simulation.scene_layout import Placement, SceneLayout

GAP = 0.005  # object radii between the two outlines
# metres; the other thing's size in radii of the target
SMALLEST = 0.03
LIMITS = (0.4, 2.5)


def beside(
    target: Path,
    other: Path,
    ratio: float,
    rng: np.random.Generator,
) -> Placement:
    """The other thing where it just touches the target, in a drawn direction."""
    towards, azimuth = rng.uniform(0, 2 * np.pi, 2)
    mesh = cached_mesh(target)
    near = 0.0
    far = 4.0
    outline = footprint(mesh.vertices)
    floor = float(mesh.vertices[:, 2].min())

    def at(distance: float) -> Placement:
        x = float(distance * np.cos(towards))
        y = float(distance * np.sin(towards))
        return Placement(other.name, mesh_hash(other), x, y, float(azimuth), ratio)

    for _ in range(25):
        middle = (near + far) / 2
        clear = (
            separation(outline, place(cached_mesh(other), at(middle), floor).footprint)
            > GAP
        )
        near, far = (near, middle) if clear else (middle, far)
    return at(far)


def main(
    scans: tyro.conf.Positional[Path],
    scenes: int = 30,
    named: Named = "point",
    seed: int = 5,
) -> None:
    system = nextview.load(models="ycb")
    found = []
    sizes = {
        p: nextview.load_mesh(p, unit="m").metres
        for p in sorted(scans.glob("*.ply"))
        if p.stem in system.classes
    }
    files = [path for path, metres in sizes.items() if metres > SMALLEST]
    for k in range(scenes):
        rng = np.random.default_rng([seed, k])
        target, other = (files[i] for i in rng.choice(len(files), 2, replace=False))
        placed = beside(
            target,
            other,
            float(np.clip(sizes[other] / sizes[target], *LIMITS)),
            rng,
        )
        layout = SceneLayout(
            f"pair-{k}",
            "pair",
            k,
            Placement(target.name, mesh_hash(target)),
            (placed,),
        )
        camera = RobotCamera(build_scene(layout, scans), "wrist", named=named)
        session = system.session_with(
            camera,
            int(np.random.default_rng(k).integers(len(system.sphere))),
        )
        session.reachable = camera.reachable
        result = session.run(camera)
        right = result.most_like == target.stem
        found.append(
            (
                right and not result.unknown,
                result.unknown,
                result.confident and not right,
            )
        )
        print(f"{target.stem} beside {other.stem}: {result}")
    print(
        "{:.3f} named right, {:.3f} unknown, {:.3f} wrong and confident".format(
            *np.mean(found, 0)
        )
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
