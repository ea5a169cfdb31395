"""Folders of real depth frames with camera poses: readers, checks, turntables."""
