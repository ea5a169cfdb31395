"""The comparison at fixed numbers of views against the benchmark itself, one number of views at
a time.
"""

import numpy as np
import pandas as pd
import pytest
from lab_programs import main
from pipeline import benchmark, some_predictions

NAMES = ("random", "lem", "furthest", "spread", "oracle-gain")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Predictions, and the results of ``nextview-lab benchmark classes --views``."""
    folder = tmp_path_factory.mktemp("n_views")
    some_predictions(24, seed=2).save(folder / "p.npz")
    command = ["benchmark", "classes", str(folder / "p.npz"), str(folder / "out")]
    command += ["--policies", *NAMES, "--views", "4", "2", "--thresholds", "0.9"]
    main([*command, "--runs", "3", "--samples", "200"])
    return folder


@pytest.mark.parametrize("n_views", [2, 4])
def test_the_numbers_are_those_of_a_benchmark_with_so_many_views(made, n_views):
    out = made / f"benchmark{n_views}"
    settings = {
        "policies": NAMES,
        "thresholds": (1.0,),
        "runs": 3,
        "max_views": n_views,
        "samples": 200,
    }
    tables = benchmark(made / "p.npz", out, **settings).tables
    keys = ["policy", "views", "measure"]
    found, apart = (
        pd.read_csv(made / "out" / f"{name}.csv").query("set == 'all' and views > 0")
        for name in ("measures", "tests")
    )
    found = found.set_index(keys).sort_index()
    apart = apart[apart["measure"] == "accuracy"]
    for ours, theirs in (("accuracy", "accuracy"), ("travel", "travel_all")):
        of_all = tables.measures.query("set == 'all'").set_index(["measure", "policy"])
        summary = of_all.loc[theirs]
        for name in NAMES:
            for column in ("value", "low", "high"):
                assert found.loc[name, n_views, ours][column] == pytest.approx(
                    summary.loc[name, column], abs=1e-9
                )
    tests = tables.tests.query("measure == 'accuracy'").set_index("policy")
    after = apart[apart["views"] == n_views].set_index("policy")
    for name in NAMES[1:]:
        for column in ("difference", "low", "high"):
            assert after.loc[name, column] == pytest.approx(
                tests.loc[name, column], abs=1e-9
            )
        if name == "oracle-gain":  # it is no rival
            assert np.isnan(after.loc[name, "p"])
        else:
            assert after.loc[name, "p"] == pytest.approx(tests.loc[name, "p"], abs=1e-9)
