"""Teaching of things from a folder of meshes or captured frames, without PyTorch."""
