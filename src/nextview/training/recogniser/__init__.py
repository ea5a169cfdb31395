"""From views to a recogniser: its networks, azimuth bins, ensembles and the published comparison."""
