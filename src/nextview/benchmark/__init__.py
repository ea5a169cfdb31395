"""Policies compared by replay, with intervals and tests."""
