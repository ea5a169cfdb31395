"""Interactive 3D page of a scene: objects in their poses on the table, with beliefs.

The page is one file. It needs no server, and can be shared.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nextview.checks import extras
from nextview.errors import SessionError, UsageError
from nextview.figures.style import ACCENT, GROUND, INK, PAPER, rgb
from nextview.files import new_file
from nextview.scene.figure import grey_picture
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Scene
from nextview.types import Float
from nextview.viewers.scene_card import scene_card
from nextview.viewers.scene_shapes import colour_of, name_of, placed_shape, points_of

with extras():
    import viser

    from nextview.viewers.page import serve, titled

FRUSTUM_PIXELS = 200  # width of the image in a camera frustum, pixels
PAGE_FRUSTUM = 0.045  # metres, size of a camera frustum
AROUND = 0.08  # metres of table around the objects
PAGE_TABLE_THICKNESS = 0.01  # metres
STEEP = 0.8  # height of the initial viewpoint, relative to its horizontal distance
FAR = 2.0  # distance of the initial viewpoint, in radii of the scene
ASIDE = np.radians(50.0)  # azimuth of the initial viewpoint from the last camera
UNSURE = 0.6  # opacity of objects that are not confident
HULL = 0.35  # opacity of the hull of an unknown object


def write_scene_page(
    scene: Scene,
    path: str | Path,
    title: str = "On the table",
    overwrite: bool = False,
) -> None:
    """Write a 3D page of a scene: registered scans, cameras, beliefs.

    Args:
        scene: with at least one frame.
        path: of the page, .html.
        title: of the scene.
        overwrite: whether to replace an existing page.

    Raises:
        SessionError: the scene has no frame yet.
        UsageError: the file name has another suffix.
        ResultsError: the page exists, or cannot be written.
    """
    if not scene.frames:
        raise SessionError(
            "there is nothing to show before the first frame: update with one"
        )
    if Path(path).suffix != ".html":
        raise UsageError(f"{path}: a page is called .html")
    with redirect_stdout(
        StringIO()
    ):  # suppress viser's message about a temporary server
        server = serve("127.0.0.1", 0)
        try:
            draw_scene_in_3d(server, scene)
            page = titled(server.scene.as_html(), f"{title} - nextview")
        finally:
            server.stop()
    before, end, after = page.rpartition("</body>")
    with new_file(Path(path), overwrite) as part:
        part.write_text(
            f"{before}{scene_card(scene, title)}{end}{after}",
            encoding="utf-8",
        )


def draw_scene_in_3d(server: viser.ViserServer, scene: Scene) -> None:
    """Draw the table, the registered scans, the observed points and the cameras.

    Args:
        server: of the page.
        scene: with at least one frame.
    """
    top = scene.tops[0]
    objects = scene.objects
    corners = [thing.seen_points for thing in objects]
    cameras = [frame.camera_to_world for frame in scene.frames]
    everything = (
        np.concatenate(corners) if corners else np.stack([c[:3, 3] for c in cameras])
    )
    middle = (everything.min(0) + everything.max(0)) / 2
    radius = float(np.linalg.norm(everything - middle, axis=1).max()) + AROUND

    three = server.scene
    three.set_up_direction(tuple(float(one) for one in top.up))
    three.configure_environment_map(None)
    three.configure_default_lights(False)
    three.add_light_hemisphere(
        "/sky",
        sky_color=rgb(PAPER),
        ground_color=rgb(GROUND),
        intensity=3.0,
    )
    lamp = middle + radius * (3 * top.up + np.array([-1.0, -1.5, 0.0]))
    three.add_light_directional(
        "/lamp",
        color=(255, 255, 255),
        intensity=1.6,
        position=tuple(lamp),
    )

    _draw_table(server, scene, middle, radius)
    for thing in objects:
        _draw_object(server, scene, thing)
    for number, frame in enumerate(scene.frames):
        _draw_frame(server, scene, number, frame.camera_to_world)
    way = np.stack([pose[:3, 3] for pose in cameras])
    if len(way) > 1:
        segments = np.stack([way[:-1], way[1:]], 1)
        three.add_line_segments("/cameras/way", segments, rgb(INK), thickness=0.002)
    _look_at_it(server, scene, middle, radius)


def _look_at_it(
    server: viser.ViserServer,
    scene: Scene,
    middle: Float,
    radius: float,
) -> None:
    """Set the initial viewpoint: beside the last camera, farther away and higher."""
    up = scene.tops[0].up
    back = scene.frames[-1].camera_to_world[:3, 3] - middle
    back = back - (back @ up) * up
    length = float(np.linalg.norm(back))
    level = back / length if length > 1e-6 else np.roll(up, 1)
    level = Rotation.from_rotvec(ASIDE * up).apply(level)
    away = FAR * radius * (level + STEEP * up) / np.hypot(1, STEEP)
    server.initial_camera.position = tuple(middle + away)
    server.initial_camera.look_at = tuple(middle)


def _draw_table(
    server: viser.ViserServer,
    scene: Scene,
    middle: Float,
    radius: float,
) -> None:
    """Draw the support plane as a disc."""
    top = scene.tops[0]
    normal = top.plane.normal
    foot = middle - float(top.plane.height(middle[None])[0]) * normal
    turn, _ = Rotation.align_vectors(normal[None], np.array([[0.0, 0.0, 1.0]]))
    server.scene.add_cylinder(
        "/table",
        radius,
        PAGE_TABLE_THICKNESS,
        rgb("#efe4d3"),
        radial_segments=96,
        wxyz=turn.as_quat(scalar_first=True),
        position=tuple(foot - PAGE_TABLE_THICKNESS * normal),
    )


def _draw_object(server: viser.ViserServer, scene: Scene, thing: SceneObject) -> None:
    """Draw the registered scan or, for an unknown object, the hull of its points; and its name."""
    colour = rgb(colour_of(thing))
    name = f"/objects/{thing.number}"
    shape = placed_shape(thing)
    if shape is not None:
        vertices, faces = shape
        server.scene.add_mesh_simple(
            name,
            vertices,
            faces,
            color=colour,
            opacity=HULL
            if thing.name == UNKNOWN_NAME
            else None
            if thing.confident
            else UNSURE,
            flat_shading=False,
            side="double",
        )

    if thing.name == UNKNOWN_NAME:
        points = points_of(scene, thing)
        server.scene.add_point_cloud(
            f"{name}/seen",
            points,
            rgb(INK),
            point_size=0.0012,
        )

    top = thing.place + np.array([0.0, 0.0, thing.size[2] / 2 + 0.02])
    server.scene.add_label(f"{name}/name", name_of(thing), position=tuple(top))


def _draw_frame(
    server: viser.ViserServer,
    scene: Scene,
    number: int,
    pose: Float,
) -> None:
    """Draw a camera in its pose, with its image."""
    frame = scene.frames[number]
    height, width = frame.shape
    picture = Image.fromarray((255 * grey_picture(frame)).astype(np.uint8))
    small = picture.resize((FRUSTUM_PIXELS, round(FRUSTUM_PIXELS * height / width)))
    last = number == len(scene.frames) - 1
    server.scene.add_camera_frustum(
        f"/cameras/{number + 1}",
        fov=2 * float(np.arctan(height / 2 / frame.intrinsics[1, 1])),
        aspect=width / height,
        scale=PAGE_FRUSTUM,
        color=rgb(ACCENT if last else INK),
        image=np.repeat(np.asarray(small)[..., None], 3, -1),
        wxyz=Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True),
        position=tuple(pose[:3, 3]),
        line_width=1.5,
    )

    server.scene.add_label(f"/cameras/{number + 1}/number", str(number + 1))
