"""The store survives what happens to long jobs, done for real: kills, full disks, broken meshes,
second runs. What is rendered through a sensor is the same to the bit then, too.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nextview.errors import DatasetError
from nextview.geometry.viewsphere import ViewSphere
from nextview.simulation.sensor import sensor_named
from nextview_lab.data.rendering import RenderOptions, render
from nextview_lab.data.store import RENDERED_ARRAYS, ViewStore

SPHERE = ViewSphere((20.0,), 3)
SIZE = 224
SENSED = RenderOptions(sensor="wrist:2")
SCRIPT = """
import multiprocessing, os, signal, sys
from pathlib import Path
from nextview_lab.data.rendering import RenderOptions, render
from nextview.geometry.viewsphere import ViewSphere
dataset, path = sys.argv[1:]
given = ViewSphere((20.0,), 3), 224, RenderOptions(sensor="wrist:2")
for n, _ in enumerate(render(Path(dataset), Path(path), *given, workers=2), 1):
    if n == 3:
        print(*(child.pid for child in multiprocessing.active_children()), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""


def assert_same(a: Path, b: Path) -> None:
    first, second = ViewStore.open(a), ViewStore.open(b)
    for name in RENDERED_ARRAYS:
        np.testing.assert_array_equal(
            first.array(name)[:], second.array(name)[:], err_msg=name
        )
    assert not list(b.rglob("*.partial"))
    assert not b.with_name(b.name + ".part").exists()


@pytest.fixture(scope="module")
def whole(furniture, tmp_path_factory) -> Path:
    """A store made without interruption, by this process."""
    path = tmp_path_factory.mktemp("whole") / "views.zarr"
    rendered = render(furniture, path, SPHERE, SIZE, SENSED, workers=0)
    assert [reason for _, reason in rendered] == [None] * 18
    return path


@pytest.fixture
def meshes(furniture, tmp_path) -> Path:
    """A copy of some of the furniture: chair_0 to chair_5."""
    return shutil.copytree(furniture / "chair", tmp_path / "meshes/chair").parent


def alive(process: int) -> bool:
    try:
        return (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
            != "Z"
        )
    except OSError:
        return False


linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux
def test_kill_of_the_parent_loses_nothing_and_leaves_no_orphans(
    furniture, whole, tmp_path
):
    path = tmp_path / "views.zarr"
    killed = subprocess.run(
        [sys.executable, "-c", SCRIPT, furniture, path],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert killed.returncode == -signal.SIGKILL
    workers = [int(word) for word in killed.stdout.split()]
    assert len(workers) == 2
    deadline = time.monotonic() + 30
    while any(alive(w) for w in workers):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.02)
    done = int(ViewStore.open(path).done.sum())
    assert 3 <= done < 18
    # As if the kill had come in the middle of a write: zarr writes aside under such a name.
    (path / "image" / "c" / "0.00.partial").write_bytes(b"half")
    for other in (RenderOptions(), RenderOptions(sensor="wrist")):
        with pytest.raises(DatasetError):
            list(render(furniture, path, SPHERE, SIZE, other, workers=0))
    left = render(furniture, path, SPHERE, SIZE, SENSED, workers=0)
    assert len(list(left)) == 18 - done
    assert_same(whole, path)
    sensor = ViewStore.open(path).group.attrs["sensor"]
    assert sensor == sensor_named("wrist:2").to_dict()


def test_broken_meshes_are_recorded_and_tried_again(meshes, tmp_path):
    broken = meshes / "chair/train/chair_2.off"
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    (meshes / "chair/train/chair_3.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 0 0\n")
    path = tmp_path / "views.zarr"
    reasons = dict(render(meshes, path, SPHERE, SIZE, workers=0))
    store = ViewStore.open(path)
    assert store.attributes.failures == {
        name: reason for name, reason in reasons.items() if reason
    }
    assert "cut short" in store.attributes.failures["chair_2"]
    assert "no extent" in store.attributes.failures["chair_3"]
    assert store.done.tolist() == [
        name not in store.attributes.failures for name in store.names
    ]
    assert next(iter(render(meshes, path, SPHERE, SIZE, workers=0)))[
        1
    ]  # a later run says it again


def test_a_box_is_stored_as_it_is_seen(tmp_path):
    """The nearest face of a box, straight ahead: its depth, its points and its silhouette are
    known.
    """
    half = np.array([0.3, 0.5, 0.7])
    path = tmp_path / "meshes/box/box.off"
    path.parent.mkdir(parents=True)
    trimesh.creation.box(2 * half * 12.5).export(path)  # in any unit
    sphere = ViewSphere.named("40")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", sphere, 224, workers=0))
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


KILLER = """
import multiprocessing, os, sys

def hook(event, arguments):
    opens = event == "open" and str(arguments[0]).endswith("chair_1.off")
    if opens and multiprocessing.parent_process():
        os._exit(9)

sys.addaudithook(hook)
"""
"""As sitecustomize.py: a worker that opens this mesh dies, as one does that runs out of memory."""


def test_a_mesh_that_kills_its_worker_twice_is_left_out_and_listed_and_the_others_are_rendered(
    meshes, tmp_path
):
    (tmp_path / "sitecustomize.py").write_text(KILLER)
    for mesh in (meshes / "chair/train").glob("chair_[23].off"):
        mesh.unlink()
    path = tmp_path / "views.zarr"
    place = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    line = (
        f"-m nextview_lab render {meshes} {path} --viewpoints 12 --size 16 --workers 2"
    )
    ran = subprocess.run(
        [sys.executable, *line.split()],
        env=os.environ | {"PYTHONPATH": place},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    said = " ".join((ran.stdout + ran.stderr).split())
    assert "Traceback" not in said
    assert "chair_1.off: the process that worked on it died, twice" in said

    store = ViewStore.open(path)
    assert store.attributes.failures.keys() == {"chair_1"}
    assert {
        name for name, done in zip(store.names, store.done, strict=True) if done
    } == set(store.names) - {"chair_1"}

    # Where nothing kills the worker, the next run renders it, and its reason goes.
    assert dict(render(meshes, path, ViewSphere.named("12"), 16, workers=0)) == {
        "chair_1": None
    }
    assert not ViewStore.open(path).attributes.failures


def test_a_dask_cluster_renders_the_same(furniture, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    path = tmp_path / "views.zarr"
    with distributed.LocalCluster(
        n_workers=2,
        processes=True,
        threads_per_worker=1,
        dashboard_address=None,
        silence_logs=50,
    ) as cluster:
        address = cluster.scheduler_address
        rendered = render(furniture, path, SPHERE, SIZE, SENSED, scheduler=address)
        names = [name for name, _ in rendered]
    assert sorted(names) == sorted(ViewStore.open(path).names)
    assert_same(whole, path)
