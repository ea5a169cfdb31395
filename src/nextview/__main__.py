"""``python -m nextview`` is the ``nextview`` command."""

from nextview.cli.main import main

main()
