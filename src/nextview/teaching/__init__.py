"""Teaching things from a folder of meshes or captured frames; needs no torch."""
