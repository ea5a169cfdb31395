"""What the occupancy grid costs, what it looks like, and what the policies that go by it are worth live.

    python benchmarks/occupancy.py latency MESH [--n 64] [--views 40 15]
    python benchmarks/occupancy.py picture MESH grid.png [--start 11]
    python benchmarks/occupancy.py accuracy DATASET/ModelNet10 [--objects 60] [--policies random volumetric gain]
    python benchmarks/occupancy.py decision MESH [--sensor wrist] [--policy visible-gain] [--threads 2]
    python benchmarks/occupancy.py shares learning.zarr

``latency``: milliseconds of an update with one frame, of the expected gain of all candidate views, of the visible share
of 256 points from all of them, and of a whole decision of the policy after one, two, three and four views; of an update
with one frame of a scene, a box before the object, and of what is expected to show from all views: median and fastest
by the clock, and of processor time. ``picture``: the grid from above and from the side after one, two and three views
that the policy chose, and the expected gain of each candidate. ``accuracy``: sessions of fixed length with the
simulated camera on test objects, the same first views for every policy; accuracy and travel after each view, with 95 %
bootstrap intervals over objects. ``decision``: milliseconds of a session's update, from the frame of a depth camera to
the next pose, with boxes around the object: by the clock and of the processor's time. ``shares``: in worlds for
learning, how the share that is expected to show correlates with the true one, over the views that are free after one,
two and three random ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import nextview
from nextview import SimulatedCamera, ViewSphere, load_mesh
from nextview.belief import FixedLength
from nextview.cli.ending import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.data.store import ViewStore
from nextview.data.world_views import scene_intrinsics, world_views
from nextview.errors import ObservationError, UsageError
from nextview.observation import SceneView
from nextview.occupancy import (
    UNSEEN,
    Occupancy,
    SeenScene,
    VoxelGrid,
    expected_visibility,
    new_surface,
    new_volume,
    visible_share,
)
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.volumetric import Volumetric, occupancy_of
from nextview.report.style import ACCENT, BLUE, STYLE
from nextview.session import Session
from nextview.worlds import TARGET, Block, Scene, SceneCamera, WorldCamera
from nextview.worlds.scene import block_item

COLOURS = ListedColormap(["#c9c9c9", "#ffffff", ACCENT, BLUE])
"""Of unseen, free, occluder and object."""


def milliseconds(run: Callable[[], Any], rounds: int) -> tuple[float, float, float]:
    """Median and fastest by the clock, and median of the processor's time."""
    run()
    clock, cpu = [], []
    for _ in range(rounds):
        began, before = time.perf_counter(), time.process_time()
        run()
        clock.append(time.perf_counter() - began)
        cpu.append(time.process_time() - before)
    return 1e3 * float(np.median(clock)), 1e3 * min(clock), 1e3 * float(np.median(cpu))


def latency(
    mesh: tyro.conf.Positional[Path], n: int = 64, views: tuple[str, ...] = ("40", "fibonacci:15"), rounds: int = 30
) -> None:
    """Print how long each part takes."""
    camera, grid = SimulatedCamera(load_mesh(mesh)), VoxelGrid(n)
    print(f"{'':44}{'median':>9}{'fastest':>9}{'CPU':>9}  ms")
    for name in views:
        sphere = nextview.viewsphere.viewpoints_of(name)
        policy, seen = Volumetric(sphere, grid=grid), [camera.observe(sphere.poses[0])]
        visited = np.zeros((1, len(sphere)), bool)
        visited[0, 0] = True
        for k in range(1, 5):
            for what, run in parts(policy, seen, visited).items():
                took = milliseconds(run, rounds)
                of = f"{len(sphere)} candidates, after {k} view" + "s" * (k > 1)
                print(f"{f'{of}: {what}':44}" + "".join(f"{value:9.1f}" for value in took))
            view = int(run())  # the last part is the decision
            visited[0, view] = True
            seen = [*seen, camera.observe(sphere.poses[view])]
        for what, run in scene_parts(load_mesh(mesh), sphere.poses).items():
            took = milliseconds(run, rounds)
            print(f"{f'{len(sphere)} candidates: {what}':44}" + "".join(f"{value:9.1f}" for value in took))


def scene_parts(mesh: nextview.Mesh, poses: np.ndarray) -> dict[str, Callable[[], Any]]:
    """What is timed of an object behind a box, by name."""
    floor = float(mesh.vertices[:, 2].min())
    camera = SceneCamera(
        Scene(mesh, (block_item(Block(1.6, 0, 0, 0.3, 2, 1.5), floor),)), scene_intrinsics(3), (80, 80)
    )
    frames = [
        SceneView(depth, owner == TARGET, pose, scene_intrinsics(3), True)
        for pose in poses[:2]
        for depth, owner in [camera.look(pose)]
    ]
    first, both = SeenScene.of(frames[:1]), SeenScene.of(frames)
    return {
        "scene, first frame": lambda: SeenScene.unseen().seen(frames[0]),
        "scene, second frame": lambda: first.seen(frames[1]),
        "expected visibility": lambda: expected_visibility(both, poses[:, :3, 3]),
    }


def parts(policy: Volumetric, seen: list[nextview.Observation], visited: np.ndarray) -> dict[str, Callable[[], Any]]:
    """What is timed, by name."""
    grid, positions, last = policy.grid, policy.sphere.poses[:, :3, 3], seen[-1]
    known, now = occupancy_of(seen[:-1], grid), occupancy_of(seen, grid)
    flat = np.full((1, 2), 0.5)
    current = np.array([policy.sphere.nearest(last.pose[:3, 3] / np.linalg.norm(last.pose[:3, 3]))[0]])

    def decision() -> int:
        """With a frame that is new, after others that are known, as it is in an episode."""
        views = [*seen[:-1], replace(last)]
        state = EpisodeState(current, visited, flat, Evidence(flat), len(seen), observations=[views])
        return int(policy.next_views(state, np.random.default_rng(0))[0])

    return {
        "update": lambda: known.seen(last.depth, last.pose, last.intrinsics),
        "new volume": lambda: new_volume(now, positions),
        "new surface": lambda: new_surface(now, positions),
        "visible share": lambda: visible_share(now, last.points[:256], positions),
        "decision": decision,
    }


def picture(
    mesh: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], start: int = 11, policy: str = "volumetric"
) -> None:
    """Draw the grid and the gains."""
    sphere, camera = ViewSphere.named("40"), SimulatedCamera(load_mesh(mesh))
    made = nextview.policies.registry.make_policy(policy, sphere)
    assert isinstance(made, Volumetric), f"{policy} is not volumetric"
    grid, view, path = made.grid, start, [start]
    occupancy = Occupancy.unseen(grid, grid.ball)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure((8.4, 7.2), layout="constrained")
        axes = figure.subplots(3, 3)
        for row in axes:
            seen = camera.observe(sphere.poses[view])
            occupancy = occupancy.seen(seen.depth, seen.pose, seen.intrinsics)
            gains = made.gain(occupancy, sphere.poses[:, :3, 3], grid.ball)
            middle = grid.n // 2
            cuts = (occupancy.cells[:, :, middle].T, occupancy.cells[:, middle].T)
            for axis, cut, names in zip(row, cuts, ("xy", "xz"), strict=False):
                axis.imshow(cut, origin="lower", cmap=COLOURS, vmin=0, vmax=3, extent=(-1, 1, -1, 1))
                at = sphere.directions[path]
                axis.plot(1.12 * at[:, 0], 1.12 * at[:, "xyz".index(names[1])], "k^", ms=5, clip_on=False)
                axis.set(xlabel=names[0], ylabel=names[1], xticks=[-1, 0, 1], yticks=[-1, 0, 1])
                axis.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2))
            left = (occupancy.cells[grid.ball] == UNSEEN).mean()
            row[0].set_title(f"after {len(path)}: middle from above", fontsize=9)
            row[1].set_title(f"from the side, {left:.0%} of the ball unseen", fontsize=9)
            shown = row[2].imshow(gains.reshape(sphere.rings, -1), origin="lower", cmap="viridis", aspect="auto")
            figure.colorbar(shown, ax=row[2])
            for k, taken in enumerate(path):
                row[2].text(sphere.azimuth_index[taken], sphere.ring[taken], str(k + 1), color="w", ha="center")
            gains[path] = -np.inf
            view = int(gains.argmax())
            row[2].plot(sphere.azimuth_index[view], sphere.ring[view], "w*", ms=10)
            row[2].set(title=f"gain of each view ({policy}); next: star", xlabel="azimuth", ylabel="ring")
            row[2].title.set_fontsize(9)
            path.append(view)
        figure.savefig(out, dpi=90, facecolor="white")


def accuracy(
    dataset: tyro.conf.Positional[Path],
    policies: tuple[str, ...] = ("random", "random-all", "spread", "volumetric", "coverage", "gain"),
    objects: int = 60,
    n_views: int = 3,
    seed: int = 0,
) -> None:
    """Print accuracy and travel of sessions of a fixed length."""
    entries = [entry for entry in list_dataset(dataset) if entry.split == "test"]
    chosen = np.linspace(0, len(entries) - 1, objects).round().astype(int)
    systems = {name: nextview.load(policy=name) for name in policies}
    starts = np.random.default_rng(seed).integers(40, size=objects)
    right = np.zeros((len(policies), objects, n_views))
    travel = np.zeros((len(policies), objects, n_views))

    def run() -> Any:
        for at, (index, start) in enumerate(zip(chosen, starts, strict=True)):
            camera = SimulatedCamera(load_mesh(entries[index].path))
            for row, system in enumerate(systems.values()):
                rule = replace(FixedLength(), max_views=n_views)
                rng = np.random.default_rng([seed, at])
                session = Session(system.models, system.policy, system.sphere, int(start), rule, rng)
                for k, view in enumerate(session.run(camera).views):
                    right[row, at, k] = system.classes[int(view.belief.argmax())] == entries[index].label
                    travel[row, at, k] = view.travel
            yield at + 1

    track(run(), objects, "looking")
    drawn = np.random.default_rng(seed).integers(objects, size=(2000, objects))
    print(f"{objects} objects of the test split, accuracy in per cent (95 %) and travel in cells after each view")
    for row, name in enumerate(policies):
        cells = []
        for k in range(n_views):
            low, high = np.percentile(right[row, drawn, k].mean(1), (2.5, 97.5))
            mean = f"{100 * right[row, :, k].mean():.1f} ({100 * low:.0f}-{100 * high:.0f})"
            cells.append(f"{mean}, {travel[row, :, k].mean():.2f}")
        print(f"{name:14}" + "   ".join(f"{cell:>24}" for cell in cells))


def decision(
    mesh: tyro.conf.Positional[Path],
    sensor: str = "wrist",
    policy: str = "visible-gain",
    models: str = "modelnet10",
    rounds: int = 10,
    threads: int = 2,
) -> None:
    """Print how long a session takes from a frame to the next pose, with all that stands around the object."""
    target = load_mesh(mesh)
    floor = float(target.vertices[:, 2].min())
    blocks = (Block(1.6, 0, 0, 0.3, 2, 1.5), Block(-0.3, 1.5, 0.5, 0.4, 0.5, 1.8), Block(0.2, -1.7, 0, 0.8, 0.3, 0.9))
    scene = Scene(target, tuple(block_item(block, floor) for block in blocks))
    system = nextview.load(models, policy=policy, threshold=1.0, max_views=5, threads=threads)
    taken: dict[int, list[tuple[float, float]]] = {}
    for n in range(rounds + 1):  # the first is not counted
        camera = WorldCamera(scene, sensor, np.random.default_rng(n), named="box")
        session = system.session_with(camera, seed=n)
        session.reachable = camera.reachable
        while not session.done:
            frame = camera.observe(session.pose)
            began, before = time.perf_counter(), time.process_time()
            try:
                session.update(frame)
            except ObservationError as error:
                camera.refused(error)
                continue
            times = time.perf_counter() - began, time.process_time() - before
            if n:
                taken.setdefault(len(session.views), []).append(times)
    everything = [times for some in taken.values() for times in some]
    height, width = frame.depth.shape
    print(f"{policy}, frames of {width} x {height}, {threads} threads: ms from a frame to the next pose")
    print(f"{'':10}{'updates':>8}{'median':>9}{'worst':>9}{'CPU':>9}{'worst':>9}")
    for label, rows in [*((f"frame {k}", taken[k]) for k in sorted(taken)), ("all", everything)]:
        clock, cpu = 1e3 * np.array(rows).T
        print(f"{label:10}{len(rows):8}{np.median(clock):9.1f}{clock.max():9.1f}{np.median(cpu):9.1f}{cpu.max():9.1f}")


DENSITIES, UNSEEN_PARTS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8), (0.0, 0.02, 0.05, 0.1, 0.2, 0.5)


def shares(
    store: tyro.conf.Positional[Path],
    densities: tuple[float, ...] = DENSITIES,
    unseen_parts: tuple[float, ...] = UNSEEN_PARTS,
    walks: int = 2,
    seed: int = 0,
) -> None:
    """Print how the expected share correlates with the true one, over the views of a world that are free."""
    opened, rng = ViewStore.open(store), np.random.default_rng(seed)
    if "test" in opened.splits:
        raise UsageError(f"{store}: holds worlds of the test split, which chooses nothing")
    positions, truth = opened.sphere.poses[:, :3, 3], opened.measure("visible_share")
    found = np.full((len(opened), walks, 3, len(densities), len(unseen_parts)), np.nan)

    def run() -> Any:
        for i in range(len(opened)):
            world = world_views(opened, i)
            for walk in range(walks):
                reachable, seen = np.flatnonzero(world.reachable), SeenScene.unseen()
                for k, view in enumerate(rng.permutation(reachable)[:3]):
                    seen = seen.seen(world.scene_view(view))
                    reachable = reachable[reachable != view]
                    for a, b in np.ndindex(found.shape[3:]):
                        says = expected_visibility(seen, positions, densities[a], unseen_parts[b]).expected[reachable]
                        if np.ptp(truth[i, reachable]) > 0:  # to expect the same everywhere is to know nothing: 0
                            pair = says, truth[i, reachable]
                            found[i, walk, k, a, b] = np.corrcoef(*pair)[0, 1] if np.ptp(says) > 0 else 0
            yield i + 1

    track(run(), len(opened), "expecting")
    for label, means in [("1 to 3 views", np.nanmean(found, (0, 1, 2)))] + [
        (f"{k + 1} view" + "s" * (k > 0), np.nanmean(found[:, :, k], (0, 1))) for k in range(3)
    ]:
        print(f"after {label}: mean correlation within {len(opened)} worlds, density (rows) and unseen part (columns)")
        print(" " * 8 + "".join(f"{part:8g}" for part in unseen_parts))
        for density, row in zip(densities, means, strict=True):
            print(f"{density:8g}" + "".join(f"{value:8.3f}" for value in row))


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.extras.subcommand_cli_from_dict(
            {"latency": latency, "picture": picture, "accuracy": accuracy, "decision": decision, "shares": shares}
        )
