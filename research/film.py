"""A film: twelve household things on a table, told apart by a wrist camera, beside one whose next views are random.

    python -m research.film FOLDER OUT [--seed 7]        # FOLDER: the YCB scans (NAME.ply, metres); OUT: things.mp4 and things.gif

What is shown are runs of ``nextview.load(models="ycb")``: depth frames through the simulated wrist sensor, with the
other things around, and candidate views only where no other thing stands. Light and shadow are cast by Embree. The
camera is drawn nearer to the thing than it stands. Scans have no colours: those of the film are given here, and nothing
that recognises sees them. Needs ``pip install imageio-ffmpeg``.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
import tyro
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

import nextview
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import LAYOUTS, azimuth_of, great_circle, level_pose, look_at_origin
from nextview.policies.discriminate import Discriminate, Rivals
from nextview.recognition.memory import AZIMUTHS, RINGS, Memory, read_memory
from nextview.recognition.model_card import find_models, read_card
from nextview.session.style import heat
from nextview.simulation.sensed_camera import SensedCamera
from research.film_stage import KEY, Shot, Stage, rays_of, shot, toned, unit

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
"""Of each kind the thing that the memory's own held-out views tell apart worst but rightly, toys left out: its colour, and
for how many seconds it is shown."""
SHOWN = ("spoon", "scissors", "pudding_box", "apple", "adjustable_wrench", "knife", "peach", "phillips_screwdriver", "strawberry",
         "lemon", "baseball", "h_cups")  # fmt: skip
"""The order of the film; what happens does not depend on it."""
OTHERS = {
    "fork": (0.50, 0.53, 0.57), "tennis_ball": (0.66, 0.78, 0.10), "orange": (0.92, 0.40, 0.03), "plum": (0.24, 0.05, 0.16),
    "flat_screwdriver": (0.10, 0.30, 0.66), "gelatin_box": (0.78, 0.12, 0.22), "i_cups": (0.86, 0.62, 0.08),
    "j_cups": (0.78, 0.16, 0.10), "g_cups": (0.18, 0.55, 0.25), "large_clamp": (0.10, 0.10, 0.11),
}  # fmt: skip
"""Colours of things that are not on the table."""
PLAIN, TABLE = (0.45, 0.48, 0.52), (0.50, 0.36, 0.24)
SPACING = 0.5
SIZE, VIEW, RATE, END = (960, 540), (480, 306), 12, 2.2
REACH = 2.0
"""Object radii from which the camera is drawn."""
PAPER, INK, GREY, FAINT = (250, 250, 248), (31, 41, 51), (118, 128, 138), (228, 231, 234)
OURS, THEIRS, RIGHT, WRONG = (11, 95, 165), (128, 112, 100), (38, 132, 78), (200, 58, 62)
Array = np.ndarray


# What happens


@dataclass(frozen=True)
class Look:
    """A view and what followed: the leading classes with their belief, what views are worth, and the leading two."""

    direction: Array
    picture: Array
    leading: list[tuple[str, float]]
    values: Array | None
    rivals: Rivals | None
    next_view: int | None
    travel: float


class Watched:
    """A policy, and the joint belief when it chose last."""

    def __init__(self, policy: nextview.Policy) -> None:
        self.policy, self.needs, self.joint = policy, tuple({*policy.needs, "joint"}), None

    def next_views(self, state, rng):
        self.joint = state.joint[0]
        return self.policy.next_views(state, rng)

    def view_values(self, state):
        known = hasattr(self.policy, "view_values")
        return self.policy.view_values(state) if known else np.full(state.visited.shape, np.nan)


def laid_out(folder: Path, rng: np.random.Generator) -> list[tuple[Mesh, Array]]:
    """The things, turned at random, and where their centres are, metres."""
    placed = []
    for k, name in enumerate(THINGS):
        mesh = rotated(load_mesh(folder / f"{name}.ply", unit="m"), about_z(rng.uniform(0, 2 * np.pi)))
        x, y = SPACING * np.array([k % 4 - 1.5 + 0.25 * (k // 4 % 2), 1 - k // 4]) + rng.uniform(-0.05, 0.05, 2)
        placed.append((mesh, np.array([x, y, -mesh.vertices[:, 2].min() * mesh.metres])))
    return placed


def about_z(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def episode(system: nextview.System, judge: Discriminate, placed: list, k: int, seed: int) -> tuple[list[Look], str]:
    """One thing is looked at until it is named; the looks, and the name."""
    mesh, centre = placed[k]
    others = [((m.vertices * m.metres + at - centre) / mesh.metres, m.faces) for m, at in placed if m is not mesh]
    first = np.cumsum([0, *(len(v) for v, _ in others)])
    faces = np.concatenate([f + n for (_, f), n in zip(others, first, strict=False)])
    around = replace(mesh, vertices=np.concatenate([v for v, _ in others]), faces=faces)
    camera = SensedCamera(mesh, "wrist", np.random.default_rng([seed, k]), around=around, table=40.0)
    watched, looks = Watched(system.policy), []
    session = replace(system, policy=watched).session(seed=seed + k)
    stands = system.sphere.directions * camera.sensor.distance / camera.sensor.radius
    apart = np.linalg.norm(stands[:, None] - around.vertices[::7], axis=2).min(1) * mesh.metres
    session.reachable = (apart > 0.1) & (stands[:, 2] * mesh.metres + centre[2] > 0.04)
    while not session.done:
        view = session.update(camera.observe(session.pose))
        leading = [(system.classes[c], float(view.belief[c])) for c in np.argsort(-view.belief)[:3]]
        rivals = None if session.done else judge.rivals(watched.joint, float(azimuth_of(view.direction[None])[0]))
        seen = view.observation.picture
        looks.append(Look(view.direction, seen, leading, view.values, rivals, view.next_view, view.travel))
    return looks, session.result.answer


# What is shown


@cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    weight = "bold" if bold else "normal"
    return ImageFont.truetype(font_manager.findfont(font_manager.FontProperties("DejaVu Sans", weight=weight)), size)


def called(name: str) -> str:
    """A name as one says it: of the cups "cup H"."""
    letter, _, rest = name.partition("_")
    return f"{rest.rstrip('s')} {letter.upper()}" if len(letter) == 1 else name.replace("_", " ")


class Thumbs:
    """Small pictures of all things that are known, as they stand or as they are remembered from a view."""

    def __init__(self, folder: Path, memory: Memory, names: tuple[str, ...]) -> None:
        self.folder, self.memory, self.names, self._made = folder, memory, names, {}

    def of(
        self, name: str, side: int, hypothesis: int | None = None, elevation: float = 35, azimuth: float = 35
    ) -> Image.Image:
        key = name, side, hypothesis, elevation, azimuth
        if key not in self._made:
            mesh = load_mesh(self.folder / f"{name}.ply")
            if hypothesis is not None:
                mesh = rotated(mesh, self.memory.rotations[hypothesis].astype(float))
            colour = THINGS[name][0] if name in THINGS else OTHERS.get(name, PLAIN)
            pose, n = look_at_origin(np.radians(elevation), np.radians(azimuth), 9.0), 3 * side
            rays = rays_of(pose, n / 2 / (1.12 / 9), n, n)
            stage = Stage([(mesh.vertices, mesh.faces, colour)])
            hit, points, normals, colours = stage.hits(pose[:3, 3], rays)
            light = sum(stage.lit(points, normals, colours, np.random.default_rng(0), 3))
            pixels = np.tile(np.array(PAPER, np.uint8), (len(rays), 1))
            pixels[hit] = toned(light)
            self._made[key] = Image.fromarray(pixels.reshape(n, n, 3)).resize((side, side), Image.LANCZOS)
        return self._made[key]


def gadget() -> tuple[Array, Array]:
    """A camera at the end of a wrist, looking along z; one is its distance from a thing's middle to its surface."""
    box, lens = trimesh.creation.box((0.62, 0.26, 0.22)), trimesh.creation.cylinder(0.11, 0.14, 40)
    lens.apply_translation((0.14, 0, 0.17))
    second = lens.copy()
    second.apply_translation((-0.30, 0, 0))
    wrist = trimesh.creation.cylinder(0.15, 0.5, 40)
    wrist.apply_translation((0, 0, -0.36))
    parts = trimesh.util.concatenate([box, lens, second, wrist])
    return np.array(parts.vertices), np.array(parts.faces, np.int32)


@dataclass
class Side:
    """One half of the film: a policy, its runs by thing, and how it stands."""

    name: str
    line: str
    colour: tuple[int, int, int]
    runs: dict[str, tuple[list[Look], str]]
    done: tuple[str, ...] = ()

    def right(self, name: str) -> bool:
        return self.runs[name][1] == name

    @property
    def stands(self) -> tuple[int, int, float]:
        """How many it named right, after how many views and how much travel."""
        looks = [self.runs[name][0] for name in self.done]
        return sum(map(self.right, self.done)), sum(map(len, looks)), sum(run[-1].travel for run in looks)


def scene(shot: Shot, side: Side, looks: list[Look], at: int, progress: float) -> Image.Image:
    """The table: what views are worth, the way so far, and the camera on its way to look ``at``."""
    look, before = looks[at], looks[max(at - 1, 0)]
    way = great_circle(before.direction, look.direction, 25)
    here = way[round(24 * progress)]
    pose = level_pose(here, REACH)
    vertices, faces = gadget()
    hand = Stage(
        [((0.36 * vertices @ pose[:3, :3].T + pose[:3, 3]) * shot.radius + shot.centre, faces, (0.05, 0.055, 0.065))]
    )
    middle = pose[:3, 3] * shot.radius + shot.centre
    to_lamp = KEY / np.linalg.norm(KEY)
    off = middle - np.where(np.isfinite(shot.points), shot.points, 1e3)
    near = np.linalg.norm(off - (off @ to_lamp)[..., None] * to_lamp, axis=2) < 0.5 * shot.radius
    lamp = shot.lamp.copy()
    rng = np.random.default_rng(0)
    jitter = 0.09 * rng.normal(size=(6, 1, 3))
    lamp[near] *= 1 - hand.blocked(shot.points[near] + 1e-4, KEY + jitter).mean(0)[:, None]
    picture = Image.fromarray(toned(shot.sky + lamp))
    draw = ImageDraw.Draw(picture, "RGBA")
    if before.values is not None or at:
        dots(draw, shot, before if progress < 1 else look, side)
    stood = [great_circle(a.direction, b.direction) for a, b in zip(looks[:at], looks[1:at], strict=False)]
    path = np.concatenate([*stood, way[: round(24 * progress) + 1]])[::2] * REACH * shot.radius + shot.centre
    draw.line([tuple(p) for p in shot.place(path)[0]], (*side.colour, 230), 5, "curve")
    for past in looks[: at + (progress == 1)]:
        circle(
            draw, shot.place((past.direction * REACH * shot.radius + shot.centre)[None])[0][0], 8, (*side.colour, 255)
        )
    if progress == 1:
        corners = [middle, *(shot.centre + 0.8 * shot.radius * (pose[:3, 0] * x + pose[:3, 1] * y) for x, y in SQUARE)]
        flat = [tuple(p) for p in shot.place(np.array(corners))[0]]
        for a, b in zip(flat[1:], [*flat[2:], flat[1]], strict=True):
            draw.polygon([flat[0], a, b], (*side.colour, 26))
        draw.line([*flat[1:], flat[1]], (*side.colour, 150), 2)
    pasted(picture, shot, hand, middle)
    return picture


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def dots(draw: ImageDraw.ImageDraw, shot: Shot, look: Look, side: Side) -> None:
    """The candidate views, in the colours of what they are worth; those behind the thing faint."""
    places = LAYOUTS["40"].directions * REACH * shot.radius + shot.centre
    flat, depth = shot.place(places)
    known = look.values is not None and np.isfinite(look.values).any()
    colours = heat(look.values) if known else np.full((len(places), 3), 150)
    back = np.linalg.norm(shot.pose[:3, 3] - shot.centre)
    for k in np.argsort(-depth):
        if look.next_view is not None and places[k, 2] > 0:
            faint = 235 if depth[k] < back else 110
            circle(draw, flat[k], 13 if k == look.next_view else 7, (*map(int, colours[k]), faint))
            if k == look.next_view:
                circle(draw, flat[k], 15, None, (*side.colour, 255), 4)


def circle(
    draw: ImageDraw.ImageDraw, at: Array, r: float, fill: tuple | None, outline: tuple | None = None, width: int = 1
) -> None:
    draw.ellipse((at[0] - r, at[1] - r, at[0] + r, at[1] + r), fill, outline, width)


def pasted(picture: Image.Image, shot: Shot, hand: Stage, middle: Array) -> None:
    """Draw the camera where nothing stands before it."""
    (x, y), reach = (
        shot.place(middle[None])[0][0],
        int(0.4 * shot.radius * shot.focal / np.linalg.norm(shot.pose[:3, 3] - middle)),
    )
    width, height = picture.size
    x0, x1, y0, y1 = (
        int(np.clip(v, 0, m))
        for v, m in ((x - reach, width), (x + reach, width), (y - reach, height), (y + reach, height))
    )
    if x0 >= x1 or y0 >= y1:
        return
    rays = rays_of(shot.pose, shot.focal, width, height).reshape(height, width, 3)[y0:y1, x0:x1].reshape(-1, 3)
    hit, points, normals, colours = hand.hits(shot.pose[:3, 3], rays)
    light = sum(hand.lit(points, normals, colours, np.random.default_rng(0), 6))
    shine = np.maximum((normals * unit(unit(KEY) - unit(rays[hit]))).sum(1), 0) ** 30
    light += 0.25 * shine[:, None]
    eye = shot.pose[:3, 3]
    behind = np.linalg.norm(shot.points[y0:y1, x0:x1].reshape(-1, 3)[hit] - eye, axis=1) < np.linalg.norm(
        points - eye, axis=1
    )
    pixels = np.asarray(picture).copy()
    part = pixels[y0:y1, x0:x1].reshape(-1, 3)
    part[np.flatnonzero(hit)[~behind]] = toned(light)[~behind]
    pixels[y0:y1, x0:x1] = part.reshape(y1 - y0, x1 - x0, 3)
    picture.paste(Image.fromarray(pixels))


def half(shot: Shot, side: Side, name: str, thumbs: Thumbs, at: int, progress: float, over: bool) -> Image.Image:
    """A policy's half of a frame, twice as large as it is shown."""
    looks, answer = side.runs[name]
    page = Image.new("RGB", (SIZE[0], 2 * SIZE[1]), PAPER)
    draw = ImageDraw.Draw(page, "RGBA")
    page.paste(scene(shot, side, looks, at, progress), (0, 92))
    if over:
        right = side.right(name)
        tag(draw, ("✓ " if right else "✗ ") + called(answer), (SIZE[0] // 2, 134), RIGHT if right else WRONG)
    draw.text((28, 14), side.name, side.colour, font(34, True))
    draw.text((28, 56), side.line, GREY, font(22))
    count, views, _ = side.stands
    tally = f"{count} of {len(side.done)} right, {views} views" if side.done else ""
    draw.text((SIZE[0] - 28, 24), tally, INK, font(26), anchor="ra")
    known = looks[at if progress == 1 else at - 1]
    for k, (thing, belief) in enumerate(known.leading):
        bar(page, draw, 722 + 84 * k, thumbs.of(thing, 72), called(thing), belief, side.colour if k == 0 else GREY)
    beside(page, draw, side, name, known, thumbs, over, at + (progress == 1))
    for k, thing in enumerate(SHOWN):
        small, x = thumbs.of(thing, 64), 28 + 76 * k
        if thing not in (*side.done, name):
            small = Image.blend(small, Image.new("RGB", small.size, PAPER), 0.6)
        page.paste(small, (x, 996))
        if thing == name:
            draw.rectangle((x - 4, 992, x + 67, 1063), None, side.colour, 3)
        if thing in side.done:
            right = side.right(thing)
            circle(draw, np.array([x + 54, 1050]), 14, RIGHT if right else WRONG)
            draw.text((x + 54, 1050), "✓" if right else "✗", (255, 255, 255), font(20, True), anchor="mm")
    draw.line((0, 978, SIZE[0], 978), FAINT, 2)
    return page


def tag(draw: ImageDraw.ImageDraw, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    wide = draw.textlength(text, font(34, True)) / 2 + 30
    draw.rounded_rectangle((at[0] - wide, at[1] - 30, at[0] + wide, at[1] + 30), 30, (*colour, 240))
    draw.text(at, text, (255, 255, 255), font(34, True), anchor="mm")


def bar(
    page: Image.Image, draw: ImageDraw.ImageDraw, y: int, small: Image.Image, name: str, share: float, colour: tuple
) -> None:
    page.paste(small, (24, y))
    draw.text((108, y + 8), name, INK, font(24))
    draw.text((508, y + 8), f"{100 * share:.0f} %", INK, font(24), anchor="ra")
    draw.rounded_rectangle((108, y + 44, 508, y + 58), 7, FAINT)
    draw.rounded_rectangle((108, y + 44, 108 + max(14, 400 * share), y + 58), 7, colour)


def beside(
    page: Image.Image,
    draw: ImageDraw.ImageDraw,
    side: Side,
    name: str,
    look: Look,
    thumbs: Thumbs,
    over: bool,
    views: int,
) -> None:
    """Where it looks next and why; at the end, what it said."""
    x = 560
    if over or look.rivals is None or look.next_view is None:
        if over:
            right = side.right(name)
            draw.text((x, 760), "right" if right else "wrong", RIGHT if right else WRONG, font(40, True))
            text = f"after {views} view{'s' if views > 1 else ''}" + ("" if right else f": it is the {called(name)}")
            draw.text((x, 818), text, GREY, font(24))
        return
    both, view = look.rivals, look.next_view
    draw.text(
        (x, 722), "next: where these two differ" if side.colour == OURS else "next: any view, at random", INK, font(20)
    )
    for k in range(2):
        angle = 360 / AZIMUTHS * both.azimuths[k, view]
        small = thumbs.of(thumbs.names[both.classes[k]], 148, int(both.hypotheses[k]), RINGS[both.rings[view]], angle)
        page.paste(small, (x + 172 * k, 754))
        draw.rectangle((x + 172 * k, 754, x + 172 * k + 148, 902), None, FAINT, 2)
        draw.text((x + 172 * k + 74, 920), called(thumbs.names[both.classes[k]]), GREY, font(20), anchor="mm")
    draw.text((x + 160, 952), f"alike {both.alike[view]:.2f}", side.colour, font(22, True), anchor="mm")


def pages(stage: Stage, placed: list, sides: tuple[Side, Side], thumbs: Thumbs) -> Iterator[Image.Image]:
    """The frames, twice as large as they are shown."""
    for name in SHOWN:
        k, seconds = list(THINGS).index(name), THINGS[name][1]
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
                page.paste(drawn[state].crop((0, 0, SIZE[0] - 2, 2 * SIZE[1])), (n * (SIZE[0] + 2), 0))
            yield page
    card = Image.blend(page, Image.new("RGB", page.size, PAPER), 0.82)
    draw = ImageDraw.Draw(card)
    for n, side in enumerate(sides):
        middle, (right, views, travel) = SIZE[0] * n + SIZE[0] // 2, side.stands
        draw.text((middle, 360), side.name, side.colour, font(52, True), anchor="mm")
        draw.text((middle, 470), f"{right} of {len(SHOWN)} right", INK, font(64, True), anchor="mm")
        draw.text((middle, 560), f"{views} views, {travel:.0f} cells of travel", INK, font(38), anchor="mm")
    yield from [card] * round(END * RATE)


def main(folder: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], seed: int = 7) -> None:
    """Run the episodes and write the film."""
    placed = laid_out(folder, np.random.default_rng(seed))
    ours, theirs = (nextview.load(models="ycb", policy=name, threads=1) for name in (None, "random-all"))
    runs = [{name: episode(s, ours.policy, placed, k, seed) for k, name in enumerate(THINGS)} for s in (ours, theirs)]
    film(folder, out, placed, runs, ours.classes)


def film(folder: Path, out: Path, placed: list, runs: list, names: tuple[str, ...]) -> None:
    from imageio_ffmpeg import get_ffmpeg_exe

    card = read_card(find_models("ycb").recogniser)
    thumbs = Thumbs(folder, read_memory(card.path, card.sha256), names)
    sides = (
        Side("nextview", "looks where the things it believes in differ", OURS, runs[0]),
        Side("random views", "looks anywhere", THEIRS, runs[1]),
    )
    things = [(m.vertices * m.metres + at, m.faces, c) for (m, at), (c, _) in zip(placed, THINGS.values(), strict=True)]
    ground = 30 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    stage = Stage([*things, (*ground, TABLE)])
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as part:
        for n, page in enumerate(pages(stage, placed, sides, thumbs)):
            page.resize(SIZE, Image.LANCZOS).save(f"{part}/{n:04}.png", compress_level=1)
        start = [get_ffmpeg_exe(), "-y", "-loglevel", "error", "-framerate", str(RATE), "-i", f"{part}/%04d.png"]
        h264 = ["-c:v", "libx264", "-crf", "20", "-preset", "slow", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
        subprocess.run([*start, *h264, str(out / "things.mp4")], check=True)
        palette = "split[a][b];[a]palettegen=stats_mode=full[p];[b][p]paletteuse=dither=bayer:bayer_scale=5:diff_mode=rectangle"
        subprocess.run([*start, "-filter_complex", palette, str(out / "things.gif")], check=True)


if __name__ == "__main__":
    tyro.cli(main)
