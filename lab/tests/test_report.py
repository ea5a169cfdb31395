"""The page of a benchmark: whole, self-contained, and true to the results."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from pipeline import benchmark, some_predictions, store_of

from nextview.errors import ResultsError
from nextview_lab.benchmark.classes import load
from nextview_lab.benchmark.report import pictures_of, report


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results and a store with pictures."""
    folder = tmp_path_factory.mktemp("report")
    p = replace(some_predictions(20, seed=1), store=str(folder / "views.zarr"))
    p.save(folder / "p.npz")
    benchmark(
        folder / "p.npz", folder / "out", thresholds=(0.8, 0.97), runs=3, samples=100
    )
    image = np.random.default_rng(0).integers(0, 255, (20, 40, 32, 32), np.uint8)
    labels, arrays = (
        np.array(p.classes)[p.labels],
        {"image": image, "depth_entropy": p.depth_entropy},
    )
    store_of(folder / "views.zarr", p.names, labels, p.sphere, 32, **arrays)
    report(folder / "out", figures=folder / "figures")
    return folder


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.images, self.links, self.ids, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "img":
            self.images.append(attributes)
        self.links += [attributes[a] for a in ("src", "href") if a in attributes]
        self.ids += [attributes["id"]] if "id" in attributes else []
        if tag not in ("img", "meta", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_from_outside(made):
    text = (made / "out" / "report.html").read_text()
    page = Page(text)
    assert page.open == []  # every element is closed in its order
    assert len(page.ids) == len(set(page.ids))
    assert all(link.startswith(("#", "data:")) for link in page.links)
    assert all(link[1:] in page.ids for link in page.links if link.startswith("#"))
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)
    assert len(page.images) > 8
    assert all(len(image["alt"]) > 10 for image in page.images)
    assert not list((made / "out").glob("*.part"))
    written = {path.name for path in (made / "figures").iterdir()}
    assert {"accuracy.pdf", "accuracy.svg", "tests.csv", "tests.tex"} <= written


def test_pictures_come_from_the_store_of_the_predictions_while_it_is_the_same(
    made, tmp_path
):
    p = load(made / "out").predictions
    assert pictures_of(p)[0] is not None
    other = p.depth_entropy.copy()
    other[3, 5] += 0.5
    for change, why in (
        ({"store": str(tmp_path / "gone.zarr")}, "gone.zarr: "),
        ({"store": ""}, "do not say which view store"),
        ({"depth_entropy": other}, "holds other views"),
    ):
        store, why_not = pictures_of(replace(p, **change))
        assert store is None
        assert why in why_not
    # as the user says
    assert (
        pictures_of(replace(p, depth_entropy=other), made / "views.zarr")[0] is not None
    )
    with pytest.raises(ResultsError):
        pictures_of(
            replace(p, names=tuple(f"other {name}" for name in p.names)),
            made / "views.zarr",
        )
    assert (made / "out" / "report.html").read_text().count("data:image/webp") > 8
