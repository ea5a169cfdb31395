"""Worlds: a target among other objects, boxes and walls on a table, by a seed; seen live or rendered into a store."""

from nextview.worlds.drawing import Meshes, draw_world
from nextview.worlds.occluded_camera import NOTHING, OTHER, TABLE_TOP, TARGET, OccludedCamera, SceneCamera
from nextview.worlds.scene import Scene, build_scene
from nextview.worlds.world import LEVELS, Block, Placement, World, level_of
from nextview.worlds.world_camera import WorldCamera, sensed_camera

__all__ = [
    "LEVELS", "NOTHING", "OTHER", "TABLE_TOP", "TARGET", "Block", "Meshes", "OccludedCamera", "Placement", "Scene",
    "SceneCamera", "World", "WorldCamera", "build_scene", "draw_world", "level_of", "sensed_camera",
]  # fmt: skip
