"""What whole episodes say of simple shapes that nobody taught: ball, box, rod, can, cone, capsule,
ring, slab.

    python -m benchmarks.simple_shapes                         # 3, 6, 12 cm; the YCB objects
    python -m benchmarks.simple_shapes --shapes ball box rod can --radii 0.025 0.05 0.1 0.15
    python -m benchmarks.simple_shapes --models modelnet10 --radii 0.3 0.6    # furniture sizes

Each shape stands upright, turned at random, and is looked at through a sensor with all defaults,
its size known. A shape is marked (*) if the smallest box around it is, within a tenth along each
axis, the size of that around a taught thing of known geometry: it may be taken for that thing.
"""

import tempfile
from pathlib import Path

import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from trimesh.bounds import oriented_bounds

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.errors import UsageError
from nextview.things.recogniser import VerifiedRecogniser

Key = tuple[str, float]  # name and radius of a shape
Sizes = NDArray[np.float64]

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


def boxes_of_taught(system: nextview.System) -> list[Sizes]:
    """Sizes of the smallest boxes around the taught things of known geometry, metres, ascending."""
    recogniser = system.models.recogniser
    if not isinstance(recogniser, VerifiedRecogniser):
        return []
    surfaces = recogniser.things.verifier.caster.surfaces
    return [np.sort(oriented_bounds(surface.vertices)[1]) for surface in surfaces]


def is_like_taught(name: str, radius: float, taught: list[Sizes]) -> bool:
    """Whether the box around a shape is, within a tenth along each axis, that of a taught thing."""
    shape = SHAPES[name]()
    scale = radius / np.linalg.norm(shape.vertices - shape.bounds.mean(0), axis=1).max()
    sizes = scale * np.sort(oriented_bounds(shape.vertices)[1])
    return any(np.abs(np.log(sizes / own)).max() < np.log(1.1) for own in taught)


def main(
    models: str = "ycb",
    shapes: tuple[str, ...] = tuple(SHAPES),
    radii: tuple[float, ...] = (0.03, 0.06, 0.12),
    draws: int = 1,
    sensor: str = "wrist",
    seed: int = 0,
) -> None:
    """Print a table: what each shape of each size is called.

    Args:
        models: which know none of the shapes by name.
        shapes: names of the shapes that are shown.
        radii: of the spheres that hold the shapes, metres.
        draws: of the azimuth, the first view and the sensor's errors, for each shape of each size.
        sensor: through which they are looked at.
        seed: of all draws.
    """
    strange = sorted(set(shapes) - set(SHAPES))
    if strange:
        raise UsageError(
            f"no shape is called {strange[0]}; there are {', '.join(SHAPES)}"
        )
    system = nextview.load(models=models, threads=1)
    taught = boxes_of_taught(system)
    rng = np.random.default_rng(seed)
    asked = [
        (name, radius) for name in shapes for radius in radii for _ in range(draws)
    ]
    found: dict[Key, list[nextview.Recognition]] = {}

    def work():
        with tempfile.TemporaryDirectory() as folder:
            for done, (name, radius) in enumerate(asked, 1):
                turn = rng.uniform(0, 2 * np.pi)
                path = write_shape(Path(folder) / f"{name}.ply", name, radius, turn)
                result = system.recognise(
                    path,
                    seed=int(rng.integers(2**32)),
                    unit="m",
                    sensor=sensor,
                )
                found.setdefault((name, radius), []).append(result)
                yield done

    track(work(), len(asked), f"shapes before {models}")
    like = {key for key in found if is_like_taught(*key, taught)}
    print(table(found, radii, like))


def table(
    found: dict[Key, list[nextview.Recognition]],
    radii: tuple[float, ...],
    like: set[Key],
) -> str:
    """What was said, as text: names of confident answers in bold; ``like`` marks some shapes."""
    lines = [
        f"| shape | {' | '.join(f'{100 * radius:g} cm' for radius in radii)} |",
        "|---" * (1 + len(radii)) + "|",
    ]
    for name in dict.fromkeys(name for name, _ in found):
        cells = []
        for radius in radii:
            answers = ", ".join(said(result) for result in found[name, radius])
            cells.append(f"{answers} (*)" if (name, radius) in like else answers)
        lines.append(f"| {name} | {' | '.join(cells)} |")

    lines += [
        "",
        counts(
            {key: found[key] for key in found if key not in like},
            "of no taught size",
        ),
    ]
    if like:
        lines.append(
            counts(
                {key: found[key] for key in like},
                "of the size of a taught thing (*)",
            )
        )
    return "\n".join(lines)


def counts(found: dict[Key, list[nextview.Recognition]], what: str) -> str:
    """How many episodes with some shapes end with a name, in words."""
    results = [result for each in found.values() for result in each]
    named = sum(result.answer is not None for result in results)
    sure = sum(result.confident for result in results)
    some = sum(
        any(result.answer is not None for result in each) for each in found.values()
    )
    return (
        f"{len(results)} episodes with shapes {what}: {named} end with a name, {sure} of them"
        f" confident. {some} of {len(found)} shapes get a name at least once."
    )


def said(result: nextview.Recognition) -> str:
    """What an episode ended with."""
    if result.answer is None:
        return "unknown"
    return f"**{result.answer}**" if result.confident else result.answer


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
