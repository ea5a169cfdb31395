"""A film: twelve household things on a table, told apart by a wrist camera, beside one whose next
views are random.

    python -m research.film FOLDER OUT

FOLDER holds the YCB scans (NAME.ply, metres); OUT receives things.mp4 and things.gif.

The things are the six pairs of scans whose surfaces are most alike, see
``benchmark.confusable``, no thing twice: the rule is printed with its result. They stand at their
true size. What is shown are runs of ``nextview.load(models="ycb")``: depth frames through the
simulated wrist sensor, with the other things around, and candidate views only where no other thing
stands. When a thing is named, the outline of its scan is drawn where it was found. Light and shadow
are cast by Embree. The camera is drawn nearer to the thing than it stands. Scans have no colours:
those of the film tell the pairs apart, and nothing that recognises sees them. The seed was chosen
before any run. It is one run: what holds on average is in docs/results.md. Needs ``pip install
'./research[film]'``.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import fill

from research.extras import require

require("film")

import numpy as np
import tyro
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image, ImageDraw
from rich.progress import track
from scipy.spatial.transform import Rotation

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import look_at_origin
from nextview.simulation.sensed_camera import SensedCamera
from nextview.things.taught import TaughtThings
from nextview.viewers.card import differing, warm
from nextview_lab.benchmark.confusable import distances_between
from research.film_stage import (
    Array,
    Colour,
    Look,
    Shot,
    Stage,
    circle,
    font,
    outlined,
    rays_of,
    scene,
    shot,
    tag,
    toned,
)

PAIRS = 6
# belief in a name from which an episode ends, unless the thing may be unknown
SURE = 0.97
COLOURS = (
    (0.10, 0.42, 0.68),
    (0.78, 0.16, 0.10),
    (0.92, 0.70, 0.06),
    (0.30, 0.55, 0.20),
    (0.50, 0.53, 0.57),
    (0.85, 0.40, 0.10),
)
"""One a pair: what tells two things of a pair apart is their shape."""
PLAIN = (0.45, 0.48, 0.52)
TABLE = (0.50, 0.36, 0.24)
SPACING = 0.5  # metres between things
TABLE_RADIUS = 0.42  # metres, as of a thing: how wide the whole table is drawn
TABLE_MIDDLE = np.array([0.02, -0.05, -0.2])
# elevation and azimuth from which the whole table is drawn, degrees
OVER_THE_TABLE = (48.0, -90.0)
RIVAL_SIDE = 120  # pixels of the pictures of rivals
STEP = 0.5  # seconds a view is shown
PAUSE = 0.7  # seconds an answer is shown
SIZE = (960, 540)
VIEW = (480, 306)
RATE = 12
END = 2.2
PAPER = (250, 250, 248)
INK = (31, 41, 51)
GREY = (118, 128, 138)
FAINT = (228, 231, 234)
OURS = (11, 95, 165)
THEIRS = (128, 112, 100)
RIGHT = (38, 132, 78)
WRONG = (200, 58, 62)


# What happens


@dataclass(frozen=True)
class Cast:
    """The things of the film, in the order in which they are shown.

    Attributes:
        colours: of each, by name.
    """

    colours: dict[str, tuple[float, float, float]]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the things."""
        return tuple(self.colours)

    @classmethod
    def most_alike(cls, things: TaughtThings, rng: np.random.Generator) -> Cast:
        """The pairs of things whose surfaces are most alike, in an order that is drawn.

        Args:
            things: those of the memory.
            rng: draws the order.
        """
        apart = distances_between(things.verifier.caster.surfaces)
        pairs: list[tuple[str, str]] = []
        left = np.ones(len(apart), bool)
        while len(pairs) < PAIRS:
            some = np.where(left[:, None] & left, apart, np.inf)
            first, second = np.unravel_index(some.argmin(), some.shape)
            left[[first, second]] = False
            pairs.append((things.names[first], things.names[second]))
            print(
                f"{pairs[-1][0]} and {pairs[-1][1]}: {some[first, second]:.3f} radii apart"
            )
        colour = {name: COLOURS[k] for k, pair in enumerate(pairs) for name in pair}
        order = rng.permutation(sorted(colour)).tolist()
        return cls({name: colour[name] for name in order})


def laid_out(
    folder: Path,
    cast: Cast,
    rng: np.random.Generator,
) -> list[tuple[Mesh, Array]]:
    """The things, turned at random, and where their centres are, metres."""
    placed = []
    for k, name in enumerate(cast.names):
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        mesh = rotated(load_mesh(folder / f"{name}.ply", unit="m"), turn)
        column = k % 4 - 1.5 + 0.25 * (k // 4 % 2)
        x, y = SPACING * np.array([column, 1 - k // 4]) + rng.uniform(-0.05, 0.05, 2)
        placed.append(
            (mesh, np.array([x, y, -mesh.vertices[:, 2].min() * mesh.metres]))
        )
    return placed


@dataclass(frozen=True)
class Run:
    """What one policy made of one thing.

    Attributes:
        looks: the views.
        answer: the name.
        found: vertices, metres, table frame, and faces of the scan where it was found; None if no
            pose was found.
    """

    looks: list[Look]
    answer: str
    found: tuple[Array, Array] | None


def episode(system: nextview.System, placed: list, k: int, seed: int) -> Run:
    """One thing is looked at until it is named."""
    mesh, centre = placed[k]
    others = [
        ((m.vertices * m.metres + at - centre) / mesh.metres, m.faces)
        for m, at in placed
        if m is not mesh
    ]
    first = np.cumsum([0, *(len(v) for v, _ in others)])
    faces = np.concatenate([f + n for (_, f), n in zip(others, first, strict=False)])
    around = replace(mesh, vertices=np.concatenate([v for v, _ in others]), faces=faces)
    rng = np.random.default_rng([seed, k])
    camera = SensedCamera(mesh, "wrist", rng, around=around, table=40.0)
    session = system.session(seed=seed + k)
    stands = system.sphere.directions * camera.sensor.distance / camera.sensor.radius
    apart = (
        np.linalg.norm(stands[:, None] - around.vertices[::7], axis=2).min(1)
        * mesh.metres
    )
    session.reachable = (apart > 0.1) & (stands[:, 2] * mesh.metres + centre[2] > 0.04)

    looks = []
    while not session.done:
        view = session.update(camera.observe(session.pose))
        leading = [
            (system.classes[c], float(view.belief[c]))
            for c in np.argsort(-view.belief)[:3]
        ]
        outlook = None if session.done else session.outlook
        rivals = None
        names = ("", "")
        if outlook is not None:
            towards = system.sphere.directions[[view.next_view]]
            rivals = outlook.rivals(outlook.cameras(towards)[0], RIVAL_SIDE)
        if rivals is not None:
            names = tuple(
                outlook.caster.surfaces[thing].name for thing in rivals.things
            )
        seen = view.observation.picture
        values = view.values
        next_view = view.next_view
        looks.append(
            Look(
                view.direction,
                seen,
                leading,
                values,
                rivals,
                names,
                next_view,
                view.travel,
            )
        )
    return Run(looks, session.result.answer, found_at(session.result, camera, centre))


def found_at(
    result: nextview.Recognition,
    camera: SensedCamera,
    centre: Array,
) -> tuple[Array, Array] | None:
    """The scan of what was named, where it was found: vertices on the table, and faces."""
    if result.pose is None:
        return None
    best = next(each for each in result.pose_candidates if each.thing == result.pose_of)
    frame = camera.object_frame
    in_object = best.vertices @ result.pose[:3, :3].T + result.pose[:3, 3]
    return in_object @ frame.axes + frame.centre + centre, best.faces


# What is shown


def called(name: str) -> str:
    """A name as one says it: of the cups "cup H"."""
    letter, _, rest = name.partition("_")
    return (
        f"{rest.rstrip('s').replace('_', ' ')} {letter.upper()}"
        if len(letter) == 1
        else name.replace("_", " ")
    )


class Thumbs:
    """Small pictures of all things that are known, as they stand in their files."""

    def __init__(self, folder: Path, cast: Cast) -> None:
        self.folder = folder
        self.cast = cast
        self._made: dict[tuple[str, int], Image.Image] = {}

    def of(self, name: str, side: int) -> Image.Image:
        """A square of so many pixels."""
        if (name, side) not in self._made:
            mesh = load_mesh(self.folder / f"{name}.ply")
            pose = look_at_origin(np.radians(35), np.radians(35), 9.0)
            n = 3 * side
            rays = rays_of(pose, n / 2 / (1.12 / 9), n, n)
            stage = Stage(
                [(mesh.vertices, mesh.faces, self.cast.colours.get(name, PLAIN))]
            )
            hit, points, normals, colours = stage.hits(pose[:3, 3], rays)
            light = sum(
                stage.lit(points, normals, colours, np.random.default_rng(0), 3)
            )
            pixels = np.tile(np.array(PAPER, np.uint8), (len(rays), 1))
            pixels[hit] = toned(light)
            picture = Image.fromarray(pixels.reshape(n, n, 3))
            self._made[name, side] = picture.resize((side, side), Image.LANCZOS)
        return self._made[name, side]


@dataclass
class Side:
    """One half of the film: a policy, its runs by thing, and how it stands."""

    name: str
    line: str
    colour: Colour
    runs: dict[str, Run]
    done: tuple[str, ...] = ()

    def right(self, name: str) -> bool:
        """Whether a thing was named right."""
        return self.runs[name].answer == name

    @property
    def stands(self) -> tuple[int, int, float]:
        """How many it named right, after how many views and how much travel."""
        looks = [self.runs[name].looks for name in self.done]
        return (
            sum(map(self.right, self.done)),
            sum(map(len, looks)),
            sum(run[-1].travel for run in looks),
        )


def half(
    shot: Shot,
    side: Side,
    name: str,
    thumbs: Thumbs,
    at: int,
    progress: float,
    over: bool,
) -> Image.Image:
    """A policy's half of a frame, twice as large as it is shown."""
    run = side.runs[name]
    looks = run.looks
    page = Image.new("RGB", (SIZE[0], 2 * SIZE[1]), PAPER)
    draw = ImageDraw.Draw(page, "RGBA")
    picture = scene(shot, side.colour, looks, at, progress)
    if over:
        right = side.right(name)
        colour = RIGHT if right else WRONG
        if run.found is not None:
            outlined(picture, shot, *run.found, colour)
    page.paste(picture, (0, 92))
    if over:
        tag(
            draw,
            ("✓ " if right else "✗ ") + called(run.answer),
            (SIZE[0] // 2, 134),
            colour,
        )
    draw.text((28, 14), side.name, side.colour, font(34, True))
    draw.text((28, 56), side.line, GREY, font(22))
    count, views, _ = side.stands
    tally = f"{count} of {len(side.done)} right, {views} views" if side.done else ""
    draw.text((SIZE[0] - 28, 24), tally, INK, font(26), anchor="ra")
    known = looks[at if progress == 1 else at - 1]
    page.paste(
        Image.fromarray(known.picture).resize((150, 150), Image.LANCZOS),
        (SIZE[0] - 174, 532),
    )
    draw.rectangle((SIZE[0] - 177, 529, SIZE[0] - 22, 684), None, PAPER, 4)
    for k, (thing, belief) in enumerate(known.leading):
        bar(
            page,
            722 + 84 * k,
            thumbs.of(thing, 72),
            called(thing),
            belief,
            side.colour if k == 0 else GREY,
        )
    beside(page, side, name, known, over)
    for k, thing in enumerate(thumbs.cast.names):
        small = thumbs.of(thing, 64)
        x = 28 + 76 * k
        if thing not in (*side.done, name):
            small = Image.blend(small, Image.new("RGB", small.size, PAPER), 0.6)
        page.paste(small, (x, 996))
        if thing == name:
            draw.rectangle((x - 4, 992, x + 67, 1063), None, side.colour, 3)
        if thing in side.done:
            right = side.right(thing)
            circle(draw, np.array([x + 54, 1050]), 14, RIGHT if right else WRONG)
            draw.text(
                (x + 54, 1050),
                "✓" if right else "✗",
                (255, 255, 255),
                font(20, True),
                anchor="mm",
            )
    draw.line((0, 978, SIZE[0], 978), FAINT, 2)
    return page


def bar(
    page: Image.Image,
    y: int,
    small: Image.Image,
    name: str,
    share: float,
    colour: Colour,
) -> None:
    """How much a thing is believed in, below its name."""
    draw = ImageDraw.Draw(page)
    page.paste(small, (24, y))
    draw.text((108, y + 8), name, INK, font(24))
    draw.text((488, y + 8), f"{100 * share:.0f} %", INK, font(24), anchor="ra")
    draw.rounded_rectangle((108, y + 44, 488, y + 58), 7, FAINT)
    draw.rounded_rectangle((108, y + 44, 108 + max(14, 380 * share), y + 58), 7, colour)


def beside(page: Image.Image, side: Side, name: str, look: Look, over: bool) -> None:
    """Where it looks next and why; at the end, what it said."""
    draw = ImageDraw.Draw(page)
    x = 530
    right = side.right(name)
    views = len(side.runs[name].looks)
    if over:
        said = "right" if right else "wrong"
        draw.text((x, 760), said, RIGHT if right else WRONG, font(40, True))
        text = f"after {views} view{'s' if views > 1 else ''}"
        text += "" if right else f": it is the {called(name)}"
        draw.text((x, 818), text, GREY, font(24))
    if over or look.rivals is None or look.next_view is None:
        return

    why = (
        "next: where these two differ"
        if side.colour == OURS
        else "next: any view, at random"
    )
    if look.leading[0][1] >= SURE:
        why = "sure, but fits badly: once more"  # it may be none of the known things
    draw.text((x, 718), why, INK, font(24))
    pictures = [*map(warm, look.rivals.pictures), differing(look.rivals)]
    below = [*map(called, look.names), differ_in(look.rivals.share)]
    for k, (pixels, text) in enumerate(zip(pictures, below, strict=True)):
        left = x + 138 * k
        page.paste(
            Image.fromarray(pixels).resize((128, 128), Image.LANCZOS),
            (left, 758),
        )
        draw.rectangle((left, 758, left + 128, 886), None, FAINT, 2)
        colour = side.colour if k == 2 else GREY
        lines = fill(text, 13)
        middle = left + 64, 896
        draw.multiline_text(
            middle,
            lines,
            colour,
            font(20),
            anchor="ma",
            align="center",
        )


def differ_in(share: float) -> str:
    """In how much of the pixels two pictures differ."""
    return f"differ in {share:.0%}" if share >= 0.005 else "differ in < 1%"


def pages(
    stage: Stage,
    placed: list,
    sides: tuple[Side, Side],
    thumbs: Thumbs,
) -> Iterator[Image.Image]:
    """The frames, twice as large as they are shown."""
    for k, name in enumerate(thumbs.cast.names):
        still = shot(
            stage,
            placed[k][0].metres,
            placed[k][1],
            (2 * VIEW[0], 2 * VIEW[1]),
        )
        most = max(len(side.runs[name].looks) for side in sides)
        seconds = STEP * most + PAUSE
        drawn: dict[tuple, Image.Image] = {}
        for frame in range(round(seconds * RATE)):
            page = Image.new("RGB", (2 * SIZE[0], 2 * SIZE[1]), FAINT)
            for n, side in enumerate(sides):
                last = len(side.runs[name].looks) - 1
                time = frame / RATE / STEP
                at = min(int(time), last)
                done = min((time - at) / 0.5, 1) if at else 1.0
                over = time >= last + 0.6
                if over and name not in side.done:
                    side.done = (*side.done, name)
                state = n, at, round(0.5 - 0.5 * np.cos(np.pi * done), 3), over
                if state not in drawn:
                    drawn[state] = half(still, side, name, thumbs, *state[1:])
                page.paste(
                    drawn[state].crop((0, 0, SIZE[0] - 2, 2 * SIZE[1])),
                    (n * (SIZE[0] + 2), 0),
                )
            yield page
    yield from [closing(stage, placed, sides, thumbs.cast)] * round(END * RATE)


def closing(
    stage: Stage,
    placed: list,
    sides: tuple[Side, Side],
    cast: Cast,
) -> Image.Image:
    """The whole table with what was found of each thing, and how both did."""
    wide = shot(
        stage,
        TABLE_RADIUS,
        TABLE_MIDDLE,
        (2 * VIEW[0], 2 * VIEW[1]),
        OVER_THE_TABLE,
    )
    page = Image.new("RGB", (2 * SIZE[0], 2 * SIZE[1]), FAINT)
    for n, side in enumerate(sides):
        half = Image.new("RGB", (SIZE[0] - 2, 2 * SIZE[1]), PAPER)
        half.paste(found_on(wide, placed, side, cast), (0, 92))
        draw = ImageDraw.Draw(half)
        draw.text((28, 14), side.name, side.colour, font(34, True))
        draw.text((28, 56), side.line, GREY, font(22))
        right, views, travel = side.stands
        said = f"{right} of {len(cast.names)} right"
        draw.text((SIZE[0] // 2, 790), said, INK, font(64, True), anchor="mm")
        said = f"{views} views, {travel:.0f} cells of travel"
        draw.text((SIZE[0] // 2, 875), said, INK, font(34), anchor="mm")
        page.paste(half, (n * (SIZE[0] + 2), 0))

    draw = ImageDraw.Draw(page)
    said = "One run. Twelve of 78 things known from scans, by depth alone, simulated camera."
    draw.rectangle((0, 978, 2 * SIZE[0], 2 * SIZE[1]), PAPER)
    draw.line((0, 978, 2 * SIZE[0], 978), FAINT, 2)
    draw.text((SIZE[0], 1030), said, GREY, font(28), anchor="mm")
    return page


def found_on(wide: Shot, placed: list, side: Side, cast: Cast) -> Image.Image:
    """The whole table: the outline of each thing where it was found, and its name."""
    picture = Image.fromarray(toned(wide.sky + wide.lamp))
    for name in cast.names:
        found = side.runs[name].found
        if found is not None:
            outlined(picture, wide, *found, RIGHT if side.right(name) else WRONG)
    draw = ImageDraw.Draw(picture)
    for (mesh, at), name in zip(placed, cast.names, strict=True):
        flat = wide.place(mesh.vertices * mesh.metres + at)[0]
        text = called(side.runs[name].answer)
        reach = draw.textlength(text, font(22, True)) / 2 + 8
        middle = (flat[:, 0].min() + flat[:, 0].max()) / 2
        middle = min(max(middle, reach), picture.width - reach)
        colour = RIGHT if side.right(name) else WRONG
        edge = {"stroke_width": 4, "stroke_fill": PAPER}
        below = middle, flat[:, 1].max() + 20
        draw.text(below, text, colour, font(22, True), anchor="mm", **edge)
    return picture


def main(
    folder: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    seed: int = 7,
    drawn: bool = True,
) -> None:
    """Run the episodes and write the film.

    Args:
        folder: of the scans.
        out: folder for the film.
        seed: of where the things stand, of the views and of the sensor's errors.
        drawn: draw the film; with ``--no-drawn`` only how the runs ended is printed.
    """
    rng = np.random.default_rng(seed)
    ours, theirs = (
        nextview.load(models="ycb", policy=name, threads=1)
        for name in (None, "random-all")
    )
    cast = Cast.most_alike(ours.models.recogniser.things, rng)
    placed = laid_out(folder, cast, rng)
    sides = (
        Side("nextview", "looks where the things it believes in differ", OURS, {}),
        Side("random views", "looks anywhere", THEIRS, {}),
    )
    for side, system in zip(sides, (ours, theirs), strict=True):
        for k, name in enumerate(track(cast.names, side.name)):
            side.runs[name] = episode(system, placed, k, seed)
        right = sum(map(side.right, cast.names))
        views = sum(len(run.looks) for run in side.runs.values())
        print(f"{side.name}: {right} of {len(cast.names)} right after {views} views")
    if drawn:
        out.mkdir(parents=True, exist_ok=True)
        stage = on_the_table(placed, cast)
        written(pages(stage, placed, sides, Thumbs(folder, cast)), out)


def on_the_table(placed: list, cast: Cast) -> Stage:
    """The things where they stand, in their colours, and the table."""
    things = [
        (m.vertices * m.metres + at, m.faces, colour)
        for (m, at), colour in zip(placed, cast.colours.values(), strict=True)
    ]
    corners = 30 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Stage([*things, (corners, np.array([[0, 1, 2], [0, 2, 3]]), TABLE)])


def written(drawn: Iterable[Image.Image], out: Path) -> None:
    """Write the frames as a video and as a GIF."""
    with TemporaryDirectory() as part:
        for n, page in enumerate(track(drawn, "frames")):
            page.resize(SIZE, Image.LANCZOS).save(
                f"{part}/{n:04}.png",
                compress_level=1,
            )
        read = [
            "-y",
            "-loglevel",
            "error",
            "-framerate",
            str(RATE),
            "-i",
            f"{part}/%04d.png",
        ]
        start = [get_ffmpeg_exe(), *read]
        h264 = ["-c:v", "libx264", "-crf", "20", "-preset", "slow"]
        h264 += ["-pix_fmt", "yuv420p", "-movflags", "+faststart"]
        subprocess.run([*start, *h264, str(out / "things.mp4")], check=True)
        use = "paletteuse=dither=sierra2_4a:diff_mode=rectangle"
        palette = f"split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]{use}"
        subprocess.run(
            [*start, "-filter_complex", palette, str(out / "things.gif")],
            check=True,
        )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
