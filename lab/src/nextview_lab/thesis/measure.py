"""Put view measures into a store, those too that need the meshes that it was rendered from.

python -m nextview_lab.thesis.measure views.zarr ModelNet10 --measures all [--split test]
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import follow, say_done
from nextview.data.folders import list_dataset
from nextview.errors import DatasetError
from nextview.files import sha256_of
from nextview.geometry.mesh import MAX_FACES, load_mesh
from nextview_lab.data import measures
from nextview_lab.data.rendering import deformed
from nextview_lab.data.splits import some_objects
from nextview_lab.data.store import DEPTH_UNIT, ViewStore
from nextview_lab.thesis.surfaces import FaceCamera, MeshView


def measure(
    path: Path,
    meshes: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
    overwrite: bool = False,
    max_faces: int = MAX_FACES,
) -> Iterator[tuple[int, int]]:
    """As ``nextview_lab.data.measures.measure``, with views that know which face each pixel shows.

    ``meshes`` is the dataset folder, as the store was rendered from it; ``max_faces`` are those of
    a mesh at most.
    """
    store = ViewStore.open(path)
    files = {entry.name: entry.path.absolute() for entry in list_dataset(meshes)}
    if store.attributes.sensor is not None:
        raise DatasetError(
            f"{path}: was rendered through a sensor, whose depth does not tell which face is seen"
        )
    lacking = [
        store.names[i]
        for i in np.flatnonzero(store.done)
        if store.names[i] not in files
    ]
    if lacking:
        raise DatasetError(
            f"{meshes}: holds no mesh called {lacking[0]}, of which {path} has views"
        )
    views = partial(_mesh_views, files, max_faces)
    yield from measures.measure(
        path,
        names,
        workers,
        scheduler,
        objects,
        overwrite,
        views,
    )


def _mesh_views(
    files: dict[str, Path],
    max_faces: int,
    store: ViewStore,
    i: int,
) -> Iterator[MeshView]:
    """Object i of a store, from all its views."""
    depths = store.read("depth", i)
    name = store.names[i]
    hashes = store.attributes.sha256
    if hashes and sha256_of(files[name]) != hashes[i]:
        raise DatasetError(
            f"{files[name]}: is not the mesh that {store.path} was rendered from"
        )
    mesh = deformed(
        store,
        load_mesh(
            files[name],
            max_faces=max_faces,
            largest_part=store.attributes.largest_part,
        ),
        name,
    )
    camera = FaceCamera(mesh, depths.shape[-1], store.sphere.distance)
    for depth, pose in zip(depths, store.sphere.poses, strict=True):
        yield camera.view(pose, depth * DEPTH_UNIT)  # float64, as when it was rendered


def main(
    store: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path],
    /,
    measures: tuple[str, ...] = ("all",),
    max_faces: int = MAX_FACES,
    split: Literal["train", "test", "val"] | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
) -> None:
    """Compute view measures of every rendered object and keep them in the store. Resumes where it
    was.

    Args:
        store: view store made by nextview-lab render.
        meshes: the dataset folder that it was rendered from.
        measures: names (see nextview-lab list measures), all, or MODULE:FUNCTION.
        max_faces: of a mesh, as for nextview-lab render.
        split: only this split.
        held_out: only the objects that this model, bundled or a card (NAME.json), calls held out of
            its training.
        objects: only so many of these, spread evenly; twice as many later hold the same.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
        overwrite: measure anew what is there.
    """
    select = some_objects(ViewStore.open(store), split, held_out, objects)
    steps = measure(
        store,
        meshes,
        measures,
        workers,
        scheduler,
        select,
        overwrite,
        max_faces,
    )
    before, total = follow(steps, f"measuring {store.name}")
    say_done(store, "measured", before, total)


if __name__ == "__main__":
    with orderly_end("run the same command again; it resumes"):
        tyro.cli(main)
