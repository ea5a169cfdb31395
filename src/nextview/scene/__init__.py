"""All objects in the frames of a depth camera: which of the known things are where."""
