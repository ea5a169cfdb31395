"""Taught things as surfaces, aligned with the depth that a camera saw and judged by its pixels."""
