"""Hypothesis without deadlines: on a machine that trains or renders beside the tests, slow is not wrong.

And the order of the files; and the tests that take minutes, which run where NEXTVIEW_TESTS=all.
"""

import os

import pytest
from hypothesis import settings

LONG = ("test_workflow.py", "test_training.py", "test_train_recogniser.py")
"""Files that take longest: begun first, no process is left alone with one at the end."""

settings.register_profile("nextview", deadline=None)
settings.load_profile("nextview")


def pytest_collection_modifyitems(items):
    for item in items if os.environ.get("NEXTVIEW_TESTS") != "all" else ():
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.skip(reason="takes minutes: NEXTVIEW_TESTS=all runs it"))
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))
