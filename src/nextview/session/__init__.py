"""Recognise single objects: systems, sessions and episodes."""
