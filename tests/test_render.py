"""The store survives what happens to long jobs, done for real: kills, full disks, broken meshes, second runs."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nextview.data.pool import WorkerDied, each
from nextview.data.rendering import render
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.files import only_one
from nextview.geometry.viewsphere import ViewSphere

SPHERE = ViewSphere.named("12")
SIZE = 64
SCRIPT = """
import multiprocessing, os, signal, sys
from pathlib import Path
from nextview.data.rendering import RenderOptions, render
from nextview.geometry.viewsphere import ViewSphere
dataset, path, victim = sys.argv[1:]
for n, _ in enumerate(render(Path(dataset), Path(path), ViewSphere.named("12"), 64, workers=2), 1):
    if n == 3:
        workers = [child.pid for child in multiprocessing.active_children()]
        print(*workers, flush=True)
        os.kill(os.getpid() if victim == "parent" else workers[0], signal.SIGKILL)
print(n)
"""


def make_dataset(folder: Path, count: int = 24) -> Path:
    rng = np.random.default_rng(0)
    for i in range(count):
        mesh = trimesh.creation.icosphere(3) if i % 2 else trimesh.creation.box()
        mesh.apply_scale(rng.uniform(0.5, 2, 3))
        path = folder / ("ball" if i % 2 else "box") / ("train" if i % 3 else "test") / f"thing_{i:02d}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh.export(path)
    return folder


def arrays(path: Path) -> dict[str, np.ndarray]:
    group = ViewStore.open(path).group
    return {
        name: group[name][:]
        for name in ("image", "depth", "points", "status", *(f"measures/{m}" for m in group["measures"]))
    }


def assert_same(a: Path, b: Path) -> None:
    first, second = arrays(a), arrays(b)
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg=name)
    assert not list(b.rglob("*.partial"))
    assert not b.with_name(b.name + ".part").exists()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("meshes"))


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory) -> Path:
    """A store made without interruption, by one process."""
    path = tmp_path_factory.mktemp("whole") / "views.zarr"
    assert [reason for _, reason in render(dataset, path, SPHERE, SIZE, workers=1)] == [None] * 24
    return path


def render_and_kill(dataset: Path, path: Path, victim: str) -> tuple[int, list[int]]:
    """Exit status, and the numbers that the script prints."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, dataset, path, victim], stdout=subprocess.PIPE, text=True, timeout=120
    )
    return done.returncode, [int(word) for word in done.stdout.split()]


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux
def test_kill_of_the_parent_loses_nothing_and_leaves_no_orphans(dataset, whole, tmp_path):
    path = tmp_path / "views.zarr"
    status, workers = render_and_kill(dataset, path, "parent")
    assert status == -signal.SIGKILL
    assert len(workers) == 2
    deadline = time.monotonic() + 30
    while any(alive(w) for w in workers):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.02)
    done = int(ViewStore.open(path).done.sum())
    assert 3 <= done < 24
    # As if the kill had come in the middle of a write: zarr writes aside under such a name.
    (path / "image" / "c" / "0.00.partial").write_bytes(b"half")
    assert len(list(render(dataset, path, SPHERE, SIZE, workers=1))) == 24 - done
    assert_same(whole, path)


@linux
def test_a_full_disk_says_so_and_the_next_run_goes_on(dataset, whole, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", disk]).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        path = disk / "views.zarr"
        with pytest.raises(DatasetError, match="cannot be written"):
            list(render(dataset, path, SPHERE, SIZE, workers=1))
        done = int(ViewStore.open(path).done.sum())
        assert 0 < done < 24
        subprocess.run(["mount", "-o", "remount,size=100m", disk], check=True)
        assert len(list(render(dataset, path, SPHERE, SIZE, workers=1))) == 24 - done
        assert_same(whole, path)
    finally:
        subprocess.run(["umount", disk], check=True)


def test_two_runs_on_one_store_refuse_each_other(dataset, whole):
    with only_one(whole), pytest.raises(DatasetError, match="another run"):
        list(render(dataset, whole, SPHERE, SIZE, workers=0))
    assert list(render(dataset, whole, SPHERE, SIZE, workers=0)) == []  # and it has nothing left to do


def test_other_meshes_are_refused(dataset, whole, tmp_path):
    changed = make_dataset(tmp_path / "changed")
    with (changed / "box/test/thing_00.off").open("a") as file:
        file.write("\n")
    with pytest.raises(DatasetError, match="begun with other sha256"):
        list(render(changed, whole, SPHERE, SIZE))


def test_broken_meshes_are_recorded_and_tried_again(tmp_path):
    meshes = make_dataset(tmp_path / "meshes", 3)
    broken = meshes / "box/train/thing_02.off"
    good = broken.read_bytes()
    broken.write_bytes(good[: len(good) // 2])
    (meshes / "box/train/thing_03.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 0 0\n")
    path = tmp_path / "views.zarr"
    reasons = dict(render(meshes, path, SPHERE, SIZE, workers=0))
    store = ViewStore.open(path)
    assert store.failures == {name: reason for name, reason in reasons.items() if reason}
    assert "cut short" in store.failures["thing_02"]
    assert "no extent" in store.failures["thing_03"]
    assert store.done.tolist() == [name not in store.failures for name in store.names]
    assert next(iter(render(meshes, path, SPHERE, SIZE, workers=0)))[1]  # a later run says it again


def test_identical_meshes_are_known_by_their_bytes(tmp_path):
    meshes = make_dataset(tmp_path / "meshes", 4)
    (meshes / "box/train/twin.off").write_bytes((meshes / "ball/train/thing_01.off").read_bytes())
    list(render(meshes, tmp_path / "views.zarr", SPHERE, SIZE, workers=0))
    store = ViewStore.open(tmp_path / "views.zarr")
    assert [{store.names[i] for i in group} for group in store.duplicates] == [{"thing_01", "twin"}]


def test_a_box_is_stored_as_it_is_seen(tmp_path):
    """The nearest face of a box, straight ahead: its depth, its points and its silhouette are known."""
    half = np.array([0.3, 0.5, 0.7])
    path = tmp_path / "meshes/box/box.off"
    path.parent.mkdir(parents=True)
    trimesh.creation.box(2 * half * 12.5).export(path)  # in any unit
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", ViewSphere.named("40"), 224, workers=0))
    store = ViewStore.open(tmp_path / "views.zarr")
    half /= np.linalg.norm(half)
    image, depth, points = store.image(0), store.depth(0), store.points(0)
    for view, axis in [(0, 0), (2, 1), (4, 0), (6, 1)]:  # looking along -x, -y, +x, +y
        assert depth[view, 112, 112] == pytest.approx(3 - half[axis], abs=1e-4)
        side = 1.0 if view < 4 else -1.0
        np.testing.assert_allclose(points[view][:, axis], side * half[axis], atol=2e-4)
        width, height = 2 * half[1 - axis], 2 * half[2]
        pixels = width * height * (store.intrinsics[0, 0] / (3 - half[axis])) ** 2
        assert np.count_nonzero(depth[view]) == pytest.approx(pixels, rel=0.03)
    np.testing.assert_array_equal(image > 0, depth > 0)
    assert (np.abs(points) <= half + 2e-4).all()


def test_every_face_of_a_cube_is_where_its_view_looks(tmp_path):
    """A cube with a knob of another length on each side: which one points at the camera, which way is right and up."""
    knobs = {(1, 0, 0): 0.1, (0, 1, 0): 0.2, (-1, 0, 0): 0.3, (0, -1, 0): 0.4}
    parts = [trimesh.creation.box([1, 1, 1])]
    for direction, length in knobs.items():
        d = np.array(direction)
        parts.append(trimesh.creation.box(np.where(d != 0, length, 0.2)))
        parts[-1].apply_translation(d * (0.5 + length / 2))
    parts.append(trimesh.creation.box([0.2, 0.2, 0.5], trimesh.transformations.translation_matrix([0, 0, 0.75])))
    shape = trimesh.util.concatenate(parts)
    (tmp_path / "meshes/cube").mkdir(parents=True)
    shape.export(tmp_path / "meshes/cube/cube.off")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", ViewSphere.named("40"), 224, workers=0))
    depth = ViewStore.open(tmp_path / "views.zarr").depth(0)
    centre = shape.bounds.mean(0)
    radius = np.linalg.norm(shape.vertices - centre, axis=1).max()
    for view, direction in zip((0, 2, 4, 6), knobs, strict=True):
        d = np.array(direction)
        focal = 112 * np.sqrt(8)
        eye = 3 * d * radius + centre  # in the file's frame
        face = d * (0.5 + knobs[direction])  # middle of the knob that points at the camera
        right = np.array([-d[1], d[0], 0])  # the camera's, for one that stands at d and looks at the origin
        ahead = (face - eye) @ -d
        column = 112 + focal * ((face - eye) @ right) / ahead
        row = 112 - focal * (face - eye)[2] / ahead
        assert depth[view, int(row), int(column)] == pytest.approx(ahead / radius, abs=1e-3)
        seen = np.argwhere(depth[view] > 0)
        spike = np.array([0, 0, 1.0]) - eye  # the only thing on top: its middle is the highest that is seen
        assert seen[:, 0].min() == pytest.approx(112 - focal * spike[2] / (spike @ -d - 0.1), abs=1.5)
        beside = knobs[tuple(int(x) for x in right)]  # the knob on the right of the picture
        edge = right * (0.5 + beside) - eye
        assert seen[:, 1].max() + 1 == pytest.approx(112 + focal * (edge @ right) / (edge @ -d - 0.1), abs=1.5)


def die_on_three(item: int) -> int:
    if item == 3:
        os._exit(9)
    return item * item


def test_an_item_that_kills_its_process_is_the_only_one_lost():
    results = dict(each(die_on_three, range(8), workers=2))
    assert isinstance(results.pop(3), WorkerDied)
    assert results == {i: i * i for i in range(8) if i != 3}


def test_a_dask_cluster_renders_the_same(dataset, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    path = tmp_path / "views.zarr"
    with distributed.LocalCluster(
        n_workers=2, processes=True, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        names = [name for name, _ in render(dataset, path, SPHERE, SIZE, scheduler=cluster.scheduler_address)]
    assert sorted(names) == sorted(ViewStore.open(path).names)
    assert_same(whole, path)
