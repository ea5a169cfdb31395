"""``nextview report``: a folder of benchmark results as one HTML page."""

from __future__ import annotations

from pathlib import Path

import tyro


def report(
    results: tyro.conf.Positional[Path],
    /,
    out: Path | None = None,
    store: Path | None = None,
) -> None:
    """Write one self-contained HTML page: tables, curves, failures, and a viewer to step through episodes.

    Args:
        results: folder made by nextview benchmark.
        out: the page; RESULTS/report.html by default, which counts as one of the results.
        store: take the pictures of the objects from this view store; by default from that of the predictions, if it
            still is where it was.
    """
    from nextview.benchmark.results import load
    from nextview.cli.progress import console
    from nextview.report.html import PAGE, check_page, write_report
    from nextview.report.object_pictures import Pictures

    target = out or results / PAGE
    check_page(target, results)
    loaded = load(results)
    pictures = Pictures.of(loaded.predictions, store)
    write_report(loaded, target, pictures)
    if pictures.why_not:
        console.print(pictures.why_not, soft_wrap=True)
    console.print(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
