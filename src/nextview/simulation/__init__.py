"""The simulated camera, sensor models, cluttered scenes, captured folders."""
