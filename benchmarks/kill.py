"""Kill commands at random moments and fill their disk: what they were to make must come out whole all the same.

    python benchmarks/kill.py --kills 100
    python benchmarks/kill.py --kills 0 --disks 20       # as root: mounts small disks

For each of render, predict, benchmark and train: the command runs once undisturbed, and then again and again from
nothing. Each time it is killed with SIGKILL at a random moment, or at a random one of the moments when it opens,
renames or removes something, and begun anew, as often as it takes to end. What is there then must be equal to
what the undisturbed run made, and nothing may lie beside it that was not asked for.

With --disks they run on disks of all sizes up to the one that is enough. Where the disk is full, the command has to end
with status 2 and one sentence, and leave whole what was there; on a larger disk, it must then end well.

Every run is a fork of this process, which has imported everything, so that its time is that of the work alone.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.util import _exit_function
from pathlib import Path
from typing import Any

import numpy as np
import tyro

EVENTS = ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate")
"""What the interpreter tells of to those who listen, each a moment at which the disk changes."""
JOBS = ("render", "predict", "benchmark", "train")
LONGEST = 600
"""Seconds after which a run counts as hanging."""


@dataclass(frozen=True)
class Job:
    """A command, and what it is to make.

    Attributes:
        arguments: of the command, for a folder to write to.
        out: what it makes in that folder.
        content: of that, to be compared.
        beside: names of what may lie beside that.
        before: makes earlier results in a folder, which the command replaces; None if there are none.
    """

    arguments: Callable[[Path], list[Any]]
    out: str
    content: Callable[[Path], dict[str, Any]]
    beside: tuple[str, ...] = ()
    before: Callable[[Path], None] | None = None


def make_jobs(inputs: Path) -> dict[str, Job]:
    """The commands, on a few small objects; what they need is made in a folder."""
    from nextview.data.samples import boxes_mesh
    from nextview.mesh import Mesh

    def save(mesh: Mesh, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0", *(" ".join(map(str, v)) for v in mesh.vertices)]
        path.write_text("\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in mesh.faces)]) + "\n")

    meshes, rng = inputs / "meshes", np.random.default_rng(0)
    for name, tall in (("chair", 1.0), ("table", 0.4)):
        for i in range(4):
            x, y, z = rng.uniform(0.6, 1.4, 3) * (1, 1, tall)
            split = "test" if i == 3 else "train"
            boxes = [((-x, -y, 0), (x, y, z)), ((-x, -y, z), (0, 0, 2 * z))]
            save(boxes_mesh(boxes, name), meshes / name / split / f"{name}_{i}.off")
    views = inputs / "views.zarr"
    run("render", meshes, views, "--sphere", "12", "--size", "112", "--workers", "0")
    predictions = inputs / "predictions.npz"
    run("predict", views, predictions, "--maps", "--workers", "0")
    # Not smaller: where a convolution sees its padding alone, gradients are rounding noise, another in each run.
    small = [
        "--network",
        "lite0",
        "--size",
        "56",
        "--epochs",
        "2",
        "--views",
        "2",
        "--batch",
        "4",
        "--validation",
        "0.4",
    ]
    run("train", "recogniser", views, inputs / "run", *small, "--epochs", "1")  # also makes the inputs beside the store
    judge = ["benchmark", predictions, "--split", "train", "--policies", "random", "spread", "--samples", "50"]

    def results(folder: Path) -> None:
        run(*judge, "--out", folder / "results", "--seed", "1")

    return {
        "render": Job(
            lambda folder: [
                "render",
                meshes,
                folder / "views.zarr",
                "--sphere",
                "12",
                "--size",
                "48",
                "--workers",
                "0",
            ],
            "views.zarr",
            store_content,
            ("views.zarr.lock",),
        ),
        "predict": Job(
            lambda folder: ["predict", views, folder / "p.npz", "--maps", "--batch", "1", "--workers", "0"],
            "p.npz",
            predictions_content,
            ("p.npz.lock",),
        ),
        "benchmark": Job(
            lambda folder: [*judge, "--out", folder / "results"], "results", tree, ("results.lock",), results
        ),
        "train": Job(
            lambda folder: ["train", "recogniser", views, folder / "run", *small], "run", run_content, ("run.lock",)
        ),
    }


# What was made


def tree(folder: Path) -> dict[str, Any]:
    """Hashes of all files below a folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def store_content(path: Path) -> dict[str, Any]:
    """The arrays of a store byte by byte, and its attributes but for the commands, which name other folders."""
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    kept = {name: value for name, value in attributes.items() if name not in ("commands", "checksum")}
    return {"attributes": kept} | {name: hashed for name, hashed in tree(path).items() if name != "zarr.json"}


def predictions_content(path: Path) -> dict[str, Any]:
    """The arrays of predictions, but for the commands."""
    with np.load(path) as file:
        return {name: file[name].tobytes() for name in file.files if name != "commands"}


def run_content(folder: Path) -> dict[str, Any]:
    """The names of the files of a training run, its weights, and its log but for the seconds."""
    import torch

    weights = torch.load(folder / "network.pt", weights_only=True)
    rows = [line.rpartition(",")[0] for line in (folder / "log/metrics.csv").read_text().splitlines()]
    files = sorted(name for name in tree(folder))
    return {"files": files, "log": rows} | {name: values.numpy().tobytes() for name, values in weights.items()}


# How it is run and killed


def run(*arguments: Any) -> None:
    """Run a command to its end in a fork."""
    status, said = run_killed([*arguments], None, None)[:2]
    if status:
        raise SystemExit(f"nextview {' '.join(map(str, arguments))} ended with status {status}: {said}")


def run_killed(arguments: list[Any], seconds: float | None, events: int | None) -> tuple[int, str, int]:
    """Run a command in a fork and kill it.

    Args:
        arguments: of the command.
        seconds: after which it is killed; None to kill it never.
        events: after so many of EVENTS it kills itself; None for never.

    Returns:
        The exit status, what was printed, and how many of EVENTS there were if it came to its end.
    """
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as counted:
        child = os.fork()
        if child == 0:
            _be_command([str(argument) for argument in arguments], printed.fileno(), counted.fileno(), events)
        ended, begun = 0, time.monotonic()
        while not ended:
            ended, status = os.waitpid(child, os.WNOHANG)
            passed = time.monotonic() - begun
            if not ended and passed > (LONGEST if seconds is None else seconds):
                os.kill(child, signal.SIGKILL)
                ended, status = os.waitpid(child, 0)
                assert seconds is not None, f"{arguments} hangs"
            time.sleep(0.001)
        printed.seek(0)
        counted.seek(0)
        said = printed.read().decode(errors="replace")
        return os.waitstatus_to_exitcode(status), said, int(counted.read() or 0)


def _be_command(arguments: list[str], printed: int, counted: int, events: int | None) -> None:
    """Be the command, and end with its status."""
    status = 1
    try:
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        seen = 0

        def listen(event: str, details: tuple) -> None:
            nonlocal seen
            if event in EVENTS:
                seen += 1
                if seen == events:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(listen)
        from nextview.cli.main import main as nextview

        try:
            nextview(arguments)
            status = 0
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        _exit_function()  # what the interpreter does for pools of processes when it ends: a fork has to ask for it
        os.write(counted, str(seen).encode())
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        import traceback

        os.write(2, traceback.format_exc().encode())
    finally:
        os._exit(status)


def differences(job: Job, folder: Path, wanted: dict[str, Any]) -> list[str]:
    """What is not as it has to be in a folder once the job is done."""
    found = job.content(folder / job.out)
    wrong = [f"{name} differs" for name in wanted if found.get(name) != wanted[name]]
    wrong += [f"{name} is there" for name in found if name not in wanted]
    allowed = {job.out, *job.beside}
    return wrong + [f"{path.name} is left" for path in sorted(folder.iterdir()) if path.name not in allowed]


def kill_often(job: Job, wanted: dict[str, Any], kills: int, rng: np.random.Generator, home: Path) -> tuple[int, list]:
    """Kill a job so many times; how often it came to its end, and what was wrong."""
    folder = home / "undisturbed"
    folder.mkdir()
    if job.before:
        job.before(folder)
    begun = time.monotonic()
    status, said, events = run_killed(job.arguments(folder), None, None)
    assert status == 0, said
    seconds, killed, ended, wrong = time.monotonic() - begun, 0, 0, []
    while killed < kills:
        folder = home / f"killed{ended}"
        folder.mkdir()
        if job.before:
            job.before(folder)
        history: list[str] = []
        while True:
            at_event = bool(rng.random() < 0.5) and killed < kills
            moment = int(rng.integers(1, events + 1)) if at_event else None
            after = None if at_event or killed >= kills else float(rng.uniform(0, seconds))
            status, said, _ = run_killed(job.arguments(folder), after, moment)
            if status != -signal.SIGKILL:
                break
            killed += 1
            history.append(f"event {moment}" if at_event else f"{after:.3f} s")
        ended += 1
        problems = differences(job, folder, wanted) if status == 0 else [f"status {status}: {said[-2000:]}"]
        if problems:
            wrong.append(f"after {', '.join(history)}: {'; '.join(problems)}")
        shutil.rmtree(folder)
    return ended, wrong


def fill_disks(job: Job, wanted: dict[str, Any], disks: int, home: Path) -> tuple[Counter, list]:
    """Run a job on disks of many sizes; how often the disk was full and large enough, and what was wrong."""
    disk, counts, wrong = home / "disk", Counter(), []
    disk.mkdir()
    mount(disk, "400m")
    try:
        if job.before:
            job.before(disk)
        earlier = job.content(disk / job.out) if job.before else None
        least = used(disk)
        status, said, _ = run_killed(job.arguments(disk), None, None)
        assert status == 0, said
        most = max(used(disk), least) + (least if job.before else 0)
    finally:
        subprocess.run(["umount", disk], check=True)
    for size in np.unique(np.linspace(least, 1.3 * most, disks + 1)[1:].astype(int) // 4096 * 4096):
        mount(disk, str(size) if not job.before else "400m")
        try:
            if job.before:
                job.before(disk)
                mount(disk, str(size), "remount,")
            status, said, _ = run_killed(job.arguments(disk), None, None)
            if status:
                counts["full"] += 1
                last = (said.strip().splitlines() or [""])[-1]
                if status != 2 or not last.startswith("nextview: ") or "Traceback" in said:
                    wrong.append(f"disk of {size}: status {status}: {said[-3000:]}")
                if earlier is not None and job.content(disk / job.out) != earlier:
                    wrong.append(f"disk of {size}: earlier results are not whole")
                mount(disk, "400m", "remount,")
                status, said, _ = run_killed(job.arguments(disk), None, None)
            else:
                counts["enough"] += 1
            problems = differences(job, disk, wanted) if status == 0 else [f"status {status}: {said[-2000:]}"]
            if problems:
                wrong.append(f"disk of {size}, then of enough: {'; '.join(problems)}")
        finally:
            subprocess.run(["umount", disk], check=True)
    return counts, wrong


def mount(disk: Path, size: str, how: str = "") -> None:
    command = ["mount", "-t", "tmpfs", "-o", f"{how}size={size}", "tmpfs", str(disk)]
    if subprocess.run(command, check=False).returncode:
        raise SystemExit("small disks can be mounted by root alone, on Linux")


def used(disk: Path) -> int:
    found = os.statvfs(disk)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def main(kills: int = 10, disks: int = 0, jobs: tuple[str, ...] = JOBS, seed: int = 0) -> None:
    """Kill commands at random moments and fill their disk.

    Args:
        kills: of each command.
        disks: so many sizes of disks for each; takes root and Linux.
        jobs: only these commands.
        seed: decides the moments.
    """
    import torch

    torch.set_num_threads(1)  # threads do not outlive a fork
    import nextview.cli.main  # noqa: F401

    multiprocessing.set_start_method("spawn", force=True)
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        (home / "inputs").mkdir()
        made = make_jobs(home / "inputs")
        for name in jobs:
            job, place = made[name], home / name
            place.mkdir()
            (place / "wanted").mkdir()
            run(*job.arguments(place / "wanted"))
            wanted = job.content(place / "wanted" / job.out)
            wrong: list[str] = []
            if kills:
                ended, wrong = kill_often(job, wanted, kills, np.random.default_rng([seed, JOBS.index(name)]), place)
                print(
                    f"{name}: killed {kills} times and more, {ended} runs came to their end, {len(wrong)} wrong",
                    flush=True,
                )
            if disks:
                counts, full = fill_disks(job, wanted, disks, place)
                print(
                    f"{name}: disk full {counts['full']}, large enough {counts['enough']}, {len(full)} wrong",
                    flush=True,
                )
                wrong += full
            print(*wrong, sep="\n", end="\n" if wrong else "", flush=True)
            failed |= bool(wrong)
            shutil.rmtree(place)
    sys.exit(failed)


if __name__ == "__main__":
    tyro.cli(main)
