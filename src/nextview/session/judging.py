"""Recognise several objects from all of their views, with one batch for the networks."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from threadpoolctl import ThreadpoolController

from nextview.cores import cores
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import Viewpoints, azimuth_of, direction_of
from nextview.recognition.belief import SizeEvidence, Stopping, log_evidence_of
from nextview.recognition.evidence import Evidence
from nextview.recognition.inference import Models
from nextview.recognition.protocol import JointBelief, JudgesTogether
from nextview.sensing.observed_object import ObservedObject
from nextview.session.result import Recognition
from nextview.session.view import View
from nextview.types import Floats


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    """Return a controller of the thread pools below NumPy."""
    return ThreadpoolController().select(user_api="blas")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Limit NumPy's matrix products to one thread in this context.

    They are small, and the threads of BLAS spin while they wait for each other. That takes the
    cores from the networks; on a computer that is busy otherwise, a search takes several times as
    long.
    """
    return _blas().limit(limits=1)


class Judge:
    """Recogniser of objects from all of their views.

    It caches the network outputs of an observation as long as the observation is in use.
    """

    def __init__(
        self,
        models: Models,
        sphere: Viewpoints,
        stopping: Stopping,
        unknown: float,
    ) -> None:
        """Use the models and rules of a system or of a session.

        Args:
            models: recogniser and map networks.
            sphere: the candidate views.
            stopping: the stopping rule.
            unknown: significance level of the test for unknown objects; 0 disables it.
        """
        self.models = models
        self.sphere = sphere
        self.stopping = stopping
        self.unknown = unknown
        self._said: WeakKeyDictionary[Observation, Evidence] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the cached network outputs, which are computed again."""
        return vars(self) | {"_said": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _said=WeakKeyDictionary())

    def __call__(self, things: Sequence[ObservedObject]) -> list[Recognition]:
        """Recognise objects, as many in parallel as there are cores.

        Args:
            things: each with at least one view.

        Returns:
            The recognition of each object, in the same order.
        """
        self._ask([seen for thing in things for seen in thing.observations])
        threads = min(cores(), len(things))
        if threads < 2:
            return [self._judged(thing) for thing in things]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(self._judged, things))

    def _ask(self, observations: Sequence[Observation]) -> None:
        """Run the networks on observations that are not in the cache."""
        new = [seen for seen in observations if seen.seen and seen not in self._said]
        if not new:
            return
        found = self.models.recogniser(new)
        for row, seen in enumerate(new):
            self._said[seen] = found.select([row])

    def _judged(self, thing: ObservedObject) -> Recognition:
        """Recognise one object from all of its views."""
        recogniser = self.models.recogniser
        seen = [one for one in thing.observations if one.seen]
        joint = None
        if seen and isinstance(recogniser, JudgesTogether):
            total = np.sum([self._log_evidence(one) for one in seen], axis=0)
            joint = recogniser.together(seen, total, len(seen))

        views = self._views(thing, joint)
        result = Recognition.of(
            views, self.models, self.sphere, self.stopping, self.unknown, thing
        )
        enough = result.seen and self._reached(views)
        return replace(result, confident=enough and not result.refused)

    def _log_evidence(self, seen: Observation) -> Floats:
        """Return the network evidence of a view in a form that can be summed over views, (D,)."""
        found = self._said[seen]
        azimuth = azimuth_of(direction_of(seen.pose)[None])
        return np.asarray(log_evidence_of(found.logits, found.azimuth_bins, azimuth)[0])

    def _views(self, thing: ObservedObject, joint: JointBelief | None) -> list[View]:
        """Return the views of an object; the joint belief is that after the last one."""
        total: Floats | None = None
        counted = 0
        views = []

        for number, seen in enumerate(thing.observations):
            evidence = None
            if seen.seen:
                evidence = self._said[seen]
                own = self._log_evidence(seen)
                total = own if total is None else total + own
                counted += 1
            last = number == len(thing.observations) - 1
            view = View.of(
                seen,
                evidence,
                total,
                counted,
                self.sphere,
                self.models.recogniser,
                joint if last else None,
            )
            views.append(replace(view, warnings=thing.warnings_of_view(number)))
        return views

    def _reached(self, views: Sequence[View]) -> bool:
        """Return True if the belief is high enough."""
        counted = np.cumsum([view.observation.seen for view in views])
        beliefs = np.stack([view.belief for view in views])
        along = self.stopping.reached_along(beliefs, np.maximum(counted, 1))
        return bool(along[-1])

    @property
    def widest(self) -> float | None:
        """Diameter of the largest taught thing, metres; None if no sizes are known."""
        return None if self._sizes is None else 2 * float(self._sizes.largest)

    @property
    def narrowest(self) -> float | None:
        """Diameter of the smallest taught thing, metres; None if no sizes are known."""
        return None if self._sizes is None else 2 * float(self._sizes.smallest)

    @property
    def _sizes(self) -> SizeEvidence | None:
        """Sizes of the taught things, if they are known."""
        card = getattr(self.models.recogniser, "card", None)
        return None if card is None else card.size
