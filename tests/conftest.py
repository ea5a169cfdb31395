"""Hypothesis without deadlines: on a machine that trains or renders beside the tests, slow is not wrong."""

from hypothesis import settings

settings.register_profile("nextview", deadline=None)
settings.load_profile("nextview")
