"""Views a second from mesh files to a store on disk, beside the bare ray casts and other renderers,
on the same meshes.

    python -m benchmarks.render MODELNET10 [--objects 100] [--workers 2]
        [--python RIVALS/bin/python]

Open3D and pyrender are no part of this project: give a Python that has them, and rows without one
are reported as such. Every row runs in processes of its own, as many side by side as there are
workers.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from shutil import which

import numpy as np

SIZE = 224
DISTANCE = 3.0
Cost = tuple[np.ndarray, int]
"""Seconds by the clock and by the processor, and rays cast."""


def now() -> np.ndarray:
    """Seconds by the clock, and of processor time: the latter stay fair on a busy machine."""
    return np.array([time.perf_counter(), time.process_time()])


def poses() -> np.ndarray:
    """The 40 views, written out again here, so that the rivals need nothing of nextview."""
    elevation = np.radians(np.repeat([0, 18, 36, 54, 72], 8))
    azimuth = np.radians(np.tile(np.arange(8) * 45, 5))
    outward = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    pose = np.tile(np.eye(4), (40, 1, 1))
    pose[:, :3, 0] = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], -1)
    pose[:, :3, 1] = np.cross(-outward, pose[:, :3, 0])
    pose[:, :3, 2] = -outward
    pose[:, :3, 3] = DISTANCE * outward
    return pose


FOCAL = SIZE / 2 * np.sqrt(DISTANCE**2 - 1)
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])


def read(path: str) -> tuple[np.ndarray, np.ndarray]:
    """A ModelNet mesh in the object frame, without nextview."""
    words = Path(path).read_bytes().replace(b"OFF", b"", 1).split()
    v = int(words[0])
    f = int(words[1])
    vertices = np.array(words[3 : 3 + 3 * v], float).reshape(-1, 3)
    faces = np.array(words[3 + 3 * v : 3 + 3 * v + 4 * f], int).reshape(-1, 4)[:, 1:]
    vertices -= (vertices.min(0) + vertices.max(0)) / 2
    return vertices / np.linalg.norm(vertices, axis=1).max(), faces.astype(np.int32)


# Each way takes a list of files and returns what they cost; what it imports and reads beforehand is
# not timed.


def embree(files: list[str], bounded: bool = False) -> Cost:
    """The casts alone: rays ready in memory, nothing kept.

    With ``bounded``, those inside the object's bound.
    """
    from nextview.geometry.mesh import load_mesh
    from nextview.simulation.simulated import SimulatedCamera

    seconds = np.zeros(2)
    count = 0
    for file in files:
        camera = SimulatedCamera(load_mesh(file), SIZE, DISTANCE)
        for pose in poses():
            rotation = pose[:3, :3].astype(np.float32)
            origin = pose[:3, 3].astype(np.float32)
            where = camera._bound(rotation, origin) if bounded else slice(None)
            rays = camera._rays[where].reshape(-1, 3) @ rotation.T
            origins = np.broadcast_to(origin, rays.shape).copy()
            began = now()
            camera._scene.run(origins, rays, output=1)
            seconds += now() - began
            count += len(rays)
    return seconds, count


def embree_bounded(files: list[str]) -> Cost:
    return embree(files, bounded=True)


def one_process(files: list[str]) -> Cost:
    """nextview's work on each object, mesh file to arrays in memory."""
    from nextview.geometry.mesh import load_mesh
    from nextview.geometry.viewsphere import ViewSphere
    from nextview.simulation.simulated import SimulatedCamera
    from nextview_lab.data.rendering import render_object

    began = now()
    for file in files:
        render_object(
            SimulatedCamera(load_mesh(file), SIZE, DISTANCE),
            ViewSphere.named("40"),
            SIZE,
        )
    return now() - began, 0


def open3d_raycasting(files: list[str]) -> Cost:
    """RaycastingScene with rays ready: depth and normals, nothing kept."""
    import open3d as o3d

    seconds = np.zeros(2)
    for file in files:
        vertices, faces = read(file)
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
        for pose in poses():
            rays = scene.create_rays_pinhole(K, np.linalg.inv(pose), SIZE, SIZE)
            began = now()
            scene.cast_rays(rays, nthreads=1)
            seconds += now() - began
    return seconds, len(files) * 40 * SIZE * SIZE


def open3d_window(files: list[str]) -> Cost:
    """The thesis's way: a window; an image, a depth image and a cloud of 1,024 points as loose
    files.
    """
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    window = o3d.visualization.Visualizer()
    window.create_window(width=SIZE, height=SIZE, visible=False)
    camera = o3d.camera.PinholeCameraParameters()
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(
        SIZE,
        SIZE,
        FOCAL,
        FOCAL,
        SIZE / 2 - 0.5,
        SIZE / 2 - 0.5,
    )
    seconds = np.zeros(2)
    with tempfile.TemporaryDirectory() as folder:
        for number, file in enumerate(files):
            vertices, faces = read(file)
            began = now()
            mesh = o3d.geometry.TriangleMesh(
                o3d.utility.Vector3dVector(vertices),
                o3d.utility.Vector3iVector(faces),
            )
            mesh.compute_vertex_normals()
            window.clear_geometries()
            window.add_geometry(mesh)
            for view, pose in enumerate(poses()):
                camera.extrinsic = np.linalg.inv(pose)
                window.get_view_control().convert_from_pinhole_camera_parameters(
                    camera,
                    allow_arbitrary=True,
                )
                window.poll_events()
                window.update_renderer()
                image = np.asarray(window.capture_screen_float_buffer(True))
                depth = np.asarray(window.capture_depth_float_buffer(True))
                assert image.any(), "the window shows nothing"
                cloud = o3d.geometry.PointCloud.create_from_depth_image(
                    o3d.geometry.Image(depth),
                    camera.intrinsic,
                    camera.extrinsic,
                    depth_scale=1.0,
                )
                if len(cloud.points) > 1024:
                    cloud = cloud.random_down_sample(1024 / len(cloud.points))
                name = f"{folder}/{number}_{view}"
                o3d.io.write_image(
                    f"{name}.png",
                    o3d.geometry.Image((255 * image).astype(np.uint8)),
                )
                o3d.io.write_image(
                    f"{name}_depth.png",
                    o3d.geometry.Image((1e4 * depth).astype(np.uint16)),
                )
                o3d.io.write_point_cloud(f"{name}.ply", cloud)
            seconds += now() - began
    window.destroy_window()
    return seconds, 0


def pyrender_offscreen(files: list[str]) -> Cost:
    """Image and depth through OSMesa or EGL."""
    import pyrender
    import trimesh

    renderer = pyrender.OffscreenRenderer(SIZE, SIZE)
    camera = pyrender.IntrinsicsCamera(
        FOCAL,
        FOCAL,
        SIZE / 2,
        SIZE / 2,
        znear=0.5,
        zfar=6,
    )
    axes = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera looks along -z, y up
    seconds = np.zeros(2)
    for file in files:
        vertices, faces = read(file)
        began = now()
        scene = pyrender.Scene(bg_color=[0, 0, 0, 0])
        scene.add(
            pyrender.Mesh.from_trimesh(
                trimesh.Trimesh(vertices, faces, process=False),
                smooth=False,
            )
        )
        eye = scene.add(camera)
        light = scene.add(pyrender.DirectionalLight(intensity=3.0))
        for pose in poses():
            scene.set_pose(eye, pose @ axes)
            scene.set_pose(light, pose @ axes)
            renderer.render(scene)
        seconds += now() - began
    return seconds, 0


WAYS: dict[str, Callable[[list[str]], Cost]] = {
    f.__name__: f
    for f in (
        embree,
        embree_bounded,
        one_process,
        open3d_raycasting,
        open3d_window,
        pyrender_offscreen,
    )
}
NEEDS = {
    "open3d_raycasting": "open3d",
    "open3d_window": "open3d",
    "pyrender_offscreen": "pyrender",
}


def command(way: str, python: str) -> list[str]:
    wrap = []
    if way == "open3d_window" and not os.environ.get("DISPLAY"):
        wrap = ["xvfb-run", "-a", "-s", "-screen 0 640x480x24"]
    return [*wrap, python, __file__, "--way", way]


def side_by_side(
    way: str,
    files: list[str],
    workers: int,
    python: str,
) -> tuple[np.ndarray, float, float] | str:
    """Views/s by the clock and per processor second, million rays/s, peak memory (MB); or why it
    cannot run.
    """
    needed = NEEDS.get(way)
    if (
        needed
        and subprocess.run(
            [python, "-c", f"import {needed}"],
            capture_output=True,
        ).returncode
    ):
        return f"{needed} is not installed"
    if command(way, python)[0] == "xvfb-run" and which("xvfb-run") is None:
        return "needs a display or xvfb-run"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if way == "pyrender_offscreen":
        environment |= {"PYOPENGL_PLATFORM": os.environ.get("PYOPENGL_PLATFORM", "egl")}

    def run(part: list[str]) -> subprocess.CompletedProcess:
        return subprocess.run(
            command(way, python),
            input=json.dumps(part),
            capture_output=True,
            text=True,
            env=environment,
        )

    with ThreadPoolExecutor(workers) as pool:
        runs = list(pool.map(run, [files[i::workers] for i in range(workers)]))
    clock = processor = rays = memory = 0.0
    for part, done in enumerate(runs):
        if done.returncode:
            return (done.stderr.strip().splitlines() or ["it crashed"])[-1][:70]
        seconds, used, count, peak = json.loads(done.stdout.splitlines()[-1])
        clock += len(files[part::workers]) * 40 / seconds
        processor += used
        rays += count / seconds / 1e6
        memory = max(memory, peak)
    return np.array([clock, len(files) * 40 / processor]), rays, memory


def end_to_end(
    files: list[str],
    workers: int,
) -> tuple[np.ndarray, float, float, float]:
    """Views/s by the clock and per processor second of the whole command, bytes a view, peak memory
    (MB), seconds.

    The processes' starting is in both.
    """
    from nextview.geometry.viewsphere import ViewSphere
    from nextview_lab.data.rendering import render

    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            link = Path(folder, "meshes", Path(file).parents[1].name, Path(file).name)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(Path(file).resolve())
        store = Path(folder, "views.zarr")
        began = now()
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = list(
            render(
                Path(folder, "meshes"),
                store,
                ViewSphere.named("40"),
                SIZE,
                workers=workers,
            )
        )
        seconds = now() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert [reason for _, reason in done] == [None] * len(files)
        size = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
    seconds[1] += after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return (
        len(files) * 40 / seconds,
        size / len(files) / 40,
        after.ru_maxrss / 1e3,
        seconds[0],
    )


def main(
    modelnet10: Path,
    /,
    objects: int = 100,
    seed: int = 0,
    workers: int = os.cpu_count() or 1,
    python: str = sys.executable,
) -> None:
    """Compare.

    Args:
        modelnet10: the dataset's folder.
        objects: how many, drawn by the seed.
        seed: of the draw.
        workers: processes side by side.
        python: a Python with open3d and pyrender, for the rivals.
    """
    from nextview.data.folders import list_dataset

    entries = list_dataset(modelnet10)
    chosen = np.random.default_rng(seed).choice(
        len(entries),
        min(objects, len(entries)),
        replace=False,
    )
    files = [str(entries[i].path) for i in sorted(chosen)]
    print(f"{len(files)} meshes x 40 views of {SIZE} x {SIZE}, {workers} processes\n")
    ours, size, memory, seconds = end_to_end(files, workers)
    print(
        f"{'way':20}{'views/s':>9}{'per CPU s':>11}{'Mrays/s':>9}{'MB/process':>12}   nextview is"
        " faster by, per CPU s"
    )
    print(
        f"{'nextview, to disk':20}{ours[0]:9.0f}{ours[1]:11.0f}{'':9}{memory:12.0f}",
        end="",
    )
    print(f"   1.00, 1.00 ({seconds:.1f} s, {size / 1e3:.1f} kB a view)")
    for way in WAYS:
        result = side_by_side(
            way,
            files,
            workers,
            python if way in NEEDS else sys.executable,
        )
        if isinstance(result, str):
            print(f"{way:20}{'-':>9}   {result}", flush=True)
            continue
        views, rays, memory = result
        cast = f"{rays:9.1f}" if rays else " " * 9
        print(f"{way:20}{views[0]:9.0f}{views[1]:11.0f}{cast}{memory:12.0f}", end="")
        print(f"   {ours[0] / views[0]:.2f}, {ours[1] / views[1]:.2f}", flush=True)


def one(way: str) -> None:
    seconds, count = WAYS[way](json.load(sys.stdin))
    print(
        json.dumps(
            [*seconds, count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3]
        )
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--way"]:
        one(sys.argv[2])
    else:
        import tyro

        tyro.cli(main)
