"""The arm over a full table in a short form: what it prints agrees with what truly stands there."""

import importlib
import re

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

pytest.importorskip("mujoco", reason="the extra 'arm' of research is not installed")

from conftest import ROOT
from nextview.errors import UsageError
from nextview.geometry.viewsphere import look_at_origin
from nextview.simulation.sensor import SENSORS
from nextview.things.memory import open_memory
from research.arm import Arm

NAMES = (
    "cracker_box",
    "bleach_cleanser",
    "pitcher_base",
    "mug",
    "banana",
    "tomato_soup_can",
    "tuna_fish_can",
    "tennis_ball",
)


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(ROOT / "examples"))
        yield importlib.import_module("arm_over_table")


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A few things of the memory as files."""
    folder = tmp_path_factory.mktemp("scans")
    card, memory = open_memory("ycb")
    names = [thing.name for thing in card.memory.things]
    for name in NAMES:
        surface = memory.surfaces.surface(names.index(name), name)
        trimesh.Trimesh(surface.vertices, surface.faces, process=False).export(
            folder / f"{name}.ply"
        )
    return folder


@pytest.fixture(scope="module")
def table(example, scans):
    return example.draw_table(sorted(scans.iterdir()), 8, 0)


def test_three_things_are_hidden_and_nothing_overlaps(example, table):
    """By pixels of frames through the sensor, of all things and of each alone."""
    assert len(table.hidden) == 3
    arm = Arm(
        [(one.placed, one.faces) for one in table.things],
        np.random.default_rng(0),
    )
    arm.joints = arm.solve(example.first_pose())
    arm.look()
    every = np.bincount(arm.owner[arm.owner >= 0], minlength=8)
    for row, thing in enumerate(table.things):
        alone = Arm([(thing.placed, thing.faces)], np.random.default_rng(0), arm.joints)
        alone.look()
        share = every[row] / np.count_nonzero(alone.owner == 0)
        assert share == pytest.approx(table.shown[row], abs=0.1), thing.name
    assert [thing.placed[:, 2].min() for thing in table.things] == pytest.approx(
        [0] * 8,
        abs=1e-9,
    )


def test_it_takes_itself_out_of_the_picture(example, table):
    """By points on its links, which stand in the picture as it looks back at its base."""
    things = [(one.placed, one.faces) for one in table.things]
    arm = Arm(things, np.random.default_rng(0), sensor=SENSORS["wrist"].scaled(0))
    pose = look_at_origin(np.radians(70), np.radians(20), 0.5)
    pose[:3, 3] += [0.3, 0, 0.1]
    arm.joints = arm.solve(pose)
    links = cKDTree(
        np.concatenate(
            [
                trimesh.Trimesh(*each).sample(20000, seed=0)
                for each, _ in arm.things()[9:]
            ]
        )
    )

    def on_links(frame):
        rows, columns = np.nonzero(frame.depth)
        away, _ = links.query(frame.positions(rows, columns))
        return np.count_nonzero(away < 0.005), len(rows)

    with_links, every = on_links(arm.look())
    without, rest = on_links(arm.look(itself=False))
    assert with_links > 1000
    # where the base stands on the table
    assert without < 0.01 * with_links
    assert rest > every - 1.5 * with_links


@pytest.mark.long  # an arm over a whole table
def test_what_it_says_is_what_stands_there(example, scans, tmp_path, capsys):
    film = tmp_path / "film.gif"
    figure = tmp_path / "end.png"
    example.main(scans, things=8, looks=2, film=film, figure=figure)
    said = capsys.readouterr().out
    on_table = re.search("on the table: (.*)", said)[1].split(", ")
    assert len(on_table) == 8
    assert len(re.search("hidden from the first look: (.*)", said)[1].split(", ")) == 3
    right = re.findall(r"^\d+: (\w+), belief.*: right, (\d+) mm off", said, re.M)
    assert len(right) >= 3
    assert all(name in on_table and int(off) < 20 for name, off in right)
    assert f"{len(right)} of 7 things named right" in said
    with Image.open(film) as shown:
        assert shown.n_frames > 10
    with Image.open(figure) as shown:
        assert shown.width > 1000


def test_too_few_scans_are_named(example, scans):
    with pytest.raises(UsageError, match="9 scans are needed"):
        example.draw_table(sorted(scans.iterdir()), 10, 0)
