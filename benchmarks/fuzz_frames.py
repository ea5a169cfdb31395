"""Damaged frames of a depth camera, and damaged views of an object, for fuzz.py: what no file holds."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SHAPE = 96, 128
INTRINSICS = np.array([[110.0, 0, 64.2], [0, 112.0, 47.7], [0, 0, 1]])
BOXES = (((-0.6, -0.6, -0.03), (0.6, 0.6, 0.0)), ((-0.1, -0.07, 0.0), (0.1, 0.09, 0.13)))
"""Lowest and highest corners, metres: a table and a thing on it."""
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-30, 1e-3, 1.0, 70.0, 1e3, 65535.0, 1e30, -1e30, 1e300)
OTHERS: tuple[Any, ...] = (
    None, True, 0, -1, 1.5, 10**40, "", "x", b"x", [], [[]], [[1, 2], [3]], [None], {}, {"a": 1}, (1, 2, 3), object,
    np.zeros(0), np.zeros((0, 0)), np.zeros((0, 5), np.float32), np.array("x"), np.array([None]), np.nan, [1e400],
)  # fmt: skip

Arguments = dict[str, Any]


def rays_of_pixels() -> NDArray[np.float64]:
    """Rays (x, y, 1) of all pixels, (H, W, 3)."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    return np.stack([columns, rows, np.ones(SHAPE)], -1) @ np.linalg.inv(INTRINSICS).T


def look(elevation: float, azimuth: float, distance: float) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Depth (H, W), metres, of the boxes from a direction, degrees, and the camera's pose: rays against slabs."""
    from nextview.viewsphere import look_at_origin

    pose = look_at_origin(np.radians(elevation), np.radians(azimuth), distance)
    rays = rays_of_pixels() @ pose[:3, :3].T
    depth = np.full(SHAPE, np.inf)
    for corners in BOXES:
        with np.errstate(divide="ignore"):
            low, high = np.sort((np.array(corners)[:, None, None] - pose[:3, 3]) / rays, 0)
        near, far = low.max(-1), high.min(-1)
        depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    return np.where(depth < np.inf, depth, 0).astype(np.float32), pose


def make_frames(folder: Path) -> None:
    """Frames of the scene from three sides with all that a frame can have, one file a frame."""
    rng = np.random.default_rng(0)
    for i, direction in enumerate([(40, 20, 0.7), (35, 100, 0.8), (55, 230, 0.65)]):
        depth, pose = look(*direction)
        rays = rays_of_pixels()
        mask = ((rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3])[..., 2] > 0.004
        image = rng.integers(0, 255, SHAPE).astype(np.uint8)
        noise = (1 + 0.002 * rng.normal(size=SHAPE)).astype(np.float32)
        np.savez(
            folder / f"frame{i}.npz", depth=depth * noise, intrinsics=INTRINSICS, pose=pose, mask=mask, image=image
        )


@lru_cache
def read_frame(path: Path) -> Arguments:
    """The arguments of a sound frame."""
    with np.load(path) as file:
        return {name: values if values.ndim else float(values) for name, values in file.items()}


def make_views(folder: Path) -> None:
    """Views of a box from three sides, one file a view."""
    from nextview.cameras.simulated import SimulatedCamera
    from nextview.mesh import make_mesh
    from nextview.viewsphere import ViewSphere

    corners = np.array(np.meshgrid([0, 1], [0, 2], [0, 1.5])).reshape(3, -1).T
    faces = np.array([[a, b, c] for a in range(8) for b in range(a) for c in range(b)])  # all triangles of its corners
    camera = SimulatedCamera(make_mesh(corners, faces), 112)
    for i in (3, 17, 30):
        view = camera.observe(ViewSphere.named("40").poses[i])
        arrays = {"depth": view.depth, "pose": view.pose, "intrinsics": view.intrinsics, "image": view.picture}
        np.savez(folder / f"view{i}.npz", radius=np.float64(0.4), **arrays)


def change(rng: np.random.Generator, value: Any) -> Any:
    """Something else in the place of an array: other numbers, another type or shape, or no array at all."""
    array, kind = np.array(value), rng.random()
    if kind < 0.45 and array.dtype.kind in "fiub":
        changed = _other_numbers(rng, array)
        return changed if array.ndim else float(changed)
    if kind < 0.9 and array.ndim and array.dtype.kind in "fiub":
        return _other_form(rng, array)
    return OTHERS[rng.integers(len(OTHERS))]


def _other_numbers(rng: np.random.Generator, array: NDArray) -> NDArray:
    """The same type and shape."""
    number = NUMBERS[rng.integers(len(NUMBERS))]
    flat = array.ravel().astype(np.float64)
    some = rng.random(flat.size) < 10.0 ** -rng.integers(0, 4)
    part = slice(*sorted(rng.integers(flat.size + 1, size=2)))
    with np.errstate(all="ignore"):
        choice = rng.integers(9)
        if choice == 0:
            flat[rng.integers(flat.size)] = number
        elif choice == 1:
            flat[some] = number
        elif choice == 2:
            flat[part] = number
        elif choice == 3:
            flat = flat * number
        elif choice == 4:
            flat = flat * 10.0 ** rng.integers(-6, 7)
        elif choice == 5:
            flat += rng.normal(size=flat.size) * 10.0 ** rng.integers(-6, 3)
        elif choice == 6:
            flat = rng.permutation(flat)
        elif choice == 7:
            flat[some] *= -1
        else:
            flat[part] = flat[part][::-1]
        if array.dtype.kind in "iu":  # other casts differ between machines
            flat = np.nan_to_num(flat).clip(-(2.0**31), 2.0**31)
        return flat.astype(array.dtype).reshape(array.shape)


def _other_form(rng: np.random.Generator, array: NDArray) -> Any:
    """The same numbers, as near as can be, otherwise."""
    types = ["f2", "f4", "f8", ">f4", "i2", "u2", "i8", "u1", "?", "c8", "U9", "O", "f16"]
    choice = rng.integers(9)
    with np.errstate(all="ignore"):
        if choice < 3:
            scale = rng.choice([1.0, 1000.0])
            try:
                return (array * scale).astype(str(rng.choice(types)))
            except (TypeError, ValueError):
                return array
        if choice == 3:
            return array.T
        if choice == 4:
            return array[tuple(slice(int(rng.integers(0, 3)), int(rng.integers(1, n + 1))) for n in array.shape)]
        if choice == 5:
            return [array[None], array[..., None], array.ravel(), np.stack([array] * 3, -1), array.tolist()][
                rng.integers(5)
            ]
        if choice == 6:
            return np.kron(array, np.ones((int(rng.integers(1, 7)),) * array.ndim)).astype(array.dtype)
        if choice == 7 and array.shape == (4, 4) and array.dtype.kind in "fi":
            turned = np.block([[array[:3, :3].T, -array[:3, :3].T @ array[:3, 3:]], [array[3:]]])  # a pose's inverse
            return [turned, array[:3], array @ np.diag([1, -1, -1, 1.0]), array * 2][rng.integers(4)]
        return np.broadcast_to(array.ravel()[:1].reshape((1,) * array.ndim), array.shape)


def damage(
    load: Callable[[Path], Arguments], rng: np.random.Generator, sound: list[Path], case: Path
) -> list[Arguments]:
    """One to three frames or views of which a few arguments are changed, taken out, or those of another."""
    scene = [dict(load(sound[i])) for i in rng.permutation(len(sound))[: rng.integers(1, 4)]]
    for frame in scene:
        for name in sorted(set(frame) - {"depth", "intrinsics", "pose"}):  # in the same order in every process
            if rng.random() < 0.6:
                del frame[name]
    for _ in range(rng.integers(1, 4)):
        frame = scene[rng.integers(len(scene))]
        name = sorted(frame)[rng.integers(len(frame))]
        if rng.random() < 0.05:
            frame[name] = None
        elif rng.random() < 0.05:
            frame[name] = load(sound[rng.integers(len(sound))])[name]
        elif isinstance(frame[name], np.ndarray | float) and np.size(frame[name]):
            frame[name] = change(rng, frame[name])
    (case / "scene.txt").write_text(
        "\n".join(f"{i} {n}: {_tell(v)}" for i, f in enumerate(scene) for n, v in f.items())
    )
    return scene


def _tell(value: Any) -> str:
    if isinstance(value, np.ndarray):
        data = str(value.tolist()).encode() if value.dtype == object else np.ascontiguousarray(value).tobytes()
        return f"{value.shape} {value.dtype} {zlib.crc32(data):x}" + (f"\n{value}" if value.size < 20 else "")
    return repr(value)


def damage_frames(rng: np.random.Generator, sound: list[Path], case: Path) -> tuple[list[Arguments], Arguments]:
    """Damaged frames, and how the object is asked for, damaged too at times."""
    scene = damage(read_frame, rng, sound, case)
    options: Arguments = {}
    asked = rng.random()
    if asked < 0.15:
        options["point"] = np.array([0, 0, 0.06])
    elif asked < 0.3:
        options["box"] = {
            "low": np.array([-0.11, -0.08, 0.002]),
            "high": np.array([0.11, 0.1, 0.14]),
            "axes": np.eye(3),
        }
    elif asked < 0.4:
        options["known"] = {"centre": np.array([0, 0.01, 0.06]), "radius": 0.15, "axes": np.eye(3)}
    if rng.random() < 0.2:
        options["support"] = False
    if rng.random() < 0.2:
        options["denoise"] = False
    if rng.random() < 0.2:
        options["up"] = None if rng.random() < 0.5 else change(rng, np.array([0, 0, 1.0]))
    if rng.random() < 0.2 and options:
        name = sorted(options)[rng.integers(len(options))]
        if name in ("box", "known"):
            inner = sorted(options[name])[rng.integers(len(options[name]))]
            options[name][inner] = change(rng, options[name][inner])
        elif name == "point":
            options[name] = change(rng, options[name])
    return scene, options


def take_frames(scene: Any) -> None:
    """Make frames, and look at the object in them; a file is a sound frame."""
    from nextview.errors import NextviewError, ObservationError
    from nextview.sensing import Box, Frame, ObjectFrame, ObservedObject

    frames, options = ([read_frame(scene)], {}) if isinstance(scene, Path) else scene
    makers: dict[str, Callable[..., Any]] = {"box": Box, "known": ObjectFrame}
    thing = ObservedObject(**{n: makers[n](**v) if n in makers else v for n, v in options.items()})
    refused: NextviewError | None = None
    for arguments in frames:
        try:
            observation = thing.add(Frame(**arguments))
        except ObservationError as error:
            _one_sentence(error)
            refused = error
            continue
        assert np.isfinite(observation.depth).all()
        assert np.isfinite(thing.object_frame.centre).all()
        assert 0 < thing.object_frame.radius < np.inf
        assert np.isfinite(observation.points).all()
    if refused is not None:  # the others were taken in
        raise refused


@lru_cache
def _system(policy: str) -> Any:
    import nextview

    return nextview.load(policy=policy, threads=1)


def take_views(scene: Any) -> None:
    """Recognise an object by views; a file is a sound view."""
    from nextview.errors import NextviewError, ObservationError
    from nextview.observation import Observation

    views = [read_frame(scene)] if isinstance(scene, Path) else scene
    # The map networks take most of the time: single views are enough for them.
    session = _system("gain" if len(views) == 1 else "spread").session(start=0)
    refused: NextviewError | None = None
    for arguments in views:
        if session.done:
            break
        try:
            view = session.update(Observation(**arguments))
        except ObservationError as error:
            _one_sentence(error)
            refused = error
            continue
        assert np.isfinite(view.belief).all()
        assert abs(view.belief.sum() - 1) < 1e-6
        assert view.values is None or np.isfinite(view.values).any()
    if refused is not None:
        raise refused


def _one_sentence(error: Exception) -> None:
    assert str(error).strip(), "says nothing"
    assert "\n" not in str(error), f"not one sentence: {error}"
