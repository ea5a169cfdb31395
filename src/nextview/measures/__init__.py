"""View-quality measures by name."""
