"""Every name of ``import nextview`` shows in its docstring how it is used, and the example runs."""

import dataclasses
import doctest
import inspect
from pathlib import Path

import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.teaching.learn import LearnOptions, learn_things
from nextview.teaching.thing_views import TeachingOptions

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NOT_RUN = {
    "learn",
    "load_mesh",
    "Scene",
    "Session",
    "Tracker",
}  # need files of a user, or a robot


@pytest.mark.parametrize("name", nextview.__all__)
def test_the_example_of_a_name_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = getattr(nextview, name)
    module = inspect.getmodule(found)
    names = vars(module) | {
        "nextview": nextview,
        "np": np,
        "sample_mesh": sample_mesh,
        "Path": Path,
    }
    test = doctest.DocTestParser().get_doctest(
        inspect.getdoc(found) or "", names, name, module.__file__, None
    )
    run = [example for example in test.examples if doctest.SKIP not in example.options]
    assert test.examples if name in NOT_RUN else run, (
        f"{name}: its docstring shows no example"
    )
    ran = doctest.DocTestRunner(optionflags=OPTIONS).run(test, clear_globs=False)
    assert ran.failed == 0


def test_learn_takes_every_option_of_the_command():
    options = set(inspect.signature(learn_things).parameters) - {"folder", "out", "how"}
    fields = {field.name for field in dataclasses.fields(TeachingOptions)}
    assert set(LearnOptions.__annotations__) == options | fields
