"""Drawn worlds: scenes, rooms, tables and the cameras in them."""
