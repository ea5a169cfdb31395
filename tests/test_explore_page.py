"""The explorer's page: driven from Python, and by a browser that clicks through it."""

import shutil
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", reason="the extra 'explore' is not installed")

from nextview.data.samples import sample_mesh
from nextview.errors import UsageError
from nextview.explorer.exploration import Exploration
from nextview.explorer.page import APART, NOTHING, Page
from nextview.explorer.shown_object import ShownObject, shown_objects
from nextview.explorer.walk_scene import wxyz

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PATIENCE = 60_000
"""Milliseconds for what takes one on an idle machine."""


@pytest.fixture
def page():
    found = Page(Exploration(shown_objects(), start=3, threads=1), port=8790)
    yield found
    found.stop()


def until(happened, what):
    """Wait for what other threads do."""
    end = time.monotonic() + PATIENCE / 1000
    while not happened():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def test_what_is_chosen_is_done_and_shown(page):
    exploration = page.exploration
    assert page.address == f"http://localhost:{page.server.get_port()}"
    page._look(0, 5)
    until(lambda: "view 5" in page._cards[0].content, "the card shows the view")
    page._second.value = "furthest"
    until(lambda: exploration.policies == ["gain", "furthest"] and len(page._cards) == 2, "two policies")
    assert [walk.visited for walk in exploration.walks] == [[5], [5]]
    page._object.value = "monitor"
    until(lambda: exploration.shown.name == "monitor", "another object")
    page._second.value = NOTHING
    until(lambda: exploration.policies == ["gain"] and len(page._scenes) == 1, "one policy")
    page._sensor.value = "kinect"
    until(lambda: exploration.sensor == "kinect:1", "a sensor")
    page._strength.value = 2.0
    until(lambda: exploration.sensor == "kinect:2", "a stronger one")
    page._drag(0, np.array([1.0, -2.0, 1.0]), False)
    assert "<img" in page._preview.content
    assert not exploration.walks[0].views
    page._drag(0, np.array([1.0, -2.0, 1.0]), True)
    until(lambda: len(exploration.walks[0].views) == 1, "a view from where the camera was let go")
    assert not page._preview.visible


@pytest.mark.parametrize(
    ("host", "port"), [("127.0.0.1", -1), ("127.0.0.1", 65536), ("", 8790), ("nowhere.invalid", 8790), ("1.2.3", "a")]
)
def test_an_address_where_no_page_can_be_is_refused(host, port):
    with pytest.raises(UsageError, match=r"page can be served|port is a whole number"):
        Page(None, host, port)


def test_a_name_means_nothing_in_the_page_and_a_sensor_may_be_any():
    shown = ShownObject("<img src=x>", lambda: sample_mesh("chair"), "<img src=x onerror=alert(1)>")
    page = Page(Exploration([shown], sensor="mix:0.5", threads=1), port=8790)
    try:
        assert (page._sensor.value, page._strength.value) == ("mix", 0.5)
        assert "&lt;img src=x onerror=alert(1)&gt;" in page._label.content
        assert "<img" not in page._label.content
    finally:
        page.stop()


def test_what_cannot_be_done_changes_nothing(page):
    for _ in range(40):
        page.exploration.step()
    page._look(0, 5)
    assert len(page.exploration.walks[0].views) == 40
    page._act(lambda: page._changed(lambda: page.exploration.compare(["no such policy"])), None)
    assert page._policy.value == "gain"
    assert page.exploration.policies == ["gain"]


@pytest.mark.parametrize("seed", range(4))
def test_quaternions_are_rotations(seed):
    rotation = Rotation.random(random_state=seed)
    pose = np.eye(4)
    pose[:3, :3] = rotation.as_matrix()
    w, x, y, z = wxyz(pose)
    turned = Rotation.from_quat([x, y, z, w])
    assert (turned * rotation.inv()).magnitude() == pytest.approx(0, abs=1e-7)


def test_two_objects_side_by_side_do_not_touch():
    reach = 3 * 1.1 + 0.7  # of the numbers at the path and the arrows of the camera
    assert 2 * reach < APART


@pytest.fixture
def browser(page):
    """The page in a headless Chromium."""
    if BROWSER is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=BROWSER, args=SOFTWARE)
        tab = chromium.new_page(viewport={"width": 1400, "height": 850})
        tab.set_default_timeout(PATIENCE)
        wrong: list[str] = []
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.goto(page.address)
        until_shown(tab, "No view was taken yet")
        yield tab
        assert not wrong
        chromium.close()


def until_shown(tab, text):
    tab.get_by_text(text).first.wait_for(state="visible")


def choose(tab, label, option):
    tab.get_by_label(label, exact=True).first.click()
    tab.get_by_role("option", name=option, exact=True).click()


def pixel_of(page, tab, place):
    """Where a place in the scene, (3,), is on the browser's screen, from the camera that the browser reports."""
    (client,) = page.server.get_clients().values()
    camera = client.camera
    w, x, y, z = camera.wxyz
    seen = Rotation.from_quat([x, y, z, w]).as_matrix().T @ (np.asarray(place) - camera.position)
    canvas = tab.locator("canvas").first.bounding_box()
    focal = canvas["height"] / 2 / np.tan(camera.fov / 2)
    right, down = focal * seen[:2] / seen[2]
    return canvas["x"] + canvas["width"] / 2 + right, canvas["y"] + canvas["height"] / 2 + down


def click_ball(page, tab, view):
    """Click a candidate view of the first walk; again after a while, for a browser may be busy drawing the last one."""
    walk = page.exploration.walks[0]
    before, end = len(walk.views), time.monotonic() + PATIENCE / 1000
    while len(walk.views) == before:
        assert time.monotonic() < end, "no ball is hit"
        tab.mouse.click(*pixel_of(page, tab, walk.sphere.poses[view][:3, 3]))
        again = time.monotonic() + 5
        while len(walk.views) == before and time.monotonic() < again:
            time.sleep(0.05)
    assert walk.visited[before] == view


def test_a_browser_clicks_through_it(page, browser):
    exploration = page.exploration
    assert browser.locator("figure img").count() == 3  # the gallery
    browser.get_by_role("button", name="table", exact=True).click()
    until(lambda: exploration.shown.name == "table", "the object is chosen")
    until_shown(browser, "Its class is table")

    browser.get_by_text("Next view by the policy").click()
    until_shown(browser, "view 3: 0° up, 135° round")
    first = exploration.walks[0].views[0].belief.copy()

    towards_us = int(np.argmin(exploration.walks[0].sphere.directions @ (0.0, 1.0, 0.0)))
    click_ball(page, browser, towards_us)
    until_shown(browser, f"view {towards_us}:")
    second = exploration.walks[0].views[1].belief
    assert np.abs(second - first).max() > 0.001  # belief changed

    taken = len(exploration.walks[0].views)
    browser.get_by_text("Next view by the policy").click()
    until(lambda: len(exploration.walks[0].views) == taken + 1, "the policy takes a step")
    best = int(exploration.walks[0].views[-1].belief.argmax())
    until_shown(browser, f"{exploration.walks[0].session.models.classes[best]} ")
    until(lambda: browser.locator(".nv table").last.locator("tr").count() == taken + 1, "every view has its row")

    browser.get_by_label("Hide what was not seen").click()
    until(lambda: page._hide.value, "unseen parts are hidden")
    assert not page._scenes[0]._object.visible
    choose(browser, "Compare with", "furthest")
    until(lambda: exploration.policies == ["gain", "furthest"], "two policies side by side")
    browser.get_by_text("Next view by the policy").click()
    until(lambda: [len(walk.views) for walk in exploration.walks] == [taken + 2] * 2, "both take a step")
    choose(browser, "Sensor", "kinect")
    until(lambda: exploration.sensor == "kinect:1", "sensor noise is on")
    browser.get_by_text("Walk until it stops").click()
    until(lambda: all(walk.stopped for walk in exploration.walks), "they walk until they stop")
    until(lambda: browser.get_by_text("the rule would stop here").count() == 2, "both say so")
    browser.get_by_text("Start over").click()
    until(lambda: not any(walk.views for walk in exploration.walks), "it starts over")


def test_a_camera_is_dragged_in_a_browser(page, browser):
    walk = page.exploration.walks[0]
    page._look(0, int(np.argmin(walk.sphere.directions @ (0.0, 1.0, 0.0))))
    time.sleep(5)
    start = np.asarray(walk.views[0].observation.pose[:3, 3])
    x, y = pixel_of(page, browser, start + np.array([0.0, 0.0, 0.45]))  # on the arrow that points up
    browser.mouse.move(x, y)
    browser.mouse.down()
    for k in range(1, 9):
        browser.mouse.move(x, y - 10 * k)
        time.sleep(0.1)
    browser.mouse.up()
    until(lambda: len(walk.views) == 2, "a view is taken where the camera is let go")
    assert walk.views[1].angles[0] > walk.views[0].angles[0] + 5  # higher up
