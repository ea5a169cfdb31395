"""3D view of a walk: the object, the candidate views by value, the path and the camera."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.checks import extras
from nextview.figures.style import ACCENT, FAINT, INK, WOOD, heat, rgb
from nextview.geometry.mesh import Mesh
from nextview.geometry.viewsphere import great_circle
from nextview.types import Float, Float32
from nextview.viewers.card import warm
from nextview.viewers.exploration import Walk

with extras():
    import viser

BALL = 0.09  # radius of a candidate view, object radii
TABLE_RADIUS = 2.4  # radius of the support disc, object radii
# number of faces above which a mesh is a scan, and is shaded smoothly
SMOOTH = 10_000


class WalkScene:
    """Draws a walk below one node of the scene graph; every walk needs its own instance.

    ``look`` is called with the index of a clicked candidate view; ``drag`` with the position to
    which the camera is dragged, (3,), object frame, and whether it was released.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        place: tuple[float, float, float],
        walk: Walk,
        mesh: Mesh | None,
        look: Callable[[int], None],
        drag: Callable[[Float, bool], None],
    ) -> None:
        self._scene = server.scene
        self._name = name
        self._drag = drag
        self.remove = server.scene.add_frame(
            name,
            show_axes=False,
            position=place,
        ).remove

        self._drawn = 0
        self._object: viser.MeshHandle | None = None
        if mesh is not None:
            vertices = mesh.vertices.astype(np.float32)
            flat = len(mesh.faces) < SMOOTH
            self._object = server.scene.add_mesh_simple(
                f"{name}/object",
                vertices,
                mesh.faces,
                color=rgb(WOOD),
                flat_shading=flat,
                side="double",
            )

        floor = (-1.0 if mesh is None else float(mesh.vertices[:, 2].min())) - 0.03
        server.scene.add_cylinder(
            f"{name}/table",
            TABLE_RADIUS,
            0.04,
            (255, 246, 230),
            radial_segments=96,
            position=(0, 0, floor),
            cast_shadow=False,
        )

        places = walk.sphere.poses[:, :3, 3]
        server.scene.add_line_segments(
            f"{name}/rings",
            _rings(places),
            rgb(FAINT),
            thickness=0.015,
        )
        plain: dict[str, Any] = {
            "subdivisions": 2,
            "cast_shadow": False,
            "receive_shadow": False,
        }
        self._balls = [
            server.scene.add_icosphere(
                f"{name}/views/{view}",
                BALL,
                position=place,
                **plain,
            )
            for view, place in enumerate(places)
        ]
        for view, ball in enumerate(self._balls):
            ball.on_click(lambda event, view=view: look(view))

        self._handle = server.scene.add_transform_controls(
            f"{name}/handle",
            0.7,
            disable_rotations=True,
            position=places[walk.start],
            depth_test=False,
        )
        self._handle.on_update(self._dragged)

    def _dragged(self, event: viser.TransformControlsEvent) -> None:
        if event.phase != "start":
            self._drag(np.asarray(event.target.position, float), event.phase == "end")

    def draw(self, walk: Walk, hide_unseen: bool) -> None:
        """Draw the current state of a walk.

        Args:
            walk: the walk.
            hide_unseen: whether to show only the observed points of the object.
        """
        if self._object is not None:
            self._object.visible = not hide_unseen
        self._colour(walk)

        points = walk.points
        name = self._name
        self._scene.add_point_cloud(
            f"{name}/seen",
            points,
            rgb(ACCENT),
            point_size=0.012,
            visible=len(points) > 0,
        )
        self._draw_path(walk)

        if not walk.views:
            return
        observation = walk.views[-1].observation
        pose = observation.pose
        self._handle.position = tuple(pose[:3, 3])

        height, width = observation.depth.shape
        self._scene.add_camera_frustum(
            f"{name}/camera",
            fov=2 * float(np.arctan(height / 2 / observation.intrinsics[1, 1])),
            aspect=width / height,
            scale=0.5,
            color=rgb(ACCENT),
            image=warm(observation.picture),
            wxyz=Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True),
            position=pose[:3, 3],
            cast_shadow=False,
        )

    def _colour(self, walk: Walk) -> None:
        """Colour the candidates by value, visited ones dark and small, the next one large."""
        values = (
            np.full(len(walk.sphere), np.nan)
            if walk.values is None
            else walk.values.copy()
        )
        values[walk.visited] = np.nan
        for view, (ball, colour) in enumerate(
            zip(self._balls, heat(values), strict=True)
        ):
            visited = view in walk.visited
            asked = view == walk.next_view
            ball.color = tuple(int(c) for c in colour)
            scale = 1.0
            if visited:
                ball.color = rgb(INK)
                scale = 0.5
            elif asked:
                ball.color = rgb(ACCENT)
                scale = 1.5
            if ball.scale != scale:
                ball.scale = scale

    def _draw_path(self, walk: Walk) -> None:
        """Draw new camera positions with their numbers, and great circles between them."""
        distance = walk.sphere.distance
        places = [view.direction for view in walk.views]
        for step in range(self._drawn, len(places)):
            name = f"{self._name}/path/{step + 1}"
            self._scene.add_label(
                f"{name}/number",
                str(step + 1),
                position=1.1 * distance * places[step],
            )
            if step:
                line = distance * great_circle(places[step - 1], places[step])
                segments = np.stack([line[:-1], line[1:]], 1)
                self._scene.add_line_segments(
                    f"{name}/way",
                    segments,
                    rgb(ACCENT),
                    thickness=0.03,
                )

        self._drawn = len(places)


def _rings(places: Float) -> Float32:
    """Return horizontal circles below the rings of views, (V, 3), as segments, (S, 2, 3).

    Empty for views that do not lie on rings.
    """
    around = np.linspace(0, 2 * np.pi, 97)
    heights = np.unique(np.round(places[:, 2], 3))
    heights = heights[: 0 if len(heights) > 12 else None]
    radius = np.sqrt(np.maximum((places[0] ** 2).sum() - heights**2, 0))[:, None]
    # the balls rest on the circles
    height = np.broadcast_to(heights[:, None] - BALL, (len(heights), 97))
    circles = np.stack([radius * np.cos(around), radius * np.sin(around), height], -1)
    return (
        np.stack([circles[:, :-1], circles[:, 1:]], 2)
        .reshape(-1, 2, 3)
        .astype(np.float32)
    )
