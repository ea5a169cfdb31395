"""What measuring costs beside rendering: views a second for each measure and its memory, on the same meshes.

    python benchmarks/measures.py MODELNET10 [--meshes 100] [--views 40]

One process, in one run: each mesh is rendered as nextview render does, written to a store and measured from it as
nextview measure does, in turns, so that whatever else the machine does burdens both alike. Seconds are the processor's.
Memory is what a measure takes beside the views and the mesh, at its highest, by tracemalloc, in a pass of its own.
"""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from collections import Counter
from pathlib import Path

import numpy as np
import tyro
from threadpoolctl import threadpool_limits

CURVED = ("curvature_entropy", "mean_curvature", "gaussian_curvature", "mesh_saliency")
"""The measures that are made of a mesh's curvature."""


def main(modelnet10: tyro.conf.Positional[Path], meshes: int = 100, seed: int = 0) -> None:
    """Compare.

    Args:
        modelnet10: the dataset's folder.
        meshes: how many, drawn by the seed.
        seed: of the draw.
    """
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.data.folders import list_dataset
    from nextview.data.measuring import CASTING, READING, Cost, measure
    from nextview.data.rendering import render
    from nextview.data.store import ViewStore
    from nextview.measures.measured_view import MeasuredView
    from nextview.measures.registry import MEASURES
    from nextview.measures.surface import Surface
    from nextview.mesh import load_mesh
    from nextview.viewsphere import ViewSphere

    threadpool_limits(1)  # as in each of several processes
    sphere, entries = ViewSphere.named("40"), list_dataset(modelnet10)
    chosen = np.random.default_rng(seed).choice(len(entries), min(meshes, len(entries)), replace=False)
    rendering, cost, memory = 0.0, Cost(), Counter()
    flat = [name for name in MEASURES if name not in CURVED]
    wall = time.perf_counter()
    for i in sorted(chosen):
        entry = entries[i]
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder, "meshes", entry.label, entry.path.name)
            link.parent.mkdir(parents=True)
            link.symlink_to(entry.path.resolve())
            began = time.process_time()
            failed = [reason for _, reason in render(link.parents[1], Path(folder, "s.zarr"), sphere, workers=0)]
            rendering += time.process_time() - began
            assert failed == [None], failed
            for names in (flat, CURVED):
                list(measure(Path(folder, "s.zarr"), names, 0, meshes=link.parents[1], cost=cost))
            store = ViewStore.open(Path(folder, "s.zarr"))
            mesh, depth = load_mesh(link), store.depth(0)[21].astype(np.float64)
            ids = SimulatedCamera(mesh).face_ids(sphere.poses[21], depth)
            for name, function in MEASURES.items():
                surface = Surface(mesh.vertices, mesh.faces)
                tracemalloc.start()
                function(MeasuredView(depth, sphere.poses[21], store.intrinsics, surface, ids))
                memory[name] = max(memory[name], tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
    views = cost.views // 2
    print(f"{len(chosen)} meshes x 40 views in {time.perf_counter() - wall:.0f} s\n")
    print("| | views/s of one core | memory, MB |\n|---|---|---|")
    print(f"| rendering, mesh file to store | {views / rendering:.0f} | |")
    for name in (READING, CASTING, *MEASURES):
        # Read and cast twice here, once for each part.
        often = 2 if name in (READING, CASTING) else 1
        kept = f"{memory[name] / 1e6:.1f}" if name in memory else ""
        print(f"| {name.replace('_', ' ')} | {often * views / cost.seconds[name]:,.0f} | {kept} |")
    shared = (cost.seconds[READING] + cost.seconds[CASTING]) / 2
    all_flat = shared + sum(cost.seconds[name] for name in flat)
    print(f"| all but those of curvature | {views / all_flat:.0f} | |")
    print(f"\nAll but those of curvature cost {all_flat / rendering:.2f} of the rendering.")


if __name__ == "__main__":
    tyro.cli(main)
