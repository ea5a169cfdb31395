"""What Monty made of its episodes, and what nextview makes of the same things and rotations.

    python -m research.peers.beside_monty YCB WORK [--sets distinct similar] [--draw 1]

WORK is where ``research/peers/monty.py`` tested Monty. The scans hang in a round room as in
``benchmarks/verified_things.py --any-orientation``, turned as Monty's simulator turned them, and
nextview gets one or two depth frames of the ``wrist`` sensor from random viewpoints. It knows the
same ten things as Monty.

Prints for both the share that is named right, by Monty's own count (its best hypothesis where it
ran out of steps), the steps or frames, the seconds of an episode, and the error of the rotation of
what is named right, modulo the symmetries that are on nextview's card. Monty's seconds are those of
its learning module and of the rendering between its steps; nextview's are of CPU, from the frames
to the decision.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.shared import markdown, progress
from benchmarks.verified_things import (
    Outcome,
    Setting,
    Taught,
    judged,
    median_and_most,
    rotation_error,
    shown,
)
from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError

# the second: by the likeliest hypothesis, out of steps
RIGHT = ("correct", "correct_mlh")
TESTED = "tested"  # folders below WORK
EPISODES = "eval_stats.csv"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from Monty's axes, y up
VIEWS = 2


@dataclass(frozen=True, eq=False)
class Episode:
    """What Monty made of a thing in a rotation.

    Attributes:
        name: of the thing.
        turn: rotation of the scan, whose z axis is up, (3, 3) float64.
        right: whether Monty named it right.
        steps: that it took.
        seconds: that it took.
        found: the rotation that it found, of the thing that it named, (3, 3) float64.
    """

    name: str
    turn: NDArray[np.float64]
    right: bool
    steps: int
    seconds: float
    found: NDArray[np.float64]


def episodes_of(work: Path, things: str) -> list[Episode]:
    """What Monty wrote of its episodes with ten things.

    Args:
        work: folder in which it was tested.
        things: which ten.

    Raises:
        UsageError: it was not tested with these.
    """
    files = sorted((work / TESTED / things).rglob(EPISODES))
    if not files:
        raise UsageError(f"{work}: Monty was not tested with the {things} things")
    episodes = []
    for file in files:
        with file.open(newline="") as lines:
            episodes += [episode_of(row) for row in csv.DictReader(lines)]
    return episodes


def episode_of(row: dict[str, str]) -> Episode:
    """An episode as Monty writes it."""
    scalar_first = np.array(
        row["primary_target_rotation_quat"].strip("[]").split(),
        float,
    )
    turn = Rotation.from_quat(scalar_first, scalar_first=True).as_matrix()
    angles = np.array(row["most_likely_rotation"].strip("[]").split(), float)
    found = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return Episode(
        row["primary_target_object"],
        Z_UP @ turn @ Z_UP.T,
        row["primary_performance"] in RIGHT,
        int(row["num_steps"]),
        float(row["time"]),
        Z_UP @ found @ Z_UP.T,
    )


def beside(taught: Taught, episodes: Sequence[Episode], draw: int) -> list[Outcome]:
    """Show nextview what Monty was shown.

    Args:
        taught: the scans, and a memory of them.
        episodes: Monty's.
        draw: number of the draw of viewpoints and errors of the sensor.

    Returns:
        What was found after one and after two frames.
    """
    known = sorted({taught.names.index(episode.name) for episode in episodes})
    some = np.array(known)
    things = taught.things(some).in_any_orientation()
    setting = Setting("wrist", VIEWS, poses="scanned", clutter=0, any_orientation=True)
    outcomes = []
    for number, episode in enumerate(progress(episodes, "nextview")):
        thing = taught.names.index(episode.name)
        seen = shown(taught, thing, 1000 * draw + number, setting, episode.turn)
        outcomes += [judged(things, taught, some, seen, k) for k in range(1, VIEWS + 1)]
    return outcomes


def table(
    episodes: Sequence[Episode],
    outcomes: Sequence[Outcome],
    taught: Taught,
) -> str:
    """Monty's row, and one for each number of frames."""
    steps = np.array([episode.steps for episode in episodes])
    seconds = np.array([episode.seconds for episode in episodes])
    share = np.mean([episode.right for episode in episodes])
    errors = median_and_most(
        [error_of(episode, taught) for episode in episodes if episode.right]
    )
    spent = f"{np.median(seconds):.1f}, {seconds.max():.1f}"
    rows = [("Monty", f"{share:.3f}", f"{steps.mean():.0f}", spent, errors)]

    for k in range(1, VIEWS + 1):
        here = [outcome for outcome in outcomes if outcome.views == k]
        seconds = np.array([outcome.seconds for outcome in here])
        share = np.mean([outcome.right for outcome in here])
        errors = median_and_most(
            [outcome.rotation for outcome in here if outcome.right]
        )
        frames = f"{k} frame{'s' if k > 1 else ''}"
        spent = f"{np.median(seconds):.2f}, {seconds.max():.2f}"
        rows.append((f"nextview, {frames}", f"{share:.3f}", f"{k}", spent, errors))
    columns = (
        "",
        "right",
        "steps or frames",
        "seconds: median, worst",
        "rotation, degrees: median, 95 %",
    )
    return markdown(columns, rows)


def error_of(episode: Episode, taught: Taught) -> float | None:
    """The error of Monty's rotation, degrees; None for a ball."""
    thing = np.array([taught.names.index(episode.name)])
    symmetries = taught.things(thing).symmetries[0]
    return rotation_error(episode.found, episode.turn, symmetries)


def main(
    scans: tyro.conf.Positional[Path],
    work: tyro.conf.Positional[Path],
    sets: tuple[Literal["distinct", "similar"], ...] = ("distinct", "similar"),
    models: str = "ycb",
    draw: int = 1,
) -> None:
    """Print what both make of the same things in the same rotations.

    Args:
        scans: folder of the scans.
        work: folder in which Monty was tested.
        sets: which ten things.
        models: memory of the things.
        draw: number of the draw of viewpoints and errors of the sensor.
    """
    taught = Taught.load(models, scans)
    for things in sets:
        episodes = episodes_of(work, things)
        outcomes = beside(taught, episodes, draw)
        print(f"\nten {things} things, {len(episodes)} episodes", "", sep="\n")
        print(table(episodes, outcomes, taught))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
