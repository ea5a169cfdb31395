"""``nextview-lab explore``: show the objects of a view store in the browser."""

from pathlib import Path

from nextview.checks import check_extras
from nextview.cli.common_options import EpisodeOptions
from nextview.cli.explore import serve


def explore(
    store: Path,
    /,
    looking: EpisodeOptions = EpisodeOptions(),
    compare: str | None = None,
    start: int | None = None,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
    browser: bool = True,
) -> None:
    """Explore the objects of a view store in the browser.

    The page is that of nextview explore. A view is the stored one nearest to the requested pose.

    Args:
        store: view store made by nextview-lab render.
        looking: Models and policies. More views can be taken after the end of an episode.
        compare: second policy, which runs side by side with the first.
        start: index of the first view; by default random.
        seed: seed of the first view and the policies.
        host: address at which the page is served; 0.0.0.0 makes it reachable from other machines.
        port: port of the page; if it is taken, the next free one is used.
        browser: by default the page is opened in a browser.
    """
    check_extras("explore")
    from nextview.viewers.exploration import Exploration
    from nextview_lab.data.stored_views import objects_of

    options = dict(vars(looking))
    policies = [options.pop("policy"), *([] if compare is None else [compare])]
    shown = objects_of(store)
    serve(
        Exploration(shown, policies, None, start, seed, **options),
        host,
        port,
        browser,
    )
