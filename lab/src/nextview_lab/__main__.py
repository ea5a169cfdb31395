"""``python -m nextview_lab`` is the command ``nextview-lab``."""

from nextview_lab.cli.main import main

main()
