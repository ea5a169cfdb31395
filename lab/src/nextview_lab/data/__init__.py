"""Stores of rendered views, their measures and predictions."""
