"""Real frames of things on a table, each named by a point and by a mask: what is found of it, and
what it is called.

    python -m research.real_things FOLDER SCANS

The folder holds NAME.depth.png (uint16, millimetres), NAME.labels.png (uint8) and names.txt, a line
a label, the first of what is none. The camera is that of the PoseCNN demo; its frames are not in
the project. SCANS are meshes in metres.
"""

from pathlib import Path

import numpy as np
import tyro
from PIL import Image

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.sensing import Frame, ObservedObject

INTRINSICS = np.array([[618.017, 0, 312.377], [0, 618.003, 232.375], [0, 0, 1.0]])
LEAST = 200  # pixels of a label
NEAR = 0.15  # the radius is right up to so much of itself


def main(folder: tyro.conf.Positional[Path], scans: tyro.conf.Positional[Path]) -> None:
    names = (folder / "names.txt").read_text().split()
    system = nextview.load(models="ycb")
    rows = []
    for path in sorted(folder.glob("*.depth.png")):
        depth = np.asarray(Image.open(path)).astype(np.float32) / 1000
        labels = np.asarray(
            Image.open(path.with_name(path.name.replace("depth", "labels")))
        )
        whole = Frame(depth, INTRINSICS, np.eye(4))
        for number, name in enumerate(names[1:], 1):
            shown = (labels == number) & (depth > 0)
            if shown.sum() < LEAST:
                continue
            pointed = ObservedObject(
                up=None,
                point=np.median(whole.positions(*np.nonzero(shown)), 0),
            )
            pointed.add(whole)
            found = pointed.sightings[0].mask
            session = system.session(start=0, object=ObservedObject(up=None))
            view = session.update(
                Frame(depth, INTRINSICS, np.eye(4), mask=labels == number)
            )
            best = [system.classes[c] for c in np.argsort(-view.belief)[:3]]
            true = nextview.load_mesh(scans / f"{name}.ply", unit="m").metres
            radii = (
                pointed.object_frame.radius / true,
                session.object.object_frame.radius / true,
            )
            overlap = (found & shown).sum() / (found | shown).sum()
            rows.append(
                (
                    overlap,
                    *(abs(r - 1) < NEAR for r in radii),
                    name == best[0],
                    name in best,
                )
            )
            print(
                f"{name}: overlap {overlap:.2f}, radius {radii[0]:.2f} by point, {radii[1]:.2f} by"
                f" mask; {best[0]}"
            )
    mean, *counts = np.array(rows, float).T
    right = [int(count.sum()) for count in counts]
    print(
        f"overlap {mean.mean():.3f}; of {len(rows)}: radius right for {right[0]} by point,"
        f" {right[1]} by mask; named right {right[2]}, among the first three {right[3]}"
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
