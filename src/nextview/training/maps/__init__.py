"""From views to the networks that predict maps of a measure."""
