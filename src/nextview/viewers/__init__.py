"""Ways to look: the explorer, recordings, figures."""
