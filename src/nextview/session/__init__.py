"""Episodes, sessions and the front door."""
