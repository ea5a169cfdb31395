"""Taught things as surfaces: registration with depth images and verification of every pixel."""
