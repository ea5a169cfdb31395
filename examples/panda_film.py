"""A film of an arm at work, by ray casting: no graphics card and no OpenGL is needed."""

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nextview.geometry.depth import headlight
from nextview.geometry.ray_caster import embree_scene
from nextview.geometry.viewsphere import look_at_origin
from research.arm import along, seconds_of

SIZE = (440, 400)
SIDE = 200
"""Of the scene, and the width of what is shown beside it, pixels."""
FINER = 1
"""Rays for a pixel, along each side."""
SLOWER = 3
"""How many times slower than at the joints' velocity limits motions are shown."""
RATE = 10
"""Frames a second."""
LIGHT = np.array([-0.5, -0.55, 0.67])
BACKGROUND = (244, 245, 247)
GREY = (90, 95, 105)
ACCENT = (30, 110, 190)


class Film:
    """Frames of an arm; nothing is drawn without a file to write them to."""

    def __init__(self, arm, path):
        self.arm = arm
        self.path = path
        self.frames = []
        self.filmed = 0
        self.pose = look_at_origin(np.radians(24), np.radians(-52), 1.75)
        self.pose[:3, 3] += [0.28, 0.0, 0.3]
        self.beside = None
        self.seconds = 0.0

    def looked(self, session):
        """The way that the arm has come, and a still of what it believes now."""
        if self.path is None:
            return
        ways = self.arm.motions[self.filmed :]
        for seconds in on_the_way(self.arm, ways, SLOWER * RATE):
            self.show(self.seconds + seconds)
        self.seconds += sum(seconds_of(way) for way in ways)
        self.filmed = len(self.arm.motions)
        self.beside = beside(session)
        self.show(self.seconds)
        self.frames += [self.frames[-1]] * RATE

    def show(self, seconds):
        frame = Image.new("RGB", (SIZE[0] + SIDE, SIZE[1]), BACKGROUND)
        frame.paste(scene(self.arm.things(), self.pose), (0, 0))
        if self.beside:
            frame.paste(self.beside, (SIZE[0], 0))
        text(frame, (14, 12), f"{seconds:4.2f} s of motion", 15)
        self.frames.append(frame)

    def save(self):
        if self.path is None:
            return
        palette = self.frames[-1].quantize(96)
        frames = [
            frame.quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in self.frames
        ]
        frames += [frames[-1]] * (2 * RATE)
        frames[0].save(
            self.path,
            save_all=True,
            append_images=frames[1:],
            duration=1000 // RATE,
            loop=0,
            optimize=True,
        )


def on_the_way(arm, ways, rate):
    """Put an arm where it was on its ways, frame after frame, and in the end where it is.

    Args:
        arm: that has come these ways.
        ways: joints along each, one after the other.
        rate: frames a second of motion.

    Yields:
        The seconds of motion until each frame.
    """
    here = arm.joints
    passed = 0.0
    for way in ways:
        total = seconds_of(way)
        for joints, done in evenly(way, int(np.ceil(total * rate))):
            arm.joints = joints
            yield passed + done * total
        passed += total
    arm.joints = here


def evenly(way, n):
    """n places on a way and how much of it is done there, in step with time; the first one left
    out.
    """
    fine = along(way, 0.02)
    at = np.array([seconds_of(fine[: k + 1]) for k in range(len(fine))]) / seconds_of(
        fine
    )
    for done in np.linspace(0, 1, max(n, 1) + 1)[1:]:
        k = min(int(np.searchsorted(at, done)), len(fine) - 1)
        yield fine[k], done


def scene(things, pose):
    """A picture of things, lit by a lamp that throws shadows."""
    width = FINER * SIZE[0]
    height = FINER * SIZE[1]
    x, y = np.meshgrid(
        (np.arange(width) + 0.5) / width - 0.5,
        (np.arange(height) + 0.5 - height / 2) / width,
    )
    rays = np.stack([x, y, np.full(x.shape, 1.0)], -1).reshape(-1, 3) @ pose[:3, :3].T
    triangles = [each for each, _ in things]
    colours = np.array([colour for _, colour in things])
    cast = embree_scene(triangles)
    hits = first_hits(cast, pose[:3, 3], rays)
    hit = hits["primID"] >= 0
    normals = hits["Ng"][hit] / np.linalg.norm(hits["Ng"][hit], axis=1, keepdims=True)
    normals *= -np.sign((normals * rays[hit]).sum(1))[:, None]
    points = pose[:3, 3] + rays[hit] * hits["tfar"][hit, None] + 1e-3 * normals
    shadow = (
        first_hits(cast, points, np.broadcast_to(LIGHT, points.shape))["primID"] >= 0
    )
    lit = np.maximum(normals @ LIGHT, 0) * ~shadow
    facing = np.abs((normals * rays[hit]).sum(1)) / np.linalg.norm(rays[hit], axis=1)
    picture = np.tile(np.array(BACKGROUND, float) / 255, (len(rays), 1))
    picture[hit] = (
        colours[hits["geomID"][hit]] * (0.22 + 0.2 * facing + 0.55 * lit)[:, None]
    )
    image = Image.fromarray(
        (255 * picture.clip(0, 1) + 0.5).astype(np.uint8).reshape(height, width, 3)
    )
    return image.resize(SIZE, Image.Resampling.BOX)


def first_hits(cast, origins, rays):
    """What Embree says of where rays, (N, 3), end first: primID (-1 for nothing), geomID, tfar,
    and normals Ng.
    """
    origins = np.ascontiguousarray(np.broadcast_to(origins, rays.shape), np.float32)
    return cast.run(origins, np.ascontiguousarray(rays, np.float32), output=1)


def beside(session):
    """What the camera on the wrist saw last, and what is believed."""
    view = session.views[-1]
    depth = session.object.sightings[-1].frame.depth
    panel = Image.new("RGB", (SIDE, SIZE[1]), BACKGROUND)
    text(panel, (8, 12), f"view {len(session.views)}: depth", 13)
    near = np.where(depth > 0, 1 - (depth - 0.2) / 0.8, 0).clip(0, 1)
    colours = (255 * matplotlib.colormaps["viridis"](near)[..., :3]).astype(np.uint8)
    colours[depth == 0] = 30
    small = Image.fromarray(colours).resize(
        (SIDE - 16, (SIDE - 16) * depth.shape[0] // depth.shape[1])
    )
    panel.paste(small, (8, 34))
    text(panel, (8, 152), "the object, found", 13)
    shaded = headlight(view.observation.depth, view.observation.intrinsics)
    panel.paste(Image.fromarray(shaded).resize((104, 104)).convert("RGB"), (8, 174))
    text(panel, (8, 284), "belief", 13)
    draw = ImageDraw.Draw(panel)
    order = np.argsort(-view.belief)[:4]
    for row, k in enumerate(order):
        y = 306 + 21 * row
        draw.rectangle(
            (90, y + 2, 90 + 100 * float(view.belief[k]), y + 14),
            ACCENT if row == 0 else GREY,
        )
        text(panel, (8, y), session.models.classes[k].replace("_", " "), 12)
    return panel


def text(picture, where, words, size):
    ImageDraw.Draw(picture).text(where, words, GREY, ImageFont.load_default(size))
