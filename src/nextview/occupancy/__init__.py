"""What is known of the space around an object: free, occupied by it, occupied by something else, or unseen."""

from nextview.occupancy.expected_visibility import SeenScene, Visibility, expected_visibility, shown_share
from nextview.occupancy.line_of_sight import visible_share
from nextview.occupancy.new_volume import new_surface, new_volume
from nextview.occupancy.voxel_grid import FREE, OBJECT, OCCLUDER, UNSEEN, Occupancy, VoxelGrid

__all__ = [
    "FREE", "OBJECT", "OCCLUDER", "UNSEEN", "Occupancy", "SeenScene", "Visibility", "VoxelGrid", "expected_visibility",
    "new_surface", "new_volume", "shown_share", "visible_share",
]  # fmt: skip
