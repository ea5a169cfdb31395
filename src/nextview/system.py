"""The front door: a recogniser, maps, a policy, candidate viewpoints and a stopping rule that belong together.

>>> system = load()
>>> system.recognise("chair.off")                                               # doctest: +SKIP
chair (belief 0.998, 2 views, 1.41 cells of travel, confident)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nextview.belief import Stopping
from nextview.errors import ModelError, OtherUseError
from nextview.mesh import Mesh, load_mesh
from nextview.models.collection import find_models
from nextview.models.inference import MapNetwork, Models, Recogniser
from nextview.observation import Camera
from nextview.policies.base import Policy, maps_among
from nextview.policies.registry import make_policy
from nextview.session import Recognition, Session
from nextview.viewsphere import ViewSphere

DEFAULT = "modelnet10"
"""The models that ship with the package."""


@dataclass(frozen=True, repr=False)
class System:
    """All that is needed to recognise an object. ``load`` makes one.

    It can be pickled, for worker processes: as how it was loaded, so that each process opens the models itself.

    Attributes:
        models: recogniser and map networks.
        policy: chooses the next view.
        policy_name: what it is called.
        sphere: the candidate viewpoints.
        stopping: when an episode ends.
        unknown: the share of objects of known classes that may be taken for unknown ones; 0 where none is.
        loaded: the arguments of ``load`` that make it.
    """

    models: Models
    policy: Policy
    policy_name: str
    sphere: ViewSphere
    stopping: Stopping
    unknown: float
    loaded: dict[str, Any] = field(repr=False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes that it knows."""
        return self.models.classes

    def session(self, start: int | None = None, seed: int = 0) -> Session:
        """One object under way, for whoever moves the camera.

        Args:
            start: the first view, an index of ``sphere``; drawn by the seed if not given.
            seed: decides the first view and whatever the policy draws.

        Raises:
            UsageError: there is no such view.
        """
        rng = np.random.default_rng(seed)
        drawn = int(rng.integers(len(self.sphere)))
        start = drawn if start is None else start
        return Session(self.models, self.policy, self.sphere, start, self.stopping, rng, self.unknown)

    def recognise(
        self,
        what: str | Path | Mesh | Camera,
        start: int | None = None,
        seed: int = 0,
        up: str | None = None,
        unit: str | None = None,
    ) -> Recognition:
        """Look at an object until it is clear what it is, or the views run out.

        Args:
            what: a mesh file (OFF, OBJ, PLY, STL or GLB), a mesh, or a camera: anything with ``observe(pose)``.
            start: the first view, an index of ``sphere``; drawn by the seed if not given.
            seed: decides the first view and whatever the policy draws.
            up: the up axis of a file, "y" or "z"; z if not given, but y for GLB.
            unit: the unit of length of a file, one of ``mesh.UNITS``, if it is known: size says something of the class.

        Raises:
            MeshError: the file cannot be used.
        """
        if isinstance(what, str | Path):
            what = load_mesh(what, up, unit)
        if isinstance(what, Mesh):
            from nextview.cameras.simulated import SimulatedCamera

            what = SimulatedCamera(what)
        return self.session(start, seed).run(what)

    def __repr__(self) -> str:
        name, views = self.models.recogniser.card.name, len(self.sphere)
        return f"System({name}, policy {self.policy_name}, {views} viewpoints, {self.stopping})"

    def __reduce__(self) -> tuple[Callable[..., System], tuple[dict[str, Any]]]:
        return _load, (self.loaded,)


def load(
    models: str | Path = DEFAULT,
    policy: str | None = None,
    threshold: float = 0.97,
    risk: float | None = None,
    max_views: int = 5,
    viewpoints: str = "40",
    threads: int = 0,
    unknown: float = 0.0,
) -> System:
    """Open models, and what belongs to them.

    Args:
        models: the name of bundled models, or a folder with the card of a recogniser, and of maps and policies of its
            own if there are any (``nextview export``, ``nextview train gain``). Maps that it lacks are the bundled
            ones, which know no classes.
        policy: how the next view is chosen; "gain" by default, where one was learned for these classes, else "spread".
            Names are those of ``nextview.policies.registry``, of policy cards in the folder, or "MODULE:CLASS".
        threshold: stop when the belief in one class reaches this after one view, and less after several.
        risk: instead, stop at the lowest threshold at which at most this share of those who stop early is wrong.
        max_views: stop after so many views.
        viewpoints: name of the layout of candidate viewpoints.
        threads: of ONNX Runtime, 0 for one on each core.
        unknown: answer None where an object looks as strange as at most this share of the objects of known classes: so
            often one of these is taken for unknown. 0 always names a class.

    Raises:
        ModelError: there are no such models, or one of them cannot be used, or this recogniser cannot tell unknown
            objects.
        PolicyError: there is no such policy, or it cannot be made.
        RiskError: the error rate cannot be promised.
        UsageError: a threshold, a rate or a number of views makes no sense.
    """
    given = {k: v for k, v in locals().items() if k != "models"} | {"models": str(models)}
    Stopping(threshold, max_views)  # says what is wrong with it, before anything is opened
    found = find_models(models)
    sphere = ViewSphere.named(viewpoints)
    recogniser = Recogniser(found.recogniser, threads)
    if unknown and recogniser.novelty is None:
        raise ModelError(f"{found.recogniser}: cannot tell unknown objects; nextview fit unknown teaches it")
    if policy is None:
        policy, made = _default_policy(found.policies, sphere, recogniser)
    else:
        made = make_policy(str(found.policies.get(policy, policy)), sphere, (), recogniser.classes)
    names = dict.fromkeys(name.removesuffix("-sphere") for name in maps_among(made.needs))
    missing = [name for name in names if name not in found.maps]
    if missing:
        raise ModelError(f"policy {policy} needs the map {missing[0]!r}; there are {', '.join(found.maps)}")
    opened = Models(recogniser, {name: MapNetwork(found.maps[name], threads) for name in names})
    if policy in names:  # "lem" and "lcm" go to the valley for some classes, which the map's card names
        made = make_policy(policy, sphere, opened.valley_classes(policy), recogniser.classes)
    stopping = Stopping.of(recogniser.calibration, threshold, risk, max_views)
    return System(opened, made, policy, sphere, stopping, unknown, given)


def _default_policy(own: dict[str, Path], sphere: ViewSphere, recogniser: Recogniser) -> tuple[str, Policy]:
    """ "gain", where one fits, else "spread", which asks for nothing."""
    try:
        gain = make_policy(str(own.get("gain", "gain")), sphere, (), recogniser.classes)
        if "azimuth_bins" not in gain.needs or recogniser.azimuth_bins == sphere.azimuths:
            return "gain", gain
    except OtherUseError:
        pass
    return "spread", make_policy("spread", sphere)


def _load(given: dict[str, Any]) -> System:
    return load(**given)


_bundled = lru_cache(maxsize=1)(load)


def recognise(what: str | Path | Mesh | Camera, **options: Any) -> Recognition:
    """What an object is, by the bundled models, in one call. Options as for ``System.recognise``.

    >>> recognise("chair.off")                                                  # doctest: +SKIP
    chair (belief 0.998, 2 views, 1.41 cells of travel, confident)
    """
    return _bundled().recognise(what, **options)
