"""The pictures of the explorer: the page itself, in a headless Chromium.

pip install 'nextview[explore,browser]'
python docs/site/explorer_pictures.py [--models FOLDER]
"""

from __future__ import annotations

import shutil
from pathlib import Path

import tyro
from playwright.sync_api import Browser, sync_playwright

from nextview.viewers.exploration import Exploration, shown_objects
from nextview.viewers.page import Page

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


def shoot(browser: Browser, page: Page, views: int, path: Path) -> None:
    """Take some views by clicking, and a picture of the page."""
    tab = browser.new_page(viewport={"width": 1400, "height": 850})
    tab.set_default_timeout(120_000)
    tab.goto(page.address)
    for step in range(views):
        tab.get_by_text("Take the next view").click()
        while len(page.exploration.walks[-1].views) <= step:
            tab.wait_for_timeout(100)
    # it draws in software: that is meant so
    tab.locator(".mantine-Notification-closeButton").first.click()
    tab.mouse.move(660, 800)  # away from the button
    page._draw()
    tab.wait_for_timeout(SETTLES)
    tab.screenshot(path=path)
    tab.close()
    page.stop()


def main(models: str = "modelnet10", out: Path = IMAGES) -> None:
    """Both pictures.

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
        shoot(browser, page, 3, out / "explore_compared.png")
        browser.close()


if __name__ == "__main__":
    tyro.cli(main)
