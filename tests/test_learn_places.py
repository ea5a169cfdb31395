"""Where a memory is written: links, folders of others, two runs at once, parts of a stopped
run.
"""

import json
import os
import shutil

import pytest
from factories import SAMPLE_FILES, drawn_thing

from nextview.errors import DatasetError, ResultsError
from nextview.files import MARKER, only_one
from nextview.teaching import learn as module
from nextview.teaching.learn import learn
from nextview.things.memory import open_memory


@pytest.fixture
def looked_at(monkeypatch):
    """The names of things that were looked at: drawn at random, and not tested."""
    names = []

    def teach(path, name, how):
        names.append(name)
        return drawn_thing(name)

    monkeypatch.setattr(module, "teach", teach)
    monkeypatch.setattr(module, "show", lambda *given: [])
    monkeypatch.setattr(
        module,
        "draw_learned",
        lambda path, pictures, *about: path.write_text(" ".join(pictures)),
    )
    return names


@pytest.fixture
def place(tmp_path, looked_at):
    """Folders of meshes, first (box, ball) and more (cup), and a memory of the first, mine."""
    for folder, names in {"first": ("box", "ball"), "more": ("cup",)}.items():
        (tmp_path / folder).mkdir()
        for name in names:
            shutil.copy(SAMPLE_FILES / "chair.off", tmp_path / folder / f"{name}.off")
    learn(tmp_path / "first", tmp_path / "mine", unit="cm", workers=0)
    looked_at.clear()
    return tmp_path


def known(out):
    return [thing.name for thing in open_memory(out / "memory.json")[0].memory.things]


def contents(folder):
    """All there is in a folder, by name: bytes of files, targets of links."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.is_file():
            found[name] = path.read_bytes()
    return found


RUNS = {
    "add": lambda place: learn(
        place / "more", place / "mine", unit="cm", add=True, workers=0
    ),
    "remove": lambda place: learn(
        place / "mine", place / "mine", remove=("box",), workers=0
    ),
    "overwrite": lambda place: learn(
        place / "more", place / "mine", unit="cm", overwrite=True, workers=0
    ),
}
AFTER = {"add": ["ball", "box", "cup"], "remove": ["ball"], "overwrite": ["cup"]}


def link_away(path, place):
    target = place / "disk"
    shutil.move(path, target)
    path.symlink_to(target, target_is_directory=target.is_dir())
    return target


@pytest.mark.parametrize(
    ("run", "linked"),
    [("add", "memory.json"), ("remove", "learned.png"), ("overwrite", ".")],
)
def test_an_output_path_that_is_a_link_is_rejected_early(place, looked_at, run, linked):
    link_away(place / "mine" / linked if linked != "." else place / "mine", place)
    before = contents(place)
    with pytest.raises(ResultsError):
        RUNS[run](place)
    assert contents(place) == before
    assert not looked_at
    assert known(place / "mine") == ["ball", "box"]


@pytest.mark.parametrize("run", RUNS)
def test_foreign_files_next_to_the_output_are_kept(place, run):
    marked = json.dumps({"output": "other", "key": "things"})
    foreign = {
        ".mine.part/thesis.txt": "mine",
        ".mine-abcdefgh/thesis.txt": "mine",
        f".mine-bcdefghi/{MARKER}": "not a record",
        f".mine-cdefghij/{MARKER}": marked,
        "mine/.new-abcdefgh/thesis.txt": "mine",
        "mine/memory-0123456789abcdef.safetensors": "its name is no hash of it",
        "mine/memory-notes.safetensors": "mine",
        "mine/notes.txt": "mine",
    }
    for name, text in foreign.items():
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text(text)
    RUNS[run](place)
    assert known(place / "mine") == AFTER[run]
    now = contents(place)
    assert {name: now.get(name) for name in foreign} == {
        name: text.encode() for name, text in foreign.items()
    }


def test_concurrent_runs_are_rejected_without_loss_of_data(place, monkeypatch):
    shutil.copytree(place / "more", place / "third")
    (place / "third/cup.off").rename(place / "third/jug.off")
    with only_one(place / "mine"), pytest.raises(DatasetError):
        learn(place / "more", place / "mine", unit="cm", add=True, workers=0)

    find = module.find_things
    waiting = [place / "third"]

    # while this run looks for its things, another one begins and ends
    def find_things(folder, out, one_class):
        if waiting:
            learn(waiting.pop(), place / "mine", unit="cm", add=True, workers=0)
        return find(folder, out, one_class)

    monkeypatch.setattr(module, "find_things", find_things)
    learn(place / "more", place / "mine", unit="cm", add=True, workers=0)
    assert known(place / "mine") == ["ball", "box", "cup", "jug"]


CHANGES = {
    "nothing": (lambda folder: None, False),
    "the time of a file": (
        lambda folder: os.utime(folder / "depth/0.png", (1, 1)),
        True,
    ),
    "a file behind a link": (
        lambda folder: os.utime(folder / "rgb/0.png", (1, 1)),
        True,
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_frames_that_were_changed_in_place_are_processed_again(
    tmp_path, looked_at, what
):
    folder = tmp_path / "scans/thing"
    (folder / "depth").mkdir(parents=True)
    for name in ("scene_camera.json", "scene_gt.json", "depth/0.png"):
        (folder / name).write_bytes(b"{}")
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk/0.png").write_bytes(b"0")
    (folder / "rgb").symlink_to(tmp_path / "disk")
    (folder / "loop").symlink_to(tmp_path)
    shutil.copy(SAMPLE_FILES / "chair.off", tmp_path / "scans/box.off")

    def stop(done, total, what):
        for count in done:
            if count == 2:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path / "scans", tmp_path / "mine", unit="cm", workers=0, track=stop)
    assert sorted(looked_at) == ["box", "thing"]
    looked_at.clear()
    change, again = CHANGES[what]
    times = {
        path: path.stat().st_mtime_ns
        for path in (folder, folder / "depth", tmp_path / "disk")
    }
    change(folder)
    for path, time in times.items():  # as cp over what is there leaves it
        os.utime(path, ns=(time, time))
    learn(tmp_path / "scans", tmp_path / "mine", unit="cm", workers=0)
    assert looked_at == ["thing"] * again
    assert {path.name for path in tmp_path.iterdir()} == {"scans", "disk", "mine"}
