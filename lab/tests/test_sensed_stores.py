"""The sensor models against closed forms, against casting rays from the projector, and through
the front door.
"""

import numpy as np
import pytest

from nextview import ViewSphere
from nextview.errors import DatasetError
from nextview.simulation.sensor import sensor_named
from nextview_lab.data.rendering import RenderOptions, render
from nextview_lab.data.store import ViewStore

SPHERE, FEW = ViewSphere.named("40"), ViewSphere((20.0,), 3)


def rendered(furniture, store, sensor=None, workers=0):
    return render(
        furniture,
        store,
        FEW,
        workers=workers,
        options=RenderOptions(split="test", sensor=sensor),
    )


def test_a_store_of_a_sensor_resumes_to_the_bit_and_with_no_other(furniture, tmp_path):
    whole, resumed, clean = (
        tmp_path / f"{name}.zarr" for name in ("whole", "resumed", "clean")
    )
    list(rendered(furniture, whole, "wrist:2"))
    begun = rendered(furniture, resumed, "wrist:2")
    next(begun)
    begun.close()
    assert int(ViewStore.open(resumed).done.sum()) == 1
    for other in ("wrist", None):
        with pytest.raises(DatasetError):
            list(rendered(furniture, resumed, other))
    list(rendered(furniture, resumed, "wrist:2", workers=2))
    a, b = ViewStore.open(whole), ViewStore.open(resumed)
    assert b.group.attrs["sensor"] == sensor_named("wrist:2").to_dict()
    for name in ("image", "depth", "points", "measures/depth_entropy"):
        np.testing.assert_array_equal(a.group[name][:], b.group[name][:], err_msg=name)
    list(rendered(furniture, clean))
    assert "sensor" not in ViewStore.open(clean).group.attrs
