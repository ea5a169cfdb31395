"""``nextview/RecogniseMesh-v0``: meshes are rendered, and the networks run, as the agent goes."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths, whole
from nextview.cameras.simulated import LARGEST, SimulatedCamera
from nextview.data.folders import list_dataset
from nextview.data.samples import SAMPLES, sample_mesh
from nextview.envs.cohort import Seen
from nextview.envs.recognise_env import TaskEnv, info_of
from nextview.envs.task import Rules, Split, Task
from nextview.errors import DatasetError
from nextview.mesh import Mesh, load_mesh
from nextview.models.collection import find_models
from nextview.models.inference import Models, Recogniser, open_maps
from nextview.observation import Observation
from nextview.policies.base import Evidence
from nextview.viewsphere import ViewSphere

CAMERAS = 16
"""Meshes that are kept ready to be looked at."""


class RecogniseMeshEnv(TaskEnv):
    """Recognise an object by few views of its mesh.

    Args:
        meshes: a folder, CLASS/train|test/MESH or CLASS/MESH; the bundled samples by default, which have no splits.
        split: "train", to learn from, or "test", to judge by; a folder without splits takes None. An agent should not
            learn from the objects that the recogniser itself was trained on, see ``replayed``.
        models: the name of bundled models, or a folder of your own.
        viewpoints: a layout of ``ViewSphere.named``.
        depth: add the depth image: the observation is then {"state": (D,), "depth": (size, size) float32, object radii,
            0 where there is no object}.
        size: side of the image, pixels; a multiple of what the networks take, 112 for the bundled ones.
        balanced: draw every class equally often.
        rules: options of ``Rules``, by name.

    Raises:
        DatasetError: there are no such meshes, or one is of a class that the recogniser does not know.
        ModelError: there are no such models, or maps.
        UsageError: options that make no sense.
    """

    @takes_paths("meshes")
    def __init__(
        self,
        meshes: str | Path | None = None,
        split: Split | None = "train",
        models: str | Path = "modelnet10",
        viewpoints: str = "40",
        depth: bool = False,
        size: int = 224,
        balanced: bool = False,
        **rules: Any,
    ) -> None:
        whole(size, "the side of an image", 1, LARGEST)
        given, found, sphere = Rules(**rules), find_models(models), ViewSphere.named(viewpoints)
        networks = Models(Recogniser(found.recogniser), open_maps(found.maps, given.maps))
        objects = _samples() if meshes is None else _of_folder(Path(meshes), split)
        unknown = [label for _, label, _ in objects if label not in networks.classes]
        if unknown:
            raise DatasetError(f"the recogniser knows no class {unknown[0]!r}; it knows {', '.join(networks.classes)}")
        labels = np.array([networks.classes.index(label) for _, label, _ in objects])
        self._looking = _Rendered([load for *_, load in objects], networks, sphere, size)
        calibration = networks.recogniser.calibration
        names = tuple(name for name, *_ in objects)
        super().__init__(Task(names, labels, networks.classes, sphere, calibration, self._looking, given, balanced))
        self._depth = depth
        if depth:
            image = gymnasium.spaces.Box(0, np.float32(sphere.distance + 1), (size, size))
            self.observation_space = gymnasium.spaces.Dict({"state": self.task.observation_space, "depth": image})

    def _observed(self, seen: Seen) -> tuple[Any, dict[str, Any]]:
        state = seen.observation[0]
        return {"state": state, "depth": self._looking.last.depth} if self._depth else state, info_of(seen)


class _Rendered:
    """Evidence by rendering: ``Task.observe``. ``last`` is the observation that it came from."""

    last: Observation

    def __init__(self, loads: list[Any], models: Models, sphere: ViewSphere, size: int) -> None:
        self._models, self._sphere = models, sphere
        self._camera = lru_cache(CAMERAS)(lambda k: SimulatedCamera(loads[k](), size, sphere.distance))

    def __call__(self, objects: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        seen = [self._camera(int(k)).observe(self._sphere.poses[v]) for k, v in zip(objects, views, strict=True)]
        self.last = seen[-1]
        return self._models.evidence(seen)


def _samples() -> list[tuple[str, str, Any]]:
    """Name, class, and what loads the mesh, of each sample."""
    return [(name, name, lambda name=name: sample_mesh(name)) for name in SAMPLES]


def _of_folder(folder: Path, split: str | None) -> list[tuple[str, str, Any]]:
    """The same of the meshes of a folder."""
    entries = [e for e in list_dataset(folder) if split in (None, e.split)]
    if not entries:
        raise DatasetError(f"{folder}: holds no meshes of the split {split!r}; split=None takes all that there are")

    def loader(path: Path) -> Any:
        def load() -> Mesh:
            return load_mesh(path)

        return load

    return [(e.name, e.label, loader(e.path)) for e in entries]
