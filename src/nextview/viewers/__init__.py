"""Interactive explorer, recordings for the Rerun viewer, and HTML pages."""
