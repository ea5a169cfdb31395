"""From views to the map networks, LEM and LCM."""
