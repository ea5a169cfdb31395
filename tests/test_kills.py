"""Runs that are killed before any step on the disk: what is read then is the old output or the new
one, never neither.

An audit hook ends the process at the n-th time that something is about to be opened for writing,
made, renamed or removed in the folder: as ``kill -9`` does, without clearing up.
"""

import json
import os
import subprocess
import sys

INJECTION = """
import json, os, sys
from pathlib import Path

CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate"}


def changes(event, arguments):
    if event == "open":
        mode, flags = arguments[1:]
        if isinstance(flags, int):
            return bool(flags & (os.O_WRONLY | os.O_RDWR))
        return "r" not in str(mode)
    return event in CHANGES


def steps(work, place, ready, after, kinds=CHANGES | {"open"}):
    '''Work in a child that dies at its n-th change in a folder, for n = 1, 2, ..., until it lives.

    Prints, for each, at which change it died, and what ``after`` says.
    '''
    said = []
    while True:
        ready()
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            count = 0

            def hook(event, arguments):
                nonlocal count
                changed = changes(event, arguments)
                inside = changed and os.fsdecode(arguments[0]).startswith(str(place))
                if event in kinds and inside:
                    count += 1
                    if count > len(said):
                        os.write(writing, event.encode())
                        os._exit(9)

            sys.addaudithook(hook)
            try:
                work()
            except BaseException:
                import traceback
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        os.close(writing)
        event = os.read(reading, 100).decode()
        os.close(reading)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.append((event, code, after()))
        if code != 9:
            break
    print(json.dumps(said))
"""

LEARN = """
import shutil
from factories import drawn_thing
from nextview.teaching import learn as module
from nextview.teaching.learn import learn
from nextview.things.memory import open_memory


module.teach = lambda path, name, how: drawn_thing(f"{name} {path.read_text()}")
module.show = lambda *given: []
module.draw_learned = lambda path, pictures, *about: path.write_text(" ".join(pictures))
folder = Path(sys.argv[1])
old, out = folder / "old", folder / "place" / "mine"
for name, things in {"first": "box ball", "more": "cup", "other": "ball box"}.items():
    (folder / name).mkdir()
    for thing in things.split():
        (folder / name / f"{thing}.off").write_text(name)
learn(folder / "first", old, unit="m", workers=0)


def known(out):
    card, memory = open_memory(out / "memory.json")
    return [[thing.name for thing in card.memory.things], memory.surfaces.boxes.tolist()]


def ready():
    shutil.rmtree(out.parent, ignore_errors=True)
    shutil.copytree(old, out)


def work():
    learn(folder / "more", out, unit="m", add=True, workers=0)


ready()
work()
new = known(out)


def after():
    found = known(out)
    which = "old" if found == known(old) else "new" if found == new else str(found)
    # A further run works, and removes what the killed one has left.
    if which == "new":
        learn(folder / "other", out, unit="m", overwrite=True, workers=0)
    else:
        work()
        assert known(out) == new
    left = [path for place in (out, out.parent) for path in sorted(place.iterdir())]
    return which, [path.name for path in left if not is_empty(path)]


def is_empty(path):  # a folder that was made, and not yet marked
    return path.is_dir() and not any(path.iterdir())


steps(work, out.parent, ready, after)
"""


def died(program, *arguments):
    command = [sys.executable, "-c", INJECTION + program, *map(str, arguments)]
    path = os.pathsep.join(sys.path)  # of the tests, too
    ran = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout.splitlines()[-1])


def test_learn_killed_before_any_step_leaves_the_old_memory_or_the_new_one(
    tmp_path,
):
    said = died(LEARN, tmp_path)
    events = [event for event, *_ in said]
    assert (
        events.count("os.rename") >= 5
    )  # weights, card and picture aside, and to their places
    assert [code for _, code, _ in said] == [9] * (len(said) - 1) + [0]
    found = [which for *_, (which, _) in said]
    assert set(found) == {"old", "new"}
    assert found == sorted(found, reverse=True)  # from some step on it is the new one
    for *_, (_, left) in said:
        assert len(left) == 4
        assert [name for name in left if not name.startswith("memory-")] == [
            "learned.png",
            "memory.json",
            "mine",
        ]
