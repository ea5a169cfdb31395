"""Name an object in every single frame of captured views, and see how much of it has to show.

    python benchmarks/captured_frames.py FOLDER BOX.json LABEL

The box is the upright one into which the object just fits, with axes (see docs/your_camera.md). Prints, for frames in
which ever more of the object shows, how many there are and how many are named right.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro

from nextview.cameras.captured import read_box, read_capture
from nextview.errors import ObservationError
from nextview.models.inference import load_models
from nextview.sensing import ObservedObject

LEAST = (1, 500, 1500, 2500, 3500, 4500)
"""Pixels that show the object in what the network takes, 224 x 224."""


def main(
    folder: tyro.conf.Positional[Path],
    box: tyro.conf.Positional[Path],
    label: tyro.conf.Positional[str],
    /,
    raw: bool = False,
    any_size: bool = False,
) -> None:
    recogniser = load_models(()).recogniser
    asked, capture, rows = read_box(box), read_capture(folder), []
    for frame in capture.frames:
        thing = ObservedObject(asked.axes[2], box=asked, denoise=not raw, life_size=not any_size)
        try:
            seen = thing.add(frame.read(masked=False))
        except ObservationError:
            continue
        answer = recogniser.classes[int(recogniser([seen]).logits.argmax())]
        rows.append((seen.visible, answer))
    print(f"{len(rows)} of {len(capture.frames)} frames show it\n")
    print(f"| pixels | frames | {label} | others |\n|---|---|---|---|")
    visible, answers = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    for least in LEAST:
        here = answers[visible >= least]
        names, counts = np.unique(here[here != label], return_counts=True)
        others = ", ".join(f"{name} {count}" for name, count in zip(names, counts, strict=True))
        print(f"| {least} | {len(here)} | {(here == label).sum()} | {others} |")


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,))
