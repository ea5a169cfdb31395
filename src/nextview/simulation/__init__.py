"""The simulated camera, sensor models and cluttered scenes."""
