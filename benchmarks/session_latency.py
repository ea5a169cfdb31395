"""How long one update of a session takes, from a 640 x 480 frame on, and whether memory stays flat
over many.

    python -m benchmarks.session_latency [--updates 200] [--threads 2] [--cpu] [--threshold 1]

A chair on a table, noise 1 mm, 3 % holes, from random places around it; sessions of up to five
frames, one after the other, that never reach the threshold by default. The time of an update is
until it is said where to look next, or, in the last one, what the object is. Prints the mean, the
median and the 99th percentile of the milliseconds, in parts: finding the object in the frame
(noise, support plane, cluster), its geometry (surface, object frame, images, of earlier frames too
where the object frame got better), the networks, the policy, and the rest (checks). Then the same
by the number of the frame in its session, and the resident memory after each tenth of the updates.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing import Frame, ObservedObject, plausibility, resampling, sighting

INTRINSICS = np.array([[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]])
SHAPE = 480, 640
FRAMES = 40  # different ones; they come again
PARTS = ("finding", "geometry", "networks", "policy", "rest")


class Clock:
    """Adds up the time that passes within functions, by the part that they belong to."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.spent: dict[str, float] = defaultdict(float)

    def timed(
        self,
        part: str,
        run: Callable[..., Any],
        within: str = "",
    ) -> Callable[..., Any]:
        """A function that does the same and is timed; its time is taken from that of the part
        within which it runs.
        """

        def timed(*given: Any, **more: Any) -> Any:
            begun = self.now()
            try:
                return run(*given, **more)
            finally:
                took = self.now() - begun
                self.spent[part] += took
                if within:
                    self.spent[within] -= took

        return timed


def frames(rng: np.random.Generator) -> list[Frame]:
    mesh = sample_mesh("chair")
    scene = EmbreeScene()
    vertices = 0.12 * mesh.vertices
    vertices[:, 2] -= vertices[:, 2].min()
    corners = np.array(
        [[-0.7, -0.7, 0], [0.7, -0.7, 0], [0.7, 0.7, 0], [-0.7, 0.7, 0]],
        np.float32,
    )
    TriangleMesh(
        scene,
        vertices.astype(np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
    )
    TriangleMesh(scene, corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    row, column = np.indices(SHAPE)
    rays = (
        np.stack([column, row, np.ones(SHAPE)], -1).reshape(-1, 3)
        @ np.linalg.inv(INTRINSICS).T
    )
    found = []
    for _ in range(FRAMES):
        pose = look_at_origin(
            np.radians(rng.uniform(15, 70)),
            rng.uniform(0, 2 * np.pi),
            0.6,
        )
        pose[2, 3] += 0.1
        origins = np.tile(pose[:3, 3].astype(np.float32), (len(rays), 1))
        hits = scene.run(origins, (rays @ pose[:3, :3].T).astype(np.float32), output=1)
        depth = np.where(hits["primID"] >= 0, hits["tfar"], np.nan).reshape(
            SHAPE
        ) + rng.normal(0, 0.001, SHAPE)
        depth[rng.random(SHAPE) < 0.03] = np.nan
        found.append(Frame(depth, INTRINSICS, pose))
    return found


def resident() -> float:
    """MiB of memory that this process holds (Linux)."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def main(
    updates: int = 200,
    threads: int = 2,
    cpu: bool = False,
    seed: int = 0,
    threshold: float = 1.0,
) -> None:
    """Print the tables.

    Args:
        updates: how many are timed, after one session that is not.
        threads: of ONNX Runtime.
        cpu: count the time of the processor, not that of the clock on the wall; with one thread.
        seed: of the places and the noise.
        threshold: of the sessions; 0.97 is that of use.
    """
    system = nextview.load(threshold=threshold, threads=threads)
    views = frames(np.random.default_rng(seed))
    clock = Clock(time.process_time if cpu else time.perf_counter)
    taken = []
    memory = []
    # What is timed is wrapped here, so that the product itself knows nothing of it.
    for module, name, part in (
        (sighting, "fit_facets", "geometry"),
        (sighting, "enclose", "geometry"),
        (resampling, "look_again", "geometry"),
        (plausibility, "check_observation", "rest"),
        (plausibility, "check_last_view", "rest"),
    ):
        timed = clock.timed(part, getattr(module, name), within="finding")
        setattr(module, name, timed)
    policy_type = type(system.policy)
    models_type = type(system.models)
    policy_type.scores = clock.timed("policy", policy_type.scores)  # type: ignore[attr-defined]
    ObservedObject.add = clock.timed("finding", ObservedObject.add)  # type: ignore[method-assign]
    models_type.evidence = clock.timed("networks", models_type.evidence)  # type: ignore[method-assign]
    recogniser = type(system.models.recogniser)
    recogniser.novelty_scores = clock.timed("networks", recogniser.novelty_scores)  # type: ignore[method-assign]
    k = -5
    while k < updates:
        thing = ObservedObject(life_size=False)
        session = system.session(object=thing, distance=0.6)
        while not session.done and k < updates:
            clock.spent.clear()
            begun = clock.now()
            session.update(views[k % FRAMES])
            if session.done:
                # whether it is of a known class is asked for here, where not before
                str(session.result)
            took = clock.now() - begun
            clock.spent["rest"] += took - sum(clock.spent.values())
            if k >= 0:
                taken.append(
                    (len(session.views), took, *(clock.spent[part] for part in PARTS))
                )
                if k % max(1, updates // 10) == 0 or k == updates - 1:
                    memory.append((k, resident()))
            k += 1
    table = np.array(taken)
    numbers = table[:, 0]
    times = 1e3 * table[:, 1:]
    print(
        "mean: "
        + ", ".join(
            f"{name} {m:.1f}"
            for name, m in zip(("all", *PARTS), times.mean(0), strict=True)
        )
    )
    print(
        f"{'ms':16}{'updates':>8}" + "".join(f"{name:>18}" for name in ("all", *PARTS))
    )
    for label, rows in [
        ("all", numbers > 0),
        *((f"frame {n}", numbers == n) for n in range(1, 6)),
    ]:
        if rows.any():
            middle = np.median(times[rows], 0)
            high = np.percentile(times[rows], 99, axis=0)
            cells = "".join(
                f"{f'{m:.1f} ({h:.1f})':>18}" for m, h in zip(middle, high, strict=True)
            )
            print(f"{label:16}{int(rows.sum()):8}{cells}")
    print("median (99th percentile)")
    print("MiB after updates: " + ", ".join(f"{k}: {size:.0f}" for k, size in memory))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
