"""From one depth frame to instances and the surfaces that carry them, by a learned network."""
