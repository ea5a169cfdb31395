"""What all figures share: their style, fonts for any script, and the light on surfaces."""
