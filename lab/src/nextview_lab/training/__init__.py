"""Training and export of networks, and fits to their predictions: everything that needs torch."""
