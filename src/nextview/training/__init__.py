"""Training of networks, fits to their predictions, and export: everything that needs torch."""
