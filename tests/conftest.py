"""Hypothesis without deadlines: on a machine that trains or renders beside the tests, slow is not wrong.

And the order of the files.
"""

from hypothesis import settings

LONG = ("test_workflow.py", "test_training.py", "test_train_recogniser.py")
"""Files that take longest: begun first, no process is left alone with one at the end."""

settings.register_profile("nextview", deadline=None)
settings.load_profile("nextview")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))
