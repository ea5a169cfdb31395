"""``python -m nextview`` is the ``nextview`` command."""

from nextview_command import main

main()
