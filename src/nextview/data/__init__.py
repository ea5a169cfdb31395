"""Datasets, view stores and predictions."""
