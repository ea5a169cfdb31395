"""Recognise and locate all known things in the frames of a depth camera."""
