"""How long the explorer takes from a click on a view until all is drawn and sent to the browser.

    python benchmarks/explore_latency.py --views 30

Beside the wall clock it tells the processor time of the thread that answers: what an idle machine would need with one
core, and the same on a machine that is busy with other things.
"""

from __future__ import annotations

import argparse
import time

from nextview.cli.extra import require

require("explore")

import numpy as np

from nextview.explorer.exploration import Exploration
from nextview.explorer.page import Page
from nextview.explorer.shown_object import shown_objects


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--policy", default="gain")
    arguments = parser.parse_args()
    for sensor in (None, "kinect", "stereo", "wrist"):
        page = Page(Exploration(shown_objects(), (arguments.policy,), sensor, threads=1), port=8900)
        page._look(0, 0)  # what is done once
        taken = []
        for view in range(1, 1 + arguments.views):
            wall, work = time.perf_counter(), time.thread_time()
            page._look(0, view)
            page.server.flush()
            taken.append((time.perf_counter() - wall, time.thread_time() - work))
        page.stop()
        (wall, work), slow = np.median(taken, 0), np.quantile(taken, 0.9, axis=0)
        clock = f"median {1000 * wall:.0f} ms of wall clock (90 %: {1000 * slow[0]:.0f})"
        print(f"{sensor or 'clean'}: {clock}, {1000 * work:.0f} ms of the thread (90 %: {1000 * slow[1]:.0f})")


if __name__ == "__main__":
    main()
