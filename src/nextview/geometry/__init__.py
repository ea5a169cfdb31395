"""Viewpoints, poses, meshes, what one view yields, and ray casting."""
