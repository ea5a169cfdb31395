"""What the pictures of a store say is what the store holds."""

import matplotlib
import numpy as np
import pytest
import trimesh

from nextview.errors import DatasetError, UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.session.style import to_svg
from nextview_lab.data.measures import measure
from nextview_lab.data.rendering import render
from nextview_lab.data.store import ViewStore
from nextview_lab.thesis.inspect_store import (
    inspect,
    object_figure,
    store_figure,
    summary,
)

SPHERE = ViewSphere.named("40")


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shop")
    for i in range(5):
        label = "box" if i < 3 else "ball"
        path = (
            folder
            / "meshes"
            / label
            / ("train" if i % 2 else "test")
            / f"thing_{i}.off"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        (
            trimesh.creation.box([1, 2, 3 + i])
            if i < 3
            else trimesh.creation.icosphere(2)
        ).export(path)
    (folder / "meshes/box/train/broken.off").write_text("OFF\n")
    list(render(folder / "meshes", folder / "views.zarr", SPHERE, 32, workers=0))
    return folder / "views.zarr"


def test_summary_counts(views):
    facts = summary(ViewStore.open(views))
    assert facts["objects"] == "6 in 2 classes"
    assert (facts["rendered"], facts["left out"], facts["not rendered yet"]) == (
        "5",
        "1",
        "0",
    )
    assert facts["views"].startswith("200 ")
    assert (
        facts["byte-identical copies"] == "1  (0 with several labels)"
    )  # the two balls


def test_an_object_is_drawn_with_the_horizon_lowest(views):
    list(measure(views, workers=0))
    store = ViewStore.open(views)
    row = store.names.index("thing_0")
    top, bottom = object_figure(store, row).subfigs
    mosaic = top.axes[0].images[0].get_array()
    # ring 0, azimuth 1
    np.testing.assert_array_equal(mosaic[-32:, 32:64], store.image(row)[1])
    np.testing.assert_array_equal(mosaic[:32, -32:], store.image(row)[39])
    np.testing.assert_array_equal(
        bottom.axes[0].images[0].get_array().ravel(),
        store.measure()[row],
    )
    assert len([axes for axes in bottom.axes if axes.get_title()]) == len(
        list(store.group["measures"])
    )


def test_the_command_draws_or_says_why_not(views, tmp_path):
    inspect(views, tmp_path / "store.png")
    inspect(views, tmp_path / "thing.svg", object_name="thing_3")
    assert (tmp_path / "store.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "thing.svg").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["store.png", "thing.svg"]
    with pytest.raises(DatasetError, match="has no object 'thin'"):
        inspect(views, tmp_path / "x.png", object_name="thin")
    with pytest.raises(DatasetError, match="broken is not rendered"):
        inspect(views, tmp_path / "x.png", object_name="broken")
    with pytest.raises(UsageError, match=r"\.png or \.pdf or \.svg"):
        inspect(views, tmp_path / "x.txt")


def test_names_are_shown_as_they_are(tmp_path):
    """Also what matplotlib takes for a broken formula."""
    name = "$x^{$"
    mesh = tmp_path / "meshes" / name / f"{name}.off"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box([1, 2, 3]).export(mesh)
    list(
        render(
            tmp_path / "meshes",
            tmp_path / f"{name}.zarr",
            ViewSphere.named("12"),
            16,
            workers=0,
        )
    )
    store = ViewStore.open(tmp_path / f"{name}.zarr")
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        assert f"{name}  ·  {name}" in to_svg(object_figure(store, 0))
        assert f"{name}.zarr" in to_svg(store_figure(store))
