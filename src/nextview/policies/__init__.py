"""Where to look next: one file for each family of policies."""
