"""The documentation site: it builds without one warning, notebooks and all, and no page is out
of reach.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nextview.cli.commands import NEXTVIEW
from nextview.cli.main import run
from nextview.recognition.model_card import bundled_cards
from nextview_lab.cli.commands import LABORATORY

for package in ("material", "mkdocs_jupyter", "mkdocstrings_handlers"):
    pytest.importorskip(package, reason="the site needs pip install 'nextview[docs]'")
pytest.importorskip("pandas", reason="a notebook needs pip install 'nextview[docs]'")

pytestmark = pytest.mark.long  # `make docs` builds the site in CI as well
ROOT = Path(__file__).parent.parent
SOURCE = os.pathsep.join([str(ROOT / "src"), str(ROOT / "lab/src")])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {
        "NO_MKDOCS_2_WARNING": "1",
        "PYTHONPATH": SOURCE,
        "MPLBACKEND": "agg",
    }
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(folder),
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-6000:]
    return folder


def pages(site):
    return {
        page.relative_to(site).as_posix(): page.read_text()
        for page in site.rglob("*.html")
    }


def test_every_command_has_a_page_with_its_own_help(site, capsys):
    shown = pages(site)
    for program in (NEXTVIEW, LABORATORY):
        for name in program.commands:
            page = shown[f"commands/{program.name}-{name.replace(' ', '-')}.html"]
            with pytest.raises(SystemExit):
                run(program, [*name.split(), "--help"])
            options = re.findall(r"--[a-z][a-z-]+", capsys.readouterr().out)
            assert all(option in page for option in options)


def test_the_home_page_tells_how_to_cite(site):
    home = re.sub("<[^>]+>", "", pages(site)["index.html"])
    assert "@software{nextview" in home
    assert "nextview: active 3D object recognition" in home


def test_every_bundled_model_has_a_page_with_its_hash(site):
    shown = pages(site)
    for name, card in bundled_cards().items():
        assert card.sha256 in shown[f"models/{name}.html"]


def test_public_names_are_documented(site):
    import nextview

    inventory = "".join(
        text for name, text in pages(site).items() if name.startswith("api/")
    )
    for name in nextview.__all__:
        found = getattr(nextview, name)
        where = f"{found.__module__}.{getattr(found, '__qualname__', name)}"
        assert f'id="{where}"' in inventory, where


def test_notebooks_ran(site):
    assert "table (belief" in pages(site)["notebooks/first_episode.html"]
    assert "HighAndNear" in pages(site)["notebooks/own_policy.html"]
    assert "data:image/png" in pages(site)["notebooks/first_episode.html"]


def test_every_page_is_in_the_navigation(site):
    shown = pages(site)
    linked = set(re.findall(r'href="([^"#]+\.html)', shown["index.html"]))
    assert set(shown) - {"404.html"} <= linked | {"index.html"}


def test_nothing_is_loaded_from_elsewhere(site):
    for name, text in pages(site).items():
        loaded = re.findall(
            r'<(?:script|img|link)[^>]+(?:src|href)="(https?:)?//([^"]+)"',
            text,
        )
        assert not loaded, name


def test_notebooks_are_kept_without_outputs():
    nbformat = pytest.importorskip("nbformat")
    for path in (ROOT / "docs/notebooks").glob("*.ipynb"):
        for cell in nbformat.read(path, 4).cells:
            assert cell.cell_type != "code" or not cell.outputs, path
