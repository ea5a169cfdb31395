"""Policy for taught things: choose the view in which the most likely things differ most."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import Viewpoints, azimuth_of
from nextview.policies.base import EpisodeState, best_view, check_weight, travel_from
from nextview.things.memory import AZIMUTHS, RINGS, open_memory
from nextview.types import Float, Floats, Index, Mask

# weight of a cosine as a log-likelihood, for a view whose noise is not known yet
WEIGHT = 40.0
# number of compared hypotheses (thing in a resting pose, and azimuth), the most likely ones
LEADING = 24


@dataclass(frozen=True)
class Rivals:
    """The two most likely classes, and their stored views from V candidates.

    Attributes:
        classes: the most likely one first, (2,).
        hypotheses: the likeliest of each, (2,).
        rings: of the stored views, indices, (V,).
        azimuths: likewise, (2, V).
        alike: cosine similarity of the two views, (V,); NaN if one of them is not stored.
    """

    classes: Index
    hypotheses: Index
    rings: Index
    azimuths: Index
    alike: Float


@dataclass(frozen=True, eq=False)
class Discriminate:
    """Chooses the view with the most expected information about the identity, minus weighted
    travel.

    The memory provides the stored view of each leading hypothesis, a thing with its azimuth, from
    each candidate view. If one hypothesis is true, the likelihood of the others follows from their
    similarity to it. The value of a view is the expected logarithm of the belief in the true class
    (expected information: Denzler and Brown, IEEE TPAMI 2002; Borotschnig et al., Image and Vision
    Computing 2000).

    Attributes:
        viewpoints: the candidates, with any positions.
        views: stored views of each hypothesis, (H, rings, azimuths, F), unit vectors; zero if
            unknown.
        classes: class of each hypothesis, (H,).
        travel_weight: of a grid cell of travel.
        needs: required inputs, see ``Policy.needs``.
    """

    viewpoints: Viewpoints
    views: Floats
    classes: Index
    travel_weight: float = 0.0
    needs: tuple[str, ...] = ("joint",)

    def __post_init__(self) -> None:
        check_weight(self.travel_weight)

    @classmethod
    def from_card(
        cls,
        path: Path,
        viewpoints: Viewpoints,
    ) -> "Discriminate":
        """Create the policy for the things of a memory.

        Args:
            path: of the memory's card.
            viewpoints: the candidate views.

        Returns:
            The policy.

        Raises:
            PolicyError: the memory holds no views.
        """
        card, memory = open_memory(path)
        if not memory.has_features:
            raise PolicyError(
                f"{path}: holds no views of its things, which are recognised by their geometry"
            )
        return cls(viewpoints, memory.views, np.array(card.calibration.hypotheses))

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view in which the leading things differ most; ties are broken at random.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        values = self.view_values(state)
        return best_view(
            self.viewpoints,
            state,
            values + 1e-9 * rng.random(values.shape),
        )

    def view_values(self, state: EpisodeState) -> Float:
        if state.joint is None:
            raise PolicyError(
                "this policy needs the belief in things and azimuths together: models made by learn"
            )

        here = (
            self.viewpoints.azimuth[state.current]
            if state.places is None
            else azimuth_of(state.places[:, -1])
        )
        worth = [
            self._worth(joint, azimuth)
            for joint, azimuth in zip(state.joint, here, strict=True)
        ]
        return np.stack(worth) - self.travel_weight * travel_from(
            self.viewpoints,
            state,
        )

    def _worth(self, joint: Float, here: float) -> Float:
        """Return the expected log-belief in the true class after each view, (V,).

        The belief is (H, azimuths), relative to the current azimuth ``here``.
        """
        flat = joint.ravel()
        leading = (
            np.argpartition(-flat, LEADING - 1)[:LEADING]
            if len(flat) > LEADING
            else np.arange(len(flat))
        )
        hypothesis, azimuth = np.divmod(leading, AZIMUTHS)
        belief = flat[leading] / flat[leading].sum()
        ring, bins = self._remembered(azimuth, here)
        shown = self.views[hypothesis[:, None], ring, bins].astype(np.float32)
        shown = shown.swapaxes(0, 1)
        alike = shown @ shown.swapaxes(1, 2)  # (V, leading, leading)
        known: Mask = np.asarray(shown.any(2))
        # unknown views carry no information
        alike = np.where(known[:, :, None] & known[:, None], alike, 1)
        kept = np.exp(-WEIGHT * (1 - alike.astype(np.float64))) * belief
        same = self.classes[hypothesis][:, None] == self.classes[hypothesis]
        return np.log((kept * same).sum(2) / kept.sum(2)) @ belief

    def _remembered(self, azimuth: Index, here: float) -> tuple[Index, Index]:
        """Return ring, (V,), and azimuth bin, (n, V), of the nearest stored views."""
        ahead = np.rint(
            (self.viewpoints.azimuth - here) / (2 * np.pi) * AZIMUTHS
        ).astype(np.int64)
        ring = np.abs(np.degrees(self.viewpoints.elevation)[:, None] - RINGS).argmin(1)
        return ring, (azimuth[:, None] + ahead) % AZIMUTHS

    def rivals(self, joint: Float, here: float) -> Rivals | None:
        """Return the two most likely classes with their stored views from every candidate.

        Args:
            joint: belief in each hypothesis and azimuth bin, (H, azimuths).
            here: azimuth of the camera, radians.

        Returns:
            The two classes; None if all hypotheses are of one class.
        """
        of_class = np.bincount(self.classes, joint.sum(1))
        if len(of_class) < 2:
            return None

        two = np.argsort(-of_class, kind="stable")[:2]
        of_two = np.where((self.classes == two[:, None])[..., None], joint, -1)
        hypothesis, azimuth = np.divmod(of_two.reshape(2, -1).argmax(1), AZIMUTHS)
        ring, bins = self._remembered(azimuth, here)

        shown = self.views[hypothesis[:, None], ring, bins].astype(np.float64)
        return Rivals(
            two,
            hypothesis,
            ring,
            bins,
            np.where(shown.any(2).all(0), (shown[0] * shown[1]).sum(1), np.nan),
        )
