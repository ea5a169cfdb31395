"""Captured depth frames with camera poses: readers, consistency checks, turntables."""
