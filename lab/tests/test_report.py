"""The page of a benchmark: whole, self-contained, and true to the results."""

import re
from html.parser import HTMLParser

from pipeline import benchmark, some_predictions

from nextview_lab.benchmark.report import report


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


def test_the_page_is_whole_and_needs_nothing_from_outside(tmp_path):
    some_predictions(20, seed=1).save(tmp_path / "p.npz")
    how = {"thresholds": (0.8, 0.97), "runs": 3, "samples": 100}
    benchmark(tmp_path / "p.npz", tmp_path / "out", **how)
    text = report(tmp_path / "out").read_text()
    page = Page(text)
    assert page.open == []  # every element is closed in its order
    assert len(page.ids) == len(set(page.ids))
    assert all(link.startswith(("#", "data:")) for link in page.links)
    assert all(link[1:] in page.ids for link in page.links if link.startswith("#"))
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)
    assert len(page.images) == 1
    assert all(len(image["alt"]) > 10 for image in page.images)
    assert not list((tmp_path / "out").glob("*.part"))
