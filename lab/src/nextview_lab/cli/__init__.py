"""The command ``nextview-lab``."""
