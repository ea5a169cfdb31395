"""The pictures of pages in the browser, in a headless Chromium: explorer, scene, recording.

pip install 'nextview[explore,record,browser]'
python docs/site/explorer_pictures.py [--out FOLDER] [--models FOLDER]

They are so narrow that their text is legible on a page of the documentation.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import tyro
from playwright.sync_api import Browser, sync_playwright
from playwright.sync_api import Page as Tab
from rerun.blueprint import TimePanel

import nextview
from nextview.captured.bundled_table import BUNDLED_TABLE
from nextview.captured.folders import read_capture
from nextview.data.samples import sample_mesh
from nextview.viewers import recording
from nextview.viewers.exploration import Exploration, shown_objects
from nextview.viewers.page import Page
from nextview.viewers.scene_page import write_scene_page

IMAGES = Path(__file__).parents[1] / "images"
FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
]
"""It draws without a graphics card."""
SETTLES = 4000
"""Milliseconds from the last change until all of it is drawn."""
WIDTH, HEIGHT = 900, 720
"""Pixels: a page of the documentation shows 700 of them for each of these 900."""


def open_tab(browser: Browser, address: str) -> Tab:
    """Open an address."""
    tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    tab.set_default_timeout(120_000)
    tab.goto(address)
    return tab


def close_notice(tab: Tab) -> None:
    """Close the notice that it draws in software: that is meant so."""
    tab.locator(".mantine-Notification-closeButton").first.click()


def shoot(
    browser: Browser, page: Page, views: int, path: Path, farther: float = 1.0
) -> None:
    """Take some views by clicking, and a picture of the page from farther away."""
    tab = open_tab(browser, page.address)
    for step in range(views):
        tab.get_by_text("Take the next view").click()
        while len(page.exploration.walks[-1].views) <= step:
            tab.wait_for_timeout(100)
    close_notice(tab)
    page.server.gui.main_panel.minimize()  # the controls hide the object else
    for client in page.server.get_clients().values():
        camera = client.camera
        away = camera.position - camera.look_at
        camera.position = camera.look_at + farther * away
    page._draw()
    tab.wait_for_timeout(SETTLES)
    tab.screenshot(path=path)
    tab.close()
    page.stop()


def shoot_scene(browser: Browser, path: Path) -> None:
    """Take a picture of the page of the bundled table."""
    capture = read_capture(BUNDLED_TABLE)
    scene = nextview.Scene("ycb", up=capture.up)
    for captured in capture.frames:
        scene.update(captured.read(masked=False))
    with tempfile.TemporaryDirectory() as folder:
        write_scene_page(scene, Path(folder) / "table.html", "bundled recording")
        tab = open_tab(browser, f"file://{folder}/table.html")
        tab.wait_for_timeout(SETTLES)
        close_notice(tab)
        tab.mouse.move(WIDTH / 4, HEIGHT / 2)
        tab.mouse.down()  # turned: the cameras are to be seen, too
        tab.mouse.move(WIDTH / 4 - 135, HEIGHT / 2, steps=5)
        tab.mouse.up()
        tab.wait_for_timeout(SETTLES)
        tab.screenshot(path=path)
        tab.close()


def shoot_recording(browser: Browser, path: Path) -> None:
    """Take a picture of Rerun with the recording of an episode, without the lists at the sides."""
    shown = recording.blueprint()
    shown.collapse_panels = True
    shown.time_panel = TimePanel(state="collapsed")
    recording.blueprint = lambda: shown
    with tempfile.TemporaryDirectory() as folder:
        camera = nextview.SimulatedCamera(sample_mesh("table"))
        session = nextview.load().session(33)
        session.observers.append(recording.Recorder(Path(folder) / "episode.rrd"))
        while not session.done:
            session.update(camera.observe(session.pose))
        serving = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "rerun",
                "--serve-web",
                "--bind=127.0.0.1",
                "--web-viewer-port=9091",
                f"{folder}/episode.rrd",
            ],
            start_new_session=True,  # to end the viewer that it starts, too
        )
        try:
            tab = open_tab(browser, "about:blank")
            tab.wait_for_timeout(SETTLES)
            data = "rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9876%2Fproxy"
            tab.goto(f"http://127.0.0.1:9091/?renderer=webgl&url={data}")
            tab.wait_for_timeout(20 * SETTLES)
            tab.screenshot(path=path)
            tab.close()
        finally:
            os.killpg(serving.pid, signal.SIGTERM)


def main(models: str = "modelnet10", out: Path = IMAGES) -> None:
    """Take all pictures.

    Args:
        models: bundled models by name, or a folder with models of your own.
        out: where they are written.
    """
    program = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=FLAGS)
        alone = Exploration(shown_objects(), start=3, models=models)
        shoot(browser, Page(alone, port=8850), 2, out / "explore.png")
        compared = Exploration(
            shown_objects(),
            ("gain", "lem"),
            "wrist",
            start=3,
            models=models,
        )
        compared.show("monitor")
        page = Page(compared, port=8850)
        page._hide.value = True
        page._draw()
        shoot(browser, page, 3, out / "explore_compared.png", 1.25)
        shoot_scene(browser, out / "table_page.png")
        shoot_recording(browser, out / "recording.png")
        browser.close()


if __name__ == "__main__":
    tyro.cli(main)
