"""Networks, training and export; the only room that imports torch."""
