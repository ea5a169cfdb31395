"""What whole episodes say of simple shapes that nobody taught: ball, box, rod, can, cone, capsule,
ring, slab.

    python benchmarks/simple_shapes.py                                         # 3, 6, 12 cm; the
    YCB models python benchmarks/simple_shapes.py --models modelnet10 --radii 0.3 0.6     # the size
    of furniture

Each shape stands upright, turned at random, and is looked at through a sensor with all defaults,
its size known.
"""

import tempfile
from pathlib import Path

import numpy as np
import trimesh
import tyro

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track

SHAPES = {
    "ball": lambda: trimesh.creation.icosphere(4),
    "box": lambda: trimesh.creation.box((1, 1, 1)),
    "rod": lambda: trimesh.creation.cylinder(0.06, 2, sections=64),
    "can": lambda: trimesh.creation.cylinder(0.5, 1.5, sections=64),
    "cone": lambda: trimesh.creation.cone(0.6, 1.4, sections=64),
    "capsule": lambda: trimesh.creation.capsule(1.5, 0.5),
    "ring": lambda: trimesh.creation.torus(1, 0.25),
    "slab": lambda: trimesh.creation.box((1.6, 1.1, 0.12)),
}


def write_shape(path: Path, name: str, radius: float, turn: float) -> Path:
    """Write a shape as a mesh file, metres; the radius is that of the sphere which holds it."""
    shape = SHAPES[name]()
    shape.apply_translation(-shape.bounds.mean(0))
    shape.apply_scale(radius / np.linalg.norm(shape.vertices, axis=1).max())
    shape.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
    shape.export(path)
    return path


def main(
    models: str = "ycb",
    radii: tuple[float, ...] = (0.03, 0.06, 0.12),
    draws: int = 1,
    sensor: str = "wrist",
    seed: int = 0,
) -> None:
    """Print a table: what each shape of each size is called.

    Args:
        models: which know none of the shapes by name.
        radii: of the spheres that hold the shapes, metres.
        draws: of the azimuth, the first view and the sensor's errors, for each shape of each size.
        sensor: through which they are looked at.
        seed: of all draws.
    """
    system = nextview.load(models=models, threads=1)
    rng = np.random.default_rng(seed)
    asked = [(name, radius) for name in SHAPES for radius in radii for _ in range(draws)]
    found: dict[tuple[str, float], list[nextview.Recognition]] = {}

    def work():
        with tempfile.TemporaryDirectory() as folder:
            for done, (name, radius) in enumerate(asked, 1):
                turn = rng.uniform(0, 2 * np.pi)
                path = write_shape(Path(folder) / f"{name}.ply", name, radius, turn)
                result = system.recognise(
                    path, seed=int(rng.integers(2**32)), unit="m", sensor=sensor
                )
                found.setdefault((name, radius), []).append(result)
                yield done

    track(work(), len(asked), f"shapes before {models}")
    print(table(found, radii))


def table(
    found: dict[tuple[str, float], list[nextview.Recognition]], radii: tuple[float, ...]
) -> str:
    """What was said, as text: names of confident answers in bold."""
    lines = [
        f"| shape | {' | '.join(f'{100 * radius:g} cm' for radius in radii)} |",
        "|---" * (1 + len(radii)) + "|",
    ]
    for name in SHAPES:
        cells = [", ".join(said(result) for result in found[name, radius]) for radius in radii]
        lines.append(f"| {name} | {' | '.join(cells)} |")

    results = [result for each in found.values() for result in each]
    named = sum(result.answer is not None for result in results)
    sure = sum(result.confident for result in results)
    some = sum(any(result.answer is not None for result in each) for each in found.values())
    lines += [
        "",
        f"{len(results)} episodes: {named} end with a name, {sure} of them confident. "
        f"{some} of {len(found)} shapes get a name at least once.",
    ]
    return "\n".join(lines)


def said(result: nextview.Recognition) -> str:
    """What an episode ended with."""
    if result.answer is None:
        return "unknown"
    return f"**{result.answer}**" if result.confident else result.answer


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
