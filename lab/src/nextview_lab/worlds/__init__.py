"""Drawn worlds: tables, floors, bins, shelves and rooms, and the cameras in them."""
