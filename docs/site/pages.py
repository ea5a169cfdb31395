"""MkDocs hook: makes the pages that would drift if they were written, and mends links for the site.

Start, Contributing, Security, Changelog, Numbers and the examples are files of the repository;
commands, models and the API describe themselves. Links in all of them are written for the
repository, where docs/ is a folder among others.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from api_pages import api_pages
from card_pages import card_pages
from command_pages import command_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
REPOSITORY_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/numbers.md": "numbers.md",
} | {
    f"examples/{path.name}": f"examples/{path.stem}.md"
    for path in sorted(ROOT.glob("examples/*.py"))
}
"""Files of the repository outside docs/, and the pages that show them."""

LINK = re.compile(r"(\[[^\[\]]*\])\((?![a-z]+:|/)([^)#\s]+)(#[^)\s]*)?\)")
"""A relative link in Markdown: its label in brackets, the file, the anchor."""


def example_pages() -> dict[str, str]:
    """Markdown of each example's page by its place in the site; the first lists them all."""
    top, pages = "# Examples\n\n", {}
    for path in sorted(ROOT.glob("examples/*.py")):
        summary = _summary(path)
        top += f"- [{path.name}](../../examples/{path.name}): {summary}\n"
        pages[f"examples/{path.stem}.md"] = (
            f"# {path.name}\n\n{summary}\n\n```python\n{path.read_text()}```\n"
        )
    return {"examples/index.md": top} | pages


MADE = {
    "Examples": example_pages,
    "Commands": command_pages,
    "Models": card_pages,
    "API": api_pages,
}
"""What fills the sections of the navigation that mkdocs.yml leaves empty."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the sections of the navigation whose pages are made."""
    nav: Any = config.nav
    sections = dict(_sections(nav))
    for name, pages in MADE.items():
        sections[name].extend(pages())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not files in docs/."""
    made = {
        uri: (ROOT / name).read_text()
        for name, uri in REPOSITORY_PAGES.items()
        if name.endswith(".md")
    }
    for pages in MADE.values():
        made |= pages()
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))
    return files


def on_page_markdown(
    markdown: str,
    page: Page,
    config: MkDocsConfig,
    files: Files,
) -> str:
    """Point relative links at pages of the site."""
    uri = page.file.src_uri
    if not uri.endswith(".md"):
        return markdown
    source = next(
        (name for name, shown in REPOSITORY_PAGES.items() if shown == uri),
        f"docs/{uri}",
    )

    def mended(match: re.Match[str]) -> str:
        label, target, anchor = match[1], match[2], match[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if (
            path not in REPOSITORY_PAGES
            and not path.startswith("docs/")
            and (ROOT / path).exists()
        ):
            # a file of the repository that the site does not show
            return label.strip("[]")
        found = REPOSITORY_PAGES.get(path, path.removeprefix("docs/"))
        return f"{label}({posixpath.relpath(found, posixpath.dirname(uri) or '.')}{anchor})"

    # every second one is code
    texts = re.split(r"(^```.*?^```)", markdown, flags=re.M | re.S)
    texts[::2] = [LINK.sub(mended, text) for text in texts[::2]]
    return "".join(texts)


def _sections(nav: list[Any]) -> Iterator[tuple[str, list[Any]]]:
    """All sections of a navigation, those in other ones too, by name."""
    for entry in nav:
        for name, pages in entry.items() if isinstance(entry, dict) else ():
            if isinstance(pages, list):
                yield name, pages
                yield from _sections(pages)


def _summary(path: Path) -> str:
    return re.match(r'(?:#.*\n)*"""(.*?)(?:\n\n|""")', path.read_text(), re.S)[
        1
    ].replace("\n", " ")  # type: ignore[index]
