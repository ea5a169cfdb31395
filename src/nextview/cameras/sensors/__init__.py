"""Depth sensors for the simulated camera: what they measure badly, what not at all, and the errors of the setup."""

from nextview.cameras.sensors.known_sensors import SENSORS
from nextview.cameras.sensors.sensed_camera import SensedCamera
from nextview.cameras.sensors.sensor import Sensor
from nextview.cameras.sensors.sensor_mix import SensorMix, sensor_named

__all__ = ["SENSORS", "SensedCamera", "Sensor", "SensorMix", "sensor_named"]
