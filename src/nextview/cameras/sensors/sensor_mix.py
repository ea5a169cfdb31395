"""Sensors by name; and a mix of them, drawn anew for every object: what networks learn from that are to bear any."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from nextview.arguments import of_kind
from nextview.cameras.sensors.known_sensors import SENSORS
from nextview.cameras.sensors.sensor import Sensor
from nextview.errors import UsageError
from nextview.observation import pinhole
from nextview.viewsphere import DISTANCE

_SIDE = 224
_RADIUS = SENSORS["none"].radius
RENDER = Sensor(
    "render",
    height=_SIDE,
    width=_SIDE,
    focal=float(pinhole(_SIDE, DISTANCE)[0, 0]),
    distance=DISTANCE * _RADIUS,
    radius=_RADIUS,
)
"""The camera that the networks take for granted, without errors: noise of its own kind may be added."""


@dataclass(frozen=True)
class SensorMix:
    """Any sensor, from none to twice the known ones, in any setup, from none wrong to very wrong.

    Half of the draws look as renders do, with white or grained noise up to 0.02 object radii and up to a quarter of the
    pixels missing in a part of them; the others are a Kinect or a stereo camera, from none of its errors to twice
    them. Each error of the setup is there in a part of the draws, as strong as ``draw`` says.

    Attributes:
        strength: multiplies every error.
    """

    strength: float = 1.0

    def __post_init__(self) -> None:
        SENSORS["none"].scaled(self.strength)  # says what is wrong with it

    @property
    def name(self) -> str:
        """What it is called."""
        return "mix" if self.strength == 1 else f"mix:{self.strength:g}"

    def draw(self, rng: np.random.Generator) -> Sensor:
        """A sensor in a setup, for one object."""
        kind = rng.choice(["render", "kinect", "stereo"], p=[0.5, 0.2, 0.3])
        if kind == "render":
            errors = {"noise": (0.6, 0.02 * _RADIUS), "holes": (0.4, 0.25), "grain": (0.3, 2.0)}
            sensor = replace(RENDER, **_some(rng, errors))
        else:
            sensor = SENSORS[str(kind)].scaled(float(rng.uniform(0, 2)))
        setup = {
            "tilt": (0.5, 12.0),
            "centre": (0.5, 0.1),
            "size": (0.5, 0.15),
            "crop": (0.4, 0.4),
            "boxes": (0.5, 12.0),
            "table": (0.2, 0.1),
            "turned": (0.3, 0.5),
            "moved": (0.3, 0.005),
        }
        return replace(sensor, **_some(rng, setup)).scaled(self.strength)

    def to_dict(self) -> dict[str, Any]:
        """Its name and its strength, for JSON."""
        return {"name": self.name, **asdict(self)}


def _some(rng: np.random.Generator, errors: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """Of some errors, each with its chance and its greatest strength: a strength, none in the other cases."""
    there, share = rng.random((2, len(errors)))
    return {
        name: float(share[i] * most * (there[i] < chance)) for i, (name, (chance, most)) in enumerate(errors.items())
    }


def sensor_named(text: str) -> Sensor | SensorMix:
    """A sensor by name, or NAME:STRENGTH; "mix" is another one for every object.

    Raises:
        UsageError: there is no such sensor, or the strength is no number.
    """
    of_kind(text, str, "a sensor is NAME or NAME:STRENGTH")
    name, given, strength = text.partition(":")
    if name not in (*SENSORS, "mix"):
        raise UsageError(f"no sensor is called {name!r}; there are {', '.join(SENSORS)} and mix")
    try:
        times = float(strength) if given else 1.0
    except ValueError:
        raise UsageError(f"{text}: a sensor is NAME or NAME:STRENGTH, a number of at least 0") from None
    if name == "mix":
        return SensorMix(times)
    return SENSORS[name].scaled(times) if given else SENSORS[name]
