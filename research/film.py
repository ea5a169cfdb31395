"""A film: twelve household things on a table, told apart by a wrist camera, beside one whose next
views are random.

    python -m research.film FOLDER OUT      # FOLDER: the YCB scans (NAME.ply, metres); OUT:
    things.mp4, things.gif

What is shown are runs of ``nextview.load(models="ycb")``: depth frames through the simulated wrist
sensor, with the other things around, and candidate views only where no other thing stands. Light
and shadow are cast by Embree. The camera is drawn nearer to the thing than it stands. Scans have no
colours: those of the film are given here, and nothing that recognises sees them. The seed was
chosen before any run. It is one run: what holds on average is in docs/your_objects.md. Needs ``pip
install './research[film]'``.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from research.extras import require

require("film")

import numpy as np
import tyro
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import azimuth_of, look_at_origin
from nextview.policies.base import EpisodeState
from nextview.policies.discriminate import Discriminate
from nextview.recognition.model_card import find_models
from nextview.simulation.sensed_camera import SensedCamera
from nextview.things.memory import AZIMUTHS, RINGS, Memory, open_memory
from research.film_stage import (
    Array,
    Colour,
    Look,
    Shot,
    Stage,
    circle,
    font,
    rays_of,
    scene,
    shot,
    tag,
    toned,
)

THINGS = {
    "h_cups": ((0.10, 0.42, 0.68), 0.9),
    "phillips_screwdriver": ((0.78, 0.10, 0.07), 0.9),
    "baseball": ((0.86, 0.83, 0.76), 0.9),
    "adjustable_wrench": ((0.34, 0.37, 0.42), 1.9),
    "scissors": ((0.85, 0.32, 0.04), 1.7),
    "peach": ((0.90, 0.42, 0.20), 0.9),
    "spoon": ((0.50, 0.53, 0.57), 4.0),
    "knife": ((0.50, 0.53, 0.57), 0.9),
    "lemon": ((0.92, 0.76, 0.06), 0.9),
    "strawberry": ((0.74, 0.05, 0.06), 0.9),
    "pudding_box": ((0.40, 0.18, 0.08), 1.9),
    "apple": ((0.52, 0.66, 0.10), 1.9),
}
"""Of each kind the thing that the memory's own held-out views tell apart worst but rightly, toys
left out; its colour, and for how many seconds it is shown."""
SHOWN = (
    "spoon",
    "scissors",
    "pudding_box",
    "apple",
    "adjustable_wrench",
    "knife",
    "peach",
    "phillips_screwdriver",
    "strawberry",
    "lemon",
    "baseball",
    "h_cups",
)
"""The order of the film; what happens does not depend on it."""
OTHERS = {
    "fork": (0.50, 0.53, 0.57),
    "tennis_ball": (0.66, 0.78, 0.10),
    "orange": (0.92, 0.40, 0.03),
    "plum": (0.24, 0.05, 0.16),
    "flat_screwdriver": (0.10, 0.30, 0.66),
    "gelatin_box": (0.78, 0.12, 0.22),
    "i_cups": (0.86, 0.62, 0.08),
    "j_cups": (0.78, 0.16, 0.10),
    "g_cups": (0.18, 0.55, 0.25),
    "large_clamp": (0.10, 0.10, 0.11),
}
"""Colours of things that are not on the table."""
PLAIN = (0.45, 0.48, 0.52)
TABLE = (0.50, 0.36, 0.24)
SPACING = 0.5
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


class Watched:
    """A policy, and the joint belief when it chose last."""

    def __init__(self, policy: nextview.Policy) -> None:
        self.policy = policy
        self.needs = tuple({*policy.needs, "joint"})
        self.joint = None

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Array:
        """See ``Policy.next_views``."""
        self.joint = state.joint[0]
        return self.policy.next_views(state, rng)

    def view_values(self, state: EpisodeState) -> Array:
        """See ``ValuesViews``; NaN where the policy values nothing."""
        known = hasattr(self.policy, "view_values")
        return self.policy.view_values(state) if known else np.full(state.visited.shape, np.nan)


def laid_out(folder: Path, rng: np.random.Generator) -> list[tuple[Mesh, Array]]:
    """The things, turned at random, and where their centres are, metres."""
    placed = []
    for k, name in enumerate(THINGS):
        mesh = rotated(
            load_mesh(folder / f"{name}.ply", unit="m"),
            Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix(),
        )
        x, y = SPACING * np.array([k % 4 - 1.5 + 0.25 * (k // 4 % 2), 1 - k // 4]) + rng.uniform(
            -0.05, 0.05, 2
        )
        placed.append((mesh, np.array([x, y, -mesh.vertices[:, 2].min() * mesh.metres])))
    return placed


def episode(
    system: nextview.System, judge: Discriminate, placed: list, k: int, seed: int
) -> tuple[list[Look], str]:
    """One thing is looked at until it is named; the looks, and the name."""
    mesh, centre = placed[k]
    others = [
        ((m.vertices * m.metres + at - centre) / mesh.metres, m.faces)
        for m, at in placed
        if m is not mesh
    ]
    first = np.cumsum([0, *(len(v) for v, _ in others)])
    faces = np.concatenate([f + n for (_, f), n in zip(others, first, strict=False)])
    around = replace(mesh, vertices=np.concatenate([v for v, _ in others]), faces=faces)
    camera = SensedCamera(
        mesh, "wrist", np.random.default_rng([seed, k]), around=around, table=40.0
    )
    watched = Watched(system.policy)
    looks = []
    session = replace(system, policy=watched).session(seed=seed + k)
    stands = system.sphere.directions * camera.sensor.distance / camera.sensor.radius
    apart = np.linalg.norm(stands[:, None] - around.vertices[::7], axis=2).min(1) * mesh.metres
    session.reachable = (apart > 0.1) & (stands[:, 2] * mesh.metres + centre[2] > 0.04)
    while not session.done:
        view = session.update(camera.observe(session.pose))
        leading = [(system.classes[c], float(view.belief[c])) for c in np.argsort(-view.belief)[:3]]
        rivals = (
            None
            if session.done
            else judge.rivals(watched.joint, float(azimuth_of(view.direction[None])[0]))
        )
        seen = view.observation.picture
        looks.append(
            Look(view.direction, seen, leading, view.values, rivals, view.next_view, view.travel)
        )
    return looks, session.result.answer


# What is shown


def called(name: str) -> str:
    """A name as one says it: of the cups "cup H"."""
    letter, _, rest = name.partition("_")
    return f"{rest.rstrip('s')} {letter.upper()}" if len(letter) == 1 else name.replace("_", " ")


class Thumbs:
    """Small pictures of all things that are known, as they stand or as they are remembered from
    a view.
    """

    def __init__(self, folder: Path, memory: Memory, names: tuple[str, ...]) -> None:
        self.folder = folder
        self.memory = memory
        self.names = names
        self._made = {}

    def of(
        self, name: str, side: int, hypothesis: int = -1, elevation: float = 35, azimuth: float = 35
    ) -> Image.Image:
        """A square; ``hypothesis`` is a resting pose, -1 the first, seen from some angles,
        degrees.
        """
        key = name, side, hypothesis, elevation, azimuth
        if key not in self._made:
            mesh = load_mesh(self.folder / f"{name}.ply")
            if hypothesis >= 0:
                mesh = rotated(mesh, self.memory.rotations[hypothesis].astype(float))
            colour = THINGS[name][0] if name in THINGS else OTHERS.get(name, PLAIN)
            pose = look_at_origin(np.radians(elevation), np.radians(azimuth), 9.0)
            n = 3 * side
            rays = rays_of(pose, n / 2 / (1.12 / 9), n, n)
            stage = Stage([(mesh.vertices, mesh.faces, colour)])
            hit, points, normals, colours = stage.hits(pose[:3, 3], rays)
            light = sum(stage.lit(points, normals, colours, np.random.default_rng(0), 3))
            pixels = np.tile(np.array(PAPER, np.uint8), (len(rays), 1))
            pixels[hit] = toned(light)
            self._made[key] = Image.fromarray(pixels.reshape(n, n, 3)).resize(
                (side, side), Image.LANCZOS
            )
        return self._made[key]


@dataclass
class Side:
    """One half of the film: a policy, its runs by thing, and how it stands."""

    name: str
    line: str
    colour: Colour
    runs: dict[str, tuple[list[Look], str]]
    done: tuple[str, ...] = ()

    def right(self, name: str) -> bool:
        """Whether a thing was named right."""
        return self.runs[name][1] == name

    @property
    def stands(self) -> tuple[int, int, float]:
        """How many it named right, after how many views and how much travel."""
        looks = [self.runs[name][0] for name in self.done]
        return (
            sum(map(self.right, self.done)),
            sum(map(len, looks)),
            sum(run[-1].travel for run in looks),
        )


def half(
    shot: Shot, side: Side, name: str, thumbs: Thumbs, at: int, progress: float, over: bool
) -> Image.Image:
    """A policy's half of a frame, twice as large as it is shown."""
    looks, answer = side.runs[name]
    page = Image.new("RGB", (SIZE[0], 2 * SIZE[1]), PAPER)
    draw = ImageDraw.Draw(page, "RGBA")
    page.paste(scene(shot, side.colour, looks, at, progress), (0, 92))
    if over:
        right = side.right(name)
        tag(
            draw,
            ("✓ " if right else "✗ ") + called(answer),
            (SIZE[0] // 2, 134),
            RIGHT if right else WRONG,
        )
    draw.text((28, 14), side.name, side.colour, font(34, True))
    draw.text((28, 56), side.line, GREY, font(22))
    count, views, _ = side.stands
    tally = f"{count} of {len(side.done)} right, {views} views" if side.done else ""
    draw.text((SIZE[0] - 28, 24), tally, INK, font(26), anchor="ra")
    known = looks[at if progress == 1 else at - 1]
    page.paste(
        Image.fromarray(known.picture).resize((150, 150), Image.LANCZOS), (SIZE[0] - 174, 532)
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
    beside(page, side, name, known, thumbs, over)
    for k, thing in enumerate(SHOWN):
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
                (x + 54, 1050), "✓" if right else "✗", (255, 255, 255), font(20, True), anchor="mm"
            )
    draw.line((0, 978, SIZE[0], 978), FAINT, 2)
    return page


def bar(
    page: Image.Image, y: int, small: Image.Image, name: str, share: float, colour: Colour
) -> None:
    draw = ImageDraw.Draw(page)
    page.paste(small, (24, y))
    draw.text((108, y + 8), name, INK, font(24))
    draw.text((508, y + 8), f"{100 * share:.0f} %", INK, font(24), anchor="ra")
    draw.rounded_rectangle((108, y + 44, 508, y + 58), 7, FAINT)
    draw.rounded_rectangle((108, y + 44, 108 + max(14, 400 * share), y + 58), 7, colour)


def beside(
    page: Image.Image, side: Side, name: str, look: Look, thumbs: Thumbs, over: bool
) -> None:
    """Where it looks next and why; at the end, what it said."""
    draw = ImageDraw.Draw(page)
    x = 560
    right = side.right(name)
    views = len(side.runs[name][0])
    if over:
        draw.text(
            (x, 760), "right" if right else "wrong", RIGHT if right else WRONG, font(40, True)
        )
        text = f"after {views} view{'s' if views > 1 else ''}" + (
            "" if right else f": it is the {called(name)}"
        )
        draw.text((x, 818), text, GREY, font(24))
    if over or look.rivals is None or look.next_view is None:
        return
    both = look.rivals
    view = look.next_view
    why = "next: where these two differ" if side.colour == OURS else "next: any view, at random"
    draw.text((x, 722), why, INK, font(20))
    for k in range(2):
        angle = 360 / AZIMUTHS * both.azimuths[k, view]
        left = x + 172 * k
        small = thumbs.of(
            thumbs.names[both.classes[k]],
            148,
            int(both.hypotheses[k]),
            RINGS[both.rings[view]],
            angle,
        )
        page.paste(small, (left, 754))
        draw.rectangle((left, 754, left + 148, 902), None, FAINT, 2)
        draw.text(
            (left + 74, 920), called(thumbs.names[both.classes[k]]), GREY, font(20), anchor="mm"
        )
    draw.text(
        (x + 160, 952), f"likeness {both.alike[view]:.2f}", side.colour, font(22, True), anchor="mm"
    )


def pages(
    stage: Stage, placed: list, sides: tuple[Side, Side], thumbs: Thumbs
) -> Iterator[Image.Image]:
    """The frames, twice as large as they are shown."""
    for name in SHOWN:
        k = list(THINGS).index(name)
        seconds = THINGS[name][1]
        still = shot(stage, placed[k][0].metres, placed[k][1], (2 * VIEW[0], 2 * VIEW[1]))
        step = (seconds - 0.35 * min(1, seconds)) / max(len(side.runs[name][0]) for side in sides)
        drawn: dict[tuple, Image.Image] = {}
        for frame in range(round(seconds * RATE)):
            page = Image.new("RGB", (2 * SIZE[0], 2 * SIZE[1]), FAINT)
            for n, side in enumerate(sides):
                last = len(side.runs[name][0]) - 1
                time = frame / RATE / step
                at = min(int(time), last)
                done = min((time - at) / 0.5, 1) if at else 1.0
                over = time >= last + 0.6
                if over and name not in side.done:
                    side.done = (*side.done, name)
                state = n, at, round(0.5 - 0.5 * np.cos(np.pi * done), 3), over
                if state not in drawn:
                    drawn[state] = half(still, side, name, thumbs, *state[1:])
                page.paste(
                    drawn[state].crop((0, 0, SIZE[0] - 2, 2 * SIZE[1])), (n * (SIZE[0] + 2), 0)
                )
            yield page
    card = Image.blend(page, Image.new("RGB", page.size, PAPER), 0.94)
    draw = ImageDraw.Draw(card)
    for n, side in enumerate(sides):
        middle, (right, views, travel) = SIZE[0] * n + SIZE[0] // 2, side.stands
        draw.text((middle, 360), side.name, side.colour, font(52, True), anchor="mm")
        draw.text((middle, 470), f"{right} of {len(SHOWN)} right", INK, font(64, True), anchor="mm")
        draw.text(
            (middle, 560),
            f"{views} views, {travel:.0f} cells of travel",
            INK,
            font(38),
            anchor="mm",
        )
    said = "12 of 78 things known from scans, by depth alone, through a simulated wrist camera"
    draw.text((SIZE[0], 700), said, GREY, font(32), anchor="mm")
    yield from [card] * round(END * RATE)


def main(
    folder: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], seed: int = 7
) -> None:
    """Run the episodes and write the film."""
    placed = laid_out(folder, np.random.default_rng(seed))
    ours, theirs = (
        nextview.load(models="ycb", policy=name, threads=1) for name in (None, "random-all")
    )
    runs = [
        {name: episode(s, ours.policy, placed, k, seed) for k, name in enumerate(THINGS)}
        for s in (ours, theirs)
    ]
    _, memory = open_memory(find_models("ycb").recogniser)
    thumbs = Thumbs(folder, memory, ours.classes)
    sides = (
        Side("nextview", "looks where the things it believes in differ", OURS, runs[0]),
        Side("random views", "looks anywhere", THEIRS, runs[1]),
    )
    things = [
        (m.vertices * m.metres + at, m.faces, c)
        for (m, at), (c, _) in zip(placed, THINGS.values(), strict=True)
    ]
    ground = (
        30 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    stage = Stage([*things, (*ground, TABLE)])
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as part:
        for n, page in enumerate(pages(stage, placed, sides, thumbs)):
            page.resize(SIZE, Image.LANCZOS).save(f"{part}/{n:04}.png", compress_level=1)
        start = [
            get_ffmpeg_exe(),
            "-y",
            "-loglevel",
            "error",
            "-framerate",
            str(RATE),
            "-i",
            f"{part}/%04d.png",
        ]
        h264 = [
            "-c:v",
            "libx264",
            "-crf",
            "20",
            "-preset",
            "slow",
            "-pix_fmt",
            "yuv420p",
            "-movflags",
            "+faststart",
        ]
        subprocess.run([*start, *h264, str(out / "things.mp4")], check=True)
        use = "paletteuse=dither=sierra2_4a:diff_mode=rectangle"
        palette = f"split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]{use}"
        subprocess.run([*start, "-filter_complex", palette, str(out / "things.gif")], check=True)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
