"""Films of arms at work, by ray casting: no graphics card and no OpenGL is needed.

``ArmFilm`` shows an arm that looks at an object, ``BinFilm`` a cell that empties a bin, and
``TableFilm`` an arm over a full table, whose things get their colours once they are known. Beside
each stands what the camera on the wrist saw last, and what is known by now.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from contourpy import contour_generator
from PIL import Image, ImageColor, ImageDraw
from scipy import ndimage

import nextview
from nextview.geometry.depth import headlight
from nextview.geometry.ray_caster import embree_scene
from nextview.geometry.viewsphere import look_at_origin
from nextview.scene.figure import (
    FIGURE_CELL,
    OBJECT_COLOURS,
    grey_picture,
    seen_from_above,
)
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.session.session import Session
from nextview.session.style import ACCENT, BLUE, GREY, INK, PAPER
from research.arm import Arm, along, seconds_of
from research.film_stage import KEY, SKY, SUN, Array, Stage, font, rays_of, toned

if TYPE_CHECKING:
    from bin_cell import Cell

COLOURS_IN_GIF = 255
FRAMES_OF_PALETTE = 10  # from which the palette is made


class Film:
    """Frames that become a GIF.

    Args:
        path: that is written; None for no film.
    """

    RATE = 10  # frames a second
    LAST = 2.0  # seconds that the last frame is shown

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.frames: list[Image.Image] = []

    def hold(self, seconds: float) -> None:
        """Show the last frame for some seconds."""
        self.frames += [self.frames[-1]] * int(seconds * self.RATE)

    def save(self) -> None:
        """Write the film."""
        if self.path is None or not self.frames:
            return
        self.hold(self.LAST)
        few = strip(self.frames[:: max(1, len(self.frames) // FRAMES_OF_PALETTE)])
        coverage = Image.Quantize.MAXCOVERAGE  # small things keep their colours
        palette = few.quantize(COLOURS_IN_GIF, method=coverage, kmeans=3)
        plain = Image.Dither.NONE
        frames = [
            frame.quantize(palette=palette, dither=plain) for frame in self.frames
        ]
        frames[0].save(
            self.path,
            save_all=True,
            append_images=frames[1:],
            duration=1000 // self.RATE,
            loop=0,
            optimize=True,
        )


def strip(frames: Sequence[Image.Image]) -> Image.Image:
    """Frames side by side, half as large."""
    small = [frame.reduce(2) for frame in frames]
    whole = Image.new("RGB", (sum(frame.width for frame in small), small[0].height))
    for k, frame in enumerate(small):
        whole.paste(frame, (k * frame.width, 0))
    return whole


def on_the_way(arm: Arm, ways: Sequence[Array], rate: float) -> Iterator[float]:
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


def evenly(way: Array, n: int) -> Iterator[tuple[Array, float]]:
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


# An arm that looks at an object, and a cell that empties a bin

SIZE = (440, 400)  # of the scene, pixels
SIDE = 200  # width of what is shown beside it, pixels
LIGHT = np.array([-0.5, -0.55, 0.67])
SLOWER = 3  # times than at the joints' velocity limits motions are shown
ROWS = 14  # objects of a bin that are listed


class SmallFilm(Film):
    """A film of things in a small picture, with a panel beside it.

    Args:
        path: that is written; None for no film.
        pose: of the camera that films, (4, 4).
    """

    def __init__(self, path: Path | None, pose: Array) -> None:
        super().__init__(path)
        self.pose = pose
        self.beside = Image.new("RGB", (SIDE, SIZE[1]), PAPER)

    def show(self, things: Sequence[Any], words: str) -> None:
        """Add a frame of things, triangles and a colour each, with words on it."""
        frame = Image.new("RGB", (SIZE[0] + SIDE, SIZE[1]), PAPER)
        frame.paste(picture_of(things, self.pose), (0, 0))
        frame.paste(self.beside, (SIZE[0], 0))
        text(frame, (14, 12), words, 15)
        self.frames.append(frame)


class ArmFilm(SmallFilm):
    """A film of an arm that looks at an object."""

    def __init__(self, arm: Arm, path: Path | None) -> None:
        pose = look_at_origin(np.radians(24), np.radians(-52), 1.75)
        pose[:3, 3] += [0.28, 0.0, 0.3]
        super().__init__(path, pose)
        self.arm = arm
        self.filmed = 0
        self.seconds = 0.0

    def looked(self, session: Session) -> None:
        """The way that the arm has come, and a still of what it believes now."""
        if self.path is None:
            return
        ways = self.arm.motions[self.filmed :]
        for seconds in on_the_way(self.arm, ways, SLOWER * self.RATE):
            self.show_arm(self.seconds + seconds)
        self.seconds += sum(seconds_of(way) for way in ways)
        self.filmed = len(self.arm.motions)
        self.beside = belief_panel(session)
        self.show_arm(self.seconds)
        self.hold(1.0)

    def show_arm(self, seconds: float) -> None:
        """Add a frame of the arm as it is now."""
        self.show(self.arm.things(), f"{seconds:4.2f} s of motion")


class BinFilm(SmallFilm):
    """A film of a cell, from now on."""

    EVERY = 4  # tenths of a second of simulated time between two frames
    STILL = 0.8  # seconds that what is known is shown after a look

    def __init__(self, cell: Cell, path: Path | None) -> None:
        pose = look_at_origin(np.radians(38), np.radians(-38), 1.1)
        pose[:3, 3] += [0.42, -0.18, 0.2]
        super().__init__(path, pose)
        self.cell = cell
        self._count = 0
        self._begin = cell.seconds
        if path is not None:
            cell.watch = self.passed

    def passed(self) -> None:
        """A tenth of a second of simulated time has passed."""
        self._count += 1
        if self._count % self.EVERY == 0:
            self.show_cell()

    def show_cell(self) -> None:
        """Add a frame of the cell as it is now."""
        self.show(self.cell.things(), f"{self.cell.seconds - self._begin:5.1f} s")

    def looked(self, known: nextview.Scene) -> None:
        """Show what is known after a look for a while."""
        if self.path is None:
            return
        self.beside = bin_panel(known)
        self.show_cell()
        self.hold(self.STILL)


def picture_of(things: Sequence[Any], pose: Array) -> Image.Image:
    """A picture of things, lit by a lamp that throws shadows."""
    width, height = SIZE
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
    picture = np.tile(np.array(ImageColor.getrgb(PAPER)) / 255, (len(rays), 1))
    picture[hit] = (
        colours[hits["geomID"][hit]] * (0.22 + 0.2 * facing + 0.55 * lit)[:, None]
    )
    pixels = (255 * picture.clip(0, 1) + 0.5).astype(np.uint8)
    return Image.fromarray(pixels.reshape(height, width, 3))


def first_hits(cast: Any, origins: Array, rays: Array) -> Any:
    """What Embree says of where rays, (N, 3), end first: primID (-1 for nothing), geomID, tfar,
    and normals Ng.
    """
    origins = np.ascontiguousarray(np.broadcast_to(origins, rays.shape), np.float32)
    return cast.run(origins, np.ascontiguousarray(rays, np.float32), output=1)


def depth_picture(depth: Array) -> Array:
    """Depth in colours, near ones bright, (H, W, 3) uint8."""
    near, far = np.quantile(depth[depth > 0], [0.02, 0.98])
    shade = np.where(depth > 0, (far - depth) / (far - near), 0).clip(0, 1)
    return (255 * matplotlib.colormaps["viridis"](shade)[..., :3]).astype(np.uint8)


def depth_panel(number: int, colours: Array) -> tuple[Image.Image, int]:
    """A panel with a picture of the depth of a view, and the height at which that ends."""
    panel = Image.new("RGB", (SIDE, SIZE[1]), PAPER)
    text(panel, (8, 12), f"view {number}: depth", 13)
    width = SIDE - 16
    height = width * colours.shape[0] // colours.shape[1]
    panel.paste(Image.fromarray(colours).resize((width, height)), (8, 34))
    return panel, 34 + height


def belief_panel(session: Session) -> Image.Image:
    """What the camera on the wrist saw last, and what is believed."""
    view = session.views[-1]
    depth = session.object.sightings[-1].frame.depth
    panel, _ = depth_panel(len(session.views), depth_picture(depth))
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
            BLUE if row == 0 else GREY,
        )
        text(panel, (8, y), session.models.classes[k].replace("_", " "), 12)
    return panel


def bin_panel(known: nextview.Scene) -> Image.Image:
    """The last depth image with the outlines of the objects, and their names."""
    number = len(known.frames) - 1
    colours = depth_picture(known.frames[-1].depth)
    for one in known.objects:
        if number in one.pixels:
            mask = one.pixels[number]
            rim = ndimage.binary_dilation(mask, iterations=3) & ~mask
            colours[rim] = (255, 255, 255) if one.confident else (120, 120, 120)
    panel, end = depth_panel(number + 1, colours)
    draw = ImageDraw.Draw(panel)
    for row, one in enumerate(known.objects[:ROWS]):
        y = end + 12 + 20 * row
        draw.rectangle((8, y + 2, 18, y + 12), BLUE if one.confident else GREY)
        doubt = "" if one.confident else " ?"
        text(panel, (24, y), one.name.replace("_", " ") + doubt, 12)
    return panel


def text(picture: Image.Image, where: tuple[int, int], words: str, size: int) -> None:
    """Write words into a picture."""
    ImageDraw.Draw(picture).text(where, words, INK, font(size))


# An arm over a full table

TABLE_SIZE = (600, 540)  # of the picture of the arm, pixels
TABLE_SIDE = 348  # width of what is shown beside it, pixels
INSET = 12  # pixels
FINER = 2  # rays for a pixel, along each side
FOCAL = 1.45  # of the camera that films, widths of the picture
LOOKED_AT = np.array([0.34, 0.02, 0.21])
FILMED_FROM = np.radians([26.0, -47.0])
AWAY = 2.05  # metres
CLAY = np.array([0.60, 0.57, 0.53])
TABLE = np.array([0.66, 0.58, 0.47])
LAMP = 0.09  # radius of the lamp, a unit away
# rays to the lamp from each point on which the arm may throw its shadow
SHADOW_SAMPLES = 5
SKY_SAMPLES = 48
PLAN = 0.31  # metres from its middle to the border of the view from above
# red is for what is wrong
NO_RED = tuple(OBJECT_COLOURS[k] for k in (0, 2, 3, 4, 5, 7, 8))
BESIDE = 24  # pixels beside what was found that are shown with it
ABOVE = np.array([0, 0, 0.035])  # metres from the top of a thing to its name
VIEW = 0.42  # metres to where the view of the camera on the wrist is drawn
FRAME = "#d5dbe1"
SHARP = 2000  # triangles of a thing up to which its edges are sharp


class TableFilm(Film):
    """Frames of an arm over a table.

    Args:
        arm: over the table.
        middle: of what stands on the table, (3,), metres.
        title: of the film.
        path: GIF that is written.
    """

    RATE = 12
    LAST = 4.0
    STILL = 1.4  # seconds that are shown after a look
    SLOWER = 4.0  # times than at the joints' velocity limits motions are shown

    def __init__(self, arm: Arm, middle: Array, title: str, path: Path) -> None:
        super().__init__(path)
        self.arm = arm
        self._middle = middle
        self._title = title
        self._filmed = 0
        self._seconds = 0.0
        self._beside: Image.Image | None = None
        self._labels: list[tuple[Array, str, str]] = []
        self._pose = look_at_origin(*FILMED_FROM, AWAY)
        self._pose[:3, 3] += LOOKED_AT
        self._light_table()

    def looked(
        self,
        scene: nextview.Scene,
        owner: dict[int, int],
        wrong: set[int],
    ) -> None:
        """Film the way to the last look, and what is known after it.

        Args:
            scene: with the look taken in.
            owner: row of the thing that each object truly is, by its number.
            wrong: numbers of objects that are named wrongly.
        """
        ways = self.arm.motions[self._filmed :]
        for seconds in on_the_way(self.arm, ways, self.SLOWER * self.RATE):
            self._show(self._seconds + seconds)
        self._seconds += sum(seconds_of(way) for way in ways)
        self._filmed = len(self.arm.motions)

        self._colour(scene, owner, wrong)
        self._beside = table_panel(scene, self._middle, wrong)
        self._show(self._seconds, looking=True)
        self.hold(self.STILL)

    def end(self, said: Sequence[str]) -> None:
        """Write the film, with lines at its end."""
        self._show(self._seconds, said)
        self.save()

    # The table under the lamp

    def _light_table(self) -> None:
        """Cast the table and the things on it once: where light falls and what each pixel shows."""
        things = [
            triangles for triangles, _ in self.arm.things()[: 1 + self.arm.standing]
        ]
        stage = Stage(
            [(*apart(*one), (float(k), 0, 0)) for k, one in enumerate(things)]
        )
        rays = self._rays()
        hit, points, normals, rows = stage.hits(self._pose[:3, 3], rays)
        sky, lamp = stage.lit(
            points,
            normals,
            np.ones_like(points),
            np.random.default_rng(0),
            SKY_SAMPLES,
        )
        # the same places of the lamp for all pixels and all frames: shadows without grain
        ball = np.random.default_rng(0).normal(size=(SHADOW_SAMPLES, 3))
        self._lamps = KEY + LAMP * ball / np.linalg.norm(ball, axis=1, keepdims=True)
        self._hit = hit
        self._points = points
        self._away = np.full(len(rays), np.inf)
        self._away[hit] = np.linalg.norm(points - self._pose[:3, 3], axis=1)
        self._rows = rows[:, 0].astype(int)
        self._sky, self._lamp = sky, lamp
        self._albedo = np.tile(CLAY, (len(things), 1))
        self._albedo[0] = TABLE
        self._tops = [
            0.5 * (v.min(0) + v.max(0)) * [1, 1, 0] + [0, 0, v[:, 2].max()]
            for v, _ in things
        ]

    def _rays(self) -> Array:
        """Rays of the camera that films, row by row."""
        return rays_of(
            self._pose,
            FINER * FOCAL * TABLE_SIZE[0],
            FINER * TABLE_SIZE[0],
            FINER * TABLE_SIZE[1],
        )

    def _colour(
        self,
        scene: nextview.Scene,
        owner: dict[int, int],
        wrong: set[int],
    ) -> None:
        """Give the things that are known their colours and names."""
        self._albedo[1:] = CLAY
        self._labels = []
        for thing in scene.objects:
            row = owner[thing.number] + 1
            if row == 0 or not (thing.confident or thing.name == UNKNOWN_NAME):
                continue
            colour = colour_of(thing, wrong)
            if thing.name != UNKNOWN_NAME:
                self._albedo[row] = linear(colour)
            self._labels.append((self._tops[row], words(thing, wrong), colour))

    def _show(
        self,
        seconds: float,
        said: Sequence[str] = (),
        looking: bool = False,
    ) -> None:
        """Add a frame: the arm as it is now, and lines on it."""
        frame = Image.new("RGB", (TABLE_SIZE[0] + TABLE_SIDE, TABLE_SIZE[1]), PAPER)
        picture = self._filmed_now()
        draw = ImageDraw.Draw(picture, "RGBA")
        if looking:
            self._draw_view(draw)
        taken: list[Array] = []
        placed = [
            (self._place(top + ABOVE), name, colour)
            for top, name, colour in self._labels
        ]
        for at, name, colour in sorted(placed, key=lambda label: -label[0][1]):
            tag(draw, at, name, colour, taken)
        frame.paste(picture, (0, 0))
        if self._beside is not None:
            frame.paste(self._beside, (TABLE_SIZE[0], 0))
        draw = ImageDraw.Draw(frame, "RGBA")
        speed = f"{seconds:.1f} s of motion, shown {self.SLOWER:g} times slower"
        lines(draw, said or [self._title, speed])
        self.frames.append(frame)

    def _filmed_now(self) -> Image.Image:
        """The arm over the table, lit."""
        links = self.arm.things()[1 + self.arm.standing :]
        stage = Stage(
            [(vertices, faces, colour) for (vertices, faces), colour in links]
        )
        eye = self._pose[:3, 3]
        shadow = stage.blocked(self._points + 1e-3 * KEY, self._lamps[:, None]).mean(0)
        lamp = self._lamp * (1 - shadow)[:, None]
        light = np.tile(1.9 * SKY, (len(self._hit), 1))
        light[self._hit] = self._albedo[self._rows] * (self._sky + lamp)

        corners = np.concatenate([vertices for (vertices, _), _ in links])
        low, high = (
            np.clip(
                f(self._place(corners), axis=0) * FINER + d,
                0,
                np.array(TABLE_SIZE) * FINER,
            ).astype(int)
            for f, d in ((np.min, -2), (np.max, 2))
        )
        part = np.zeros((TABLE_SIZE[1] * FINER, TABLE_SIZE[0] * FINER), bool)
        part[low[1] : high[1], low[0] : high[0]] = True
        within = np.flatnonzero(part)
        hit, points, normals, colours = stage.hits(eye, self._rays()[within])
        nearer = np.linalg.norm(points - eye, axis=1) < self._away[within[hit]]
        blocked = stage.blocked(points + 1e-3 * normals, self._lamps[:, None]).mean(0)
        facing = np.maximum(normals @ KEY / np.linalg.norm(KEY), 0) * (1 - blocked)
        sky = SKY * (0.6 + 0.3 * normals[:, 2:])
        light[within[hit][nearer]] = (colours * (sky + SUN * facing[:, None]))[nearer]

        pixels = toned(light).reshape(TABLE_SIZE[1] * FINER, TABLE_SIZE[0] * FINER, 3)
        return Image.fromarray(pixels).resize(TABLE_SIZE, Image.Resampling.BOX)

    def _place(self, points: Array) -> Array:
        """Pixels, (..., 2), of points, (..., 3), world."""
        inside = (points - self._pose[:3, 3]) @ self._pose[:3, :3]
        return (
            inside[..., :2] / inside[..., 2:] * FOCAL * TABLE_SIZE[0]
            + np.array(TABLE_SIZE) / 2
        )

    def _draw_view(self, draw: ImageDraw.ImageDraw) -> None:
        """What the camera on the wrist has in view, down to the table."""
        pose = self.arm.pose
        k = self.arm.sensor.intrinsics
        height, width = self.arm.sensor.shape
        corners = (
            np.array([[0, 0], [width, 0], [width, height], [0, height]]) - k[:2, 2]
        )
        rays = (
            np.column_stack([corners / k[[0, 1], [0, 1]], np.ones(4)]) @ pose[:3, :3].T
        )
        ends = pose[:3, 3] + VIEW * rays
        eye = tuple(self._place(pose[:3, 3]))
        flat = [tuple(one) for one in self._place(ends)]
        for one, other in zip(flat, [*flat[1:], flat[0]], strict=True):
            draw.polygon([eye, one, other], (*ImageColor.getrgb(ACCENT), 20))
            draw.line([eye, one], (*ImageColor.getrgb(ACCENT), 150), 1)
        draw.line([*flat, flat[0]], (*ImageColor.getrgb(ACCENT), 220), 2)


def lines(draw: ImageDraw.ImageDraw, said: Sequence[str]) -> None:
    """Write lines at the lower left, the first of them bold."""
    wide = max(draw.textlength(line, font(14, True)) for line in said)
    box = (6, TABLE_SIZE[1] - 14 - 20 * len(said), 22 + wide, TABLE_SIZE[1] - 6)
    draw.rounded_rectangle(box, 8, (*ImageColor.getrgb(PAPER), 215))
    for k, line in enumerate(said):
        y = TABLE_SIZE[1] - 14 - 20 * (len(said) - 1 - k)
        letters = font(14 if k == 0 else 13, k == 0)
        draw.text((14, y), line, INK, letters, anchor="ls")


def table_panel(scene: nextview.Scene, middle: Array, wrong: set[int]) -> Image.Image:
    """What the camera saw last with what was found in it, and all from above."""
    panel = Image.new("RGB", (TABLE_SIDE, TABLE_SIZE[1]), PAPER)
    draw = ImageDraw.Draw(panel)
    number = len(scene.frames)
    draw.text((INSET, 12), f"look {number}: what its camera sees", INK, font(13, True))
    seen = wrist_picture(scene, wrong)
    panel.paste(seen, (INSET, 32))

    top = 32 + seen.height + 14
    draw.text((INSET, top), "what it knows, from above", INK, font(13, True))
    side = TABLE_SIZE[1] - top - 20 - 34
    plan = plan_picture(scene, middle, wrong, (seen.width, side))
    panel.paste(plan, (INSET, top + 20))

    named = [thing for thing in scene.objects if thing.name != UNKNOWN_NAME]
    sure = sum(thing.confident for thing in named)
    unknown = len(scene.objects) - len(named)
    said = f"{sure} sure, {len(named) - sure} not sure, {unknown} unknown"
    draw.text((INSET, TABLE_SIZE[1] - 26), said, INK, font(14, True))
    return panel


def wrist_picture(scene: nextview.Scene, wrong: set[int]) -> Image.Image:
    """The last frame with outlines and names, as wide as the panel."""
    frame = scene.frames[-1]
    number = len(scene.frames) - 1
    grey = np.asarray(255 * grey_picture(frame))
    picture = np.repeat(grey[..., None], 3, -1)
    names = []
    for thing in scene.objects:
        mask = thing.pixels.get(number)
        if mask is None:
            continue
        colour = np.array(ImageColor.getrgb(colour_of(thing, wrong)))
        whole = ndimage.binary_fill_holes(ndimage.binary_closing(mask, iterations=3))
        rim = ndimage.binary_dilation(whole, iterations=2) & ~ndimage.binary_erosion(
            whole,
            iterations=2,
        )
        picture[whole] = 0.65 * picture[whole] + 0.35 * colour
        picture[rim] = colour
        rows, columns = np.nonzero(mask)
        names.append((thing, columns.mean(), rows.min()))
    width = TABLE_SIDE - 2 * INSET
    left, top, right, bottom = part_of_frame(scene)
    share = width / (right - left)
    cut = Image.fromarray(picture.clip(0, 255).astype(np.uint8)).crop(
        (left, top, right, bottom)
    )
    small = cut.resize((width, round(share * (bottom - top))), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(small)
    taken: list[tuple[float, float, float]] = []
    for thing, x, y in sorted(names, key=lambda each: -each[2]):
        write(
            draw,
            thing,
            (share * (x - left), share * (y - top) - 6),
            wrong,
            taken,
            small.size,
        )
    return small


def part_of_frame(scene: nextview.Scene) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of the last frame that holds what was found."""
    height, width = scene.frames[-1].shape
    masks = [thing.pixels.get(len(scene.frames) - 1) for thing in scene.objects]
    shown = [mask for mask in masks if mask is not None]
    if not shown:
        return 0, 0, width, height
    rows, columns = np.nonzero(np.any(shown, axis=0))
    low = np.array([columns.min(), rows.min()]) - BESIDE
    high = np.array([columns.max(), rows.max()]) + BESIDE
    share = min(1.0, max((high - low) / [width, height]))
    size = np.round(share * np.array([width, height])).astype(int)
    corner = np.clip((low + high - size) // 2, 0, [width, height] - size)
    return (*corner.tolist(), *(corner + size).tolist())


def plan_picture(
    scene: nextview.Scene,
    middle: Array,
    wrong: set[int],
    size: tuple[int, int],
) -> Image.Image:
    """All from above as the camera that films sees it: away from it is up."""
    ahead = -np.array([np.cos(FILMED_FROM[1]), np.sin(FILMED_FROM[1]), 0.0])
    upright = np.array([[ahead[1], -ahead[0], 0.0], ahead, [0.0, 0.0, 1.0]])
    width, height = size
    scale = FINER * height / (2 * PLAN)

    def flat(points: Array) -> Array:
        at = (points - (upright @ middle)[:2]) * scale
        return at * [1, -1] + FINER * np.array(size) / 2

    picture = Image.new("RGB", (FINER * width, FINER * height), "white")
    draw = ImageDraw.Draw(picture, "RGBA")
    for thing in scene.objects:
        colour = ImageColor.getrgb(colour_of(thing, wrong))
        for ring in rings(thing, upright):
            corners = [tuple(one) for one in flat(ring)]
            draw.polygon(corners, (*colour, 70))
            draw.line([*corners, corners[0]], (*colour, 255), 2 * FINER)
    places = (
        np.array([frame.camera_to_world[:3, 3] for frame in scene.frames]) @ upright.T
    )
    dots = [
        tuple(np.clip(one, 8, FINER * np.array(size) - 8))
        for one in flat(places[:, :2])
    ]
    draw.line(dots, (*ImageColor.getrgb(INK), 110), FINER)
    for k, (x, y) in enumerate(dots):
        r = (3 if k < len(dots) - 1 else 5) * FINER
        draw.ellipse(
            (x - r, y - r, x + r, y + r),
            ACCENT if k == len(dots) - 1 else INK,
        )
    picture = picture.resize(size, Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(picture)
    taken: list[tuple[float, float, float]] = []
    for thing in scene.objects:
        at = flat((upright @ thing.place)[:2]) / FINER
        write(draw, thing, (at[0], at[1] + 5), wrong, taken, size)
    draw.rectangle((0, 0, width - 1, height - 1), outline=FRAME)
    return picture


def rings(thing: SceneObject, upright: Array) -> list[Array]:
    """Outlines of an object seen from above, (K, 2) each, metres."""
    corners, cells = seen_from_above(thing, upright)
    if cells is None:
        return [corners]
    low = corners.min(0) - 2 * FIGURE_CELL
    smooth = ndimage.gaussian_filter(cells.astype(float), 0.8).T
    x, y = (low[k] + FIGURE_CELL * np.arange(cells.shape[k]) for k in (0, 1))
    return contour_generator(x, y, smooth).lines(0.5)


def write(
    draw: ImageDraw.ImageDraw,
    thing: SceneObject,
    at: tuple[float, float],
    wrong: set[int],
    taken: list[tuple[float, float, float]],
    size: tuple[int, int],
) -> None:
    """Write a name where no other is, and remember where."""
    text = words(thing, wrong)
    letters = font(11, thing.confident)
    half = draw.textlength(text, letters) / 2 + 2
    x = float(np.clip(at[0], half, size[0] - half))
    y = float(np.clip(at[1], 14, size[1] - 4))
    while (
        any(abs(y - b) < 12 and abs(x - a) < half + other for a, b, other in taken)
        and y > 14
    ):
        y -= 4
    taken.append((x, y, half))
    colour = INK if thing.name == UNKNOWN_NAME else colour_of(thing, wrong)
    draw.text(
        (x, y),
        text,
        colour,
        letters,
        anchor="ms",
        stroke_width=2,
        stroke_fill="white",
    )


def tag(
    draw: ImageDraw.ImageDraw,
    at: Array,
    text: str,
    colour: str,
    taken: list[Array],
) -> None:
    """Write a name on a coloured ground where no other is, and remember where."""
    letters = font(12, True)
    half = draw.textlength(text, letters) / 2 + 8
    x, y = at
    while any(abs(y - b) < 21 and abs(x - a) < half + other for a, b, other in taken):
        y -= 3
    taken.append(np.array([x, y, half]))
    box = (x - half, y - 10, x + half, y + 10)
    draw.rounded_rectangle(box, 10, (*ImageColor.getrgb(colour), 235))
    draw.text((x, y), text, "white", letters, anchor="mm")


def words(thing: SceneObject, wrong: set[int]) -> str:
    """The name of an object, and what is to be said of it."""
    name = thing.name.replace("_", " ")
    if thing.number in wrong:
        return f"{name} (wrong)"
    return name if thing.confident or thing.name == UNKNOWN_NAME else f"{name}?"


def colour_of(thing: SceneObject, wrong: set[int]) -> str:
    """The colour of an object: grey for an unknown one, red for a wrong name."""
    if thing.number in wrong:
        return ACCENT
    return (
        GREY if thing.name == UNKNOWN_NAME else NO_RED[(thing.number - 1) % len(NO_RED)]
    )


def linear(colour: str) -> Array:
    """A colour as the light that it sends back, (3,)."""
    return (np.array(ImageColor.getrgb(colour)) / 255) ** 2.2


def apart(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """The same triangles without shared corners where they are few: edges stay sharp."""
    if len(faces) > SHARP:
        return vertices, faces
    return vertices[faces].reshape(-1, 3), np.arange(
        3 * len(faces),
        dtype=np.int32,
    ).reshape(-1, 3)
