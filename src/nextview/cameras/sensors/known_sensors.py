"""The depth sensors that are known by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from nextview.cameras.sensors.sensor import Sensor

_SETUP: dict[str, Any] = {
    "turned": 0.3,
    "moved": 0.003,
    "centre": 0.05,
    "size": 0.05,
    "tilt": 2.0,
    "table": 0.05,
    "crop": 0.1,
}
_STEREO = Sensor(
    "stereo",
    height=480,
    width=848,
    focal=424.0,
    baseline=0.05,
    grain=2.5,
    nearest=0.2,
    farthest=10.0,
    disparity=0.08,
    step=1 / 32,
    lateral=1.5,
    grazing=0.3,
    flying=0.3,
    shadow=0.05,
    holes=0.03,
)
SENSORS = {
    sensor.name: sensor
    for sensor in (
        Sensor(),
        Sensor(
            "kinect",
            grain=2.0,
            nearest=0.4,
            farthest=8.0,
            axial=1.0,
            step=1 / 8,
            lateral=1.0,
            grazing=0.25,
            flying=0.2,
            shadow=0.075,
            holes=0.01,
        ),
        _STEREO,
        Sensor("setup", **_SETUP),
        replace(_STEREO, name="wrist", **_SETUP),
    )
}
"""Sensors by name: "none" has no errors; "kinect" is the first Kinect; "stereo" is like a RealSense D435 of 848 x 480;
"setup" has no errors but those of pose, object frame, table and picture; "wrist" is "stereo" in such a setup."""
