import json
import re
import shutil
import subprocess
from contextlib import nullcontext
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from test_predictions import some_predictions

from nextview.benchmark import results
from nextview.cli.benchmark import benchmark
from nextview.cli.report import report
from nextview.data.folders import Entry
from nextview.data.store import DONE, ViewStore
from nextview.errors import EntryError, ResultsError
from nextview.report import curves
from nextview.report.html import headline_policy, write_report
from nextview.report.object_pictures import Pictures

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results and a store with pictures, one object of which has a name that would break careless HTML."""
    folder = tmp_path_factory.mktemp("report")
    p = some_predictions(20, seed=1)
    p = replace(p, names=("<script>alert(1)</script>&", *p.names[1:]), store=str(folder / "views.zarr"))
    p.save(folder / "p.npz")
    benchmark(folder / "p.npz", out=folder / "out", thresholds=(0.8, 0.97), runs=3, samples=100)
    entries = [Entry(Path("none"), name, p.classes[i], "test") for name, i in zip(p.names, p.labels, strict=True)]
    store = ViewStore.create(folder / "views.zarr", entries, p.sphere, 32, {})
    store.group["image"][:] = np.random.default_rng(0).integers(0, 255, store.group["image"].shape, np.uint8)
    store.group["measures/depth_entropy"][:] = p.depth_entropy
    store.group["points"][:] = np.random.default_rng(1).integers(-9, 9, store.group["points"].shape, np.int16)
    store.group["status"][:] = DONE
    report(folder / "out")
    return folder


class Ahead:
    """Takes the first unvisited view that is so many places or more ahead."""

    needs = ()
    places = 1

    def __init__(self, sphere):
        self.views = len(sphere)

    def next_views(self, state, rng):
        ahead = (np.arange(self.views) - state.current[:, None] - self.places) % self.views
        return np.where(state.visited, self.views, ahead).argmin(1)


class Ahead2(Ahead):
    places = 2


class Ahead7(Ahead):
    places = 7


class Ahead13(Ahead):
    places = 13


class Ahead19(Ahead):
    places = 19


OWN = tuple(f"test_report:{made.__name__}" for made in (Ahead, Ahead2, Ahead7, Ahead13, Ahead19))
ROBOTS = ("random", "random-all", "furthest", "unidirectional", "spread", "spread-local", "lem", "lem-peak", *OWN)


@pytest.fixture(scope="module")
def crowd(made):
    """Results of thirteen policies that a robot could follow and four oracles."""
    policies = (*ROBOTS, "true-lem", "oracle-valley", "oracle-gain", "oracle-gain-all")
    benchmark(made / "p.npz", out=made / "crowd", policies=policies, thresholds=(0.8, 0.97), runs=2, samples=50)
    report(made / "crowd")
    return results.load(made / "crowd")


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.images, self.links, self.ids, self.open, self.texts = [], [], [], [], []
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

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))


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


def test_names_from_the_data_are_text_and_never_markup(made):
    page = Page((made / "out" / "report.html").read_text())
    assert not any(data.strip() == "alert(1)" for _, data in page.texts)


def test_the_tables_show_the_numbers_of_the_results(made):
    text = (made / "out" / "report.html").read_text()
    summary = results.load(made / "out").tables.summary
    for policy in ("random", "lem", "oracle-gain"):
        row = re.search(rf'<tr><th scope="row">{policy}\b.*?</tr>', text)[0]
        cells = re.findall(r"<td>([\d.]+)", row)
        of = summary.query("policy == @policy and threshold == 0.97").set_index("measure")["value"]
        assert cells[:4] == [f"{of[m]:.3f}" for m in ("accuracy", "clean_accuracy", "class_accuracy")] + [
            f"{of['n_views']:.2f}"
        ]


def drawn(figure):
    """The policies in the legend of a figure, whatever number stands behind each."""
    return [text.get_text().split("  ")[0] for text in figure.axes[0].get_legend().get_texts()]


def test_of_a_crowd_the_curves_show_the_reference_the_users_own_the_best_others_and_two_oracles(crowd):
    of = crowd.tables.summary.query("measure == 'accuracy' and threshold == 0.97").set_index("policy")["value"]
    shown = curves.compared(crowd)
    assert shown[-2:] == ["oracle-valley", "oracle-gain"]
    assert {"random", *OWN} <= set(shown)
    best, left = set(shown[:-2]) - {"random", *OWN}, set(ROBOTS) - set(shown)
    assert (len(shown), len(best), len(left)) == (11, 3, 4)
    assert min(of[list(best)]) >= max(of[list(left)])
    assert headline_policy(crowd, 0.97) in {*best, *OWN}
    assert drawn(curves.threshold_curve(crowd)) == drawn(curves.budget_curve(crowd, "n_views")) == shown
    n_views = [curves.look_of(name, crowd) for name in shown]
    assert len({(observation["color"], observation["linestyle"]) for observation in n_views}) == len(shown)
    rows = [label.get_text() for label in curves.class_differences(crowd, 0.97).axes[0].get_yticklabels()]
    assert rows == [name for name in shown if name not in ("random", "oracle-gain")]


def test_a_reference_that_is_the_worst_of_a_crowd_is_drawn_all_the_same(crowd):
    of = crowd.tables.summary.query("measure == 'accuracy' and threshold == 0.97").set_index("policy")["value"]
    worst = min(ROBOTS, key=of.__getitem__)
    shown = curves.compared(replace(crowd, settings={**crowd.settings, "reference": worst}))
    assert worst in shown
    assert len(shown) == 11


def test_the_default_policy_is_drawn_however_bad_it_is(crowd, monkeypatch):
    of = crowd.tables.summary.query("measure == 'accuracy' and threshold == 0.97").set_index("policy")["value"]
    worst = min(set(ROBOTS) - {"random", *OWN}, key=of.__getitem__)
    assert worst not in curves.compared(crowd)
    monkeypatch.setattr(curves, "DEFAULT", worst)
    assert worst in curves.compared(crowd)
    assert len(curves.compared(crowd)) == 11


def test_the_viewer_comes_first_and_few_objects_are_warned_of(made):
    text = (made / "out" / "report.html").read_text()
    page = Page(text)
    assert next(link for link in page.links if link.startswith("#")) == "#episodes"
    assert text.index('id="viewer"') < text.index("<table")
    assert "Too few objects to tell: there are 20 and" in text


def test_the_data_of_the_viewer_are_json_and_hold_no_markup(made):
    text = (made / "out" / "report.html").read_text()
    data = re.search(r'<script type="application/json" id="trajectories">(.*?)</script>', text, re.S)[1]
    assert "<" not in data
    scenes = json.loads(data)["scenes"]
    assert {scene["name"] for scene in scenes} <= set(results.load(made / "out").predictions.names)
    assert all(scene["pictures"] and scene["cloud"] for scene in scenes)


def test_pictures_come_from_the_store_of_the_predictions_while_it_is_the_same(made, tmp_path):
    p = results.load(made / "out").predictions
    assert Pictures.of(p).store is not None
    gone = Pictures.of(replace(p, store=str(tmp_path / "gone.zarr")))
    assert (gone.store, "no view store at" in gone.why_not) == (None, True)
    unknown = Pictures.of(replace(p, store=""))
    assert (unknown.store, "do not name" in unknown.why_not) == (None, True)
    other = p.depth_entropy.copy()
    other[3, 5] += 0.5
    changed = Pictures.of(replace(p, depth_entropy=other))
    assert (changed.store, "has changed since" in changed.why_not) == (None, True)
    assert Pictures.of(replace(p, depth_entropy=other), made / "views.zarr").store is not None  # as the user says
    with pytest.raises(ResultsError, match="no views of these objects"):
        Pictures.of(replace(p, names=tuple(f"other {name}" for name in p.names)), made / "views.zarr")


def test_a_page_without_pictures_says_so(made, tmp_path):
    write_report(results.load(made / "out"), tmp_path / "bare.html", Pictures(None, "No pictures: none."))
    text = (tmp_path / "bare.html").read_text()
    assert text.count("No pictures: none.") == 2
    assert "image/webp" not in text


def test_ticks_are_round_numbers(crowd):
    for figure in (curves.threshold_curve(crowd), curves.budget_curve(crowd, "n_views")):
        figure.canvas.draw()
        axis = figure.axes[0].yaxis
        for at, text in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True):
            assert float(text.get_text().removesuffix(" %")) == pytest.approx(100 * at)  # not 92 % at 0.925
        steps = np.diff(axis.get_ticklocs())
        assert float(f"{steps[0]:.1e}".split("e")[0]) in (1, 2, 5)


def test_captions_tell_where_the_rest_of_a_crowd_is(crowd, made):
    text = (crowd.folder / "report.html").read_text()
    assert text.count("4 more are in the tables") == 4
    assert text.count("4 more are in per_class.csv") == 1
    for name in ROBOTS:
        assert len(re.findall(rf'<tr><th scope="row">{name}\b(?!-)', text)) == 2  # of results, and of calibration
    few = (made / "out" / "report.html").read_text()
    assert "more are in" not in few
    assert curves.compared(results.load(made / "out")) == [*ROBOTS[:8], "oracle-valley", "oracle-gain"]


@pytest.mark.parametrize("policies", [("random",), ("lem", "best-3"), ("test_replay:Raises", "unidirectional")])
def test_a_report_of_few_policies(made, policies):
    out = made / "-".join(name.replace(":", ".") for name in policies)
    fails = "Raises" in policies[0]
    with pytest.raises(EntryError) if fails else nullcontext():
        benchmark(made / "p.npz", out=out, policies=policies, thresholds=(0.9,), runs=2, max_views=3, samples=20)
    report(out)
    Page((out / "report.html").read_text())
    assert ("Left out: test_replay:Raises" in (out / "report.html").read_text()) == fails


def test_a_report_without_results_is_refused(made):
    with pytest.raises(results.ResultsError, match="holds no benchmark results"):
        report(made)


def browse(page: Path, address: str = "") -> str:
    """The document as it stands after its scripts have run in a headless browser."""
    if BROWSER is None:
        pytest.skip("no Chromium on this machine")
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom"]
    command += ["--allow-file-access-from-files", "--enable-logging=stderr", f"--user-data-dir={page.parent}/profile"]
    done = subprocess.run([*command, page.as_uri() + address], capture_output=True, text=True, timeout=60, check=True)
    assert "Uncaught" not in done.stderr
    return done.stdout


def test_the_viewer_steps_through_an_episode_in_a_browser(made):
    seen = set()
    for step in (0, 1):
        page = browse(made / "out" / "report.html", f"#scene=1&policy=unidirectional&step={step}")
        verdict = re.search(r'id="verdict".*?>(.*?)<', page)[1]
        assert verdict.startswith(f"unidirectional, view {step + 1} of ")
        start = re.search(r'<option value="1"[^>]*>.*? from view (\d+)<', page)[1]
        views = re.findall(r"\d+: view (\d+), elevation", page)
        ring, azimuth = divmod(int(start), 8)
        assert list(map(int, views[:2])) == [int(start), ring * 8 + (azimuth + 1) % 8]
        assert page.count('aria-current="step"') == 1
        seen.add(verdict)
    assert len(seen) == 2


def test_the_viewer_draws_and_the_page_fits_a_phone(made):
    host = made / "out" / "phone.html"
    host.write_text(
        """<iframe id="phone" src="report.html" style="width:360px;height:780px;border:0"></iframe><p id="said"></p>
        <script>document.getElementById("phone").onload = () => {
          const page = document.getElementById("phone").contentDocument, canvas = page.getElementById("sphere");
          const p = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          let path = 0;
          for (let i = 0; i < p.length; i += 4) path += p[i] === 255 && p[i + 1] === 209 && p[i + 2] === 102;
          document.getElementById("said").textContent =
            `${page.documentElement.scrollWidth} ${canvas.clientWidth} ${path}`;
        };</script>"""
    )
    page_width, canvas_width, path = map(int, re.search(r'id="said">(\d+) (\d+) (\d+)<', browse(host)).groups())
    assert page_width <= 360  # nothing but the tables' own boxes scrolls sideways
    assert 250 < canvas_width < 360
    assert path > 100  # the camera's place is drawn


@pytest.mark.parametrize("name", ["benchmark.json", "episodes.parquet", "summary.csv", "predictions.npz"])
def test_results_that_were_changed_are_refused(made, tmp_path, name):
    shutil.copytree(made / "out", tmp_path / "out")
    (tmp_path / "out" / name).write_text("[]")
    with pytest.raises(ResultsError, match=f"results are damaged .{name} is not as it was written"):
        results.load(tmp_path / "out")
