"""Cameras: what can look at an object from a pose."""
