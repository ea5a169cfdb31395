"""Taught things as surfaces: registration with depth images and comparison of every pixel."""
