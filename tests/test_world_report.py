"""What a benchmark in worlds shows: the page and its viewer, the terminal, and what must not stand beside them."""

import base64
import json
import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_predictions import some_predictions
from test_report import browse
from test_worlds import meshes, store, worlds  # noqa: F401

from nextview.belief import Calibration
from nextview.benchmark import results, statistics
from nextview.benchmark.leaderboard import level_differences
from nextview.benchmark.levels import target_weights
from nextview.benchmark.published import ACCURACY, comparable_classes, read_table
from nextview.benchmark.replay import make_specs, replay
from nextview.cli.benchmark import benchmark
from nextview.cli.report import report
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_views import world_views
from nextview.errors import DatasetError
from nextview.worlds import World, build_scene

TEN = tuple(read_table(ACCURACY[10]))
SCRIPT = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "worlds.py"))
POLICIES = ("random-all", "visibility", "oracle-gain-all")


@pytest.fixture(scope="module")
def predictions(store) -> Predictions:  # noqa: F811
    """Of six worlds and ten classes; what hardly shows says nothing, and what shows in part counts in part."""
    opened, rng = ViewStore.open(store), np.random.default_rng(0)
    shows = opened.measure("visible_share") > 0.3
    assert 0.05 < shows.mean() < 0.95
    logits = np.where(shows[..., None], 2 * rng.normal(size=(len(opened), 40, 10)), 0).astype(np.float32)
    return replace(
        some_predictions(len(opened)), logits=logits, classes=TEN, names=tuple(opened.names), valley_classes={},
        depth_entropy=opened.measure(), store=str(store), calibration=Calibration(1.0, 0.3, visibility=0.7),
        maps={},
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(predictions, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("in_worlds")
    predictions.save(folder / "p.npz")
    options = {"thresholds": (0.9, 0.97), "runs": 3, "max_views": 4, "samples": 50}
    benchmark(folder / "p.npz", out=folder / "out", policies=POLICIES, **options)
    report(folder / "out")
    return folder / "out"


@pytest.fixture(scope="module")
def scenes(made) -> list[dict]:
    text = (made / "report.html").read_text()
    return json.loads(re.search(r'id="trajectories">(.*?)</script>', text, re.S)[1])["scenes"]


def points(packed: str, unit: float) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), np.int8).reshape(-1, 3) * unit / 127


def test_the_viewer_tells_the_beliefs_of_the_results(made, scenes, predictions):
    loaded, compared, hidden = results.load(made), 0, 0
    for scene in scenes:
        for shown in scene["episodes"]:
            of = loaded.episodes(shown["policy"], 0.97)
            of = of[of["object"].astype(str) == scene["name"]]
            same = [row for row in of.itertuples() if list(row.views) == shown["views"]]
            assert same
            answer, confidence = shown["beliefs"][-1][0]
            assert same[0].confidence == pytest.approx(confidence, abs=1e-4)
            seen = predictions.seen[predictions.names.index(scene["name"]), shown["views"]]
            if seen.any():  # else all classes are alike
                assert TEN[answer] == same[0].answer
            compared, hidden = compared + 1, hidden + (~seen).sum()
    assert compared > 8
    assert hidden > 3


def test_the_viewer_shows_what_stands_around(scenes, worlds, meshes, store):  # noqa: F811
    opened = ViewStore.open(store)
    for scene in scenes:
        world = World.load(next(worlds.glob(f"*/*/{scene['name']}.json")))
        built, row = build_scene(world, meshes), opened.names.index(scene["name"])
        assert scene["world"]["unreachable"] == list(world.unreachable)
        np.testing.assert_allclose(scene["world"]["shows"], world_views(opened, row).visible_share, atol=1e-3)
        assert scene["world"]["scale"] == pytest.approx(1 / opened.sphere.distance, abs=1e-4)
        things = points(scene["world"]["things"], opened.sphere.distance)
        assert len(things) > 100
        assert built.clearance(things).max() < 0.03  # half a step of the numbers it is written in
        target = points(scene["cloud"], 1.0)
        assert len(target) > 100
        corners = built.target.vertices[built.target.faces]
        nearest = [trimesh.triangles.closest_point(corners, np.tile(point, (len(corners), 1))) for point in target]
        apart = np.linalg.norm(np.stack(nearest) - target[:, None], axis=2).min(1)
        assert apart.max() < 0.02


def test_the_page_speaks_of_worlds(made):
    text = (made / "report.html").read_text()
    assert "6 worlds of light, medium and heavy clutter around objects of 3 classes" in text
    for level in ("Light", "Medium", "Heavy"):
        assert text.count(f"{level} clutter, 2 worlds: accuracy after a fixed number") == 2  # caption and label
    for wrong in (">published ", "as published", "as figures 15", "of the thesis", "oracle-valley"):
        assert wrong not in text
    assert not re.search(r"[>(: ]-0\.0[ <)]", text)
    table = text[text.index("Heavy clutter, 2 worlds") :]
    first, second = re.search(r'scope="row">visibility</th><td>(.*?)</td><td>(.*?)</td>', table).groups()
    assert (first.count("<small>"), second.count("<small>")) == (1, 3)  # after one view nothing is chosen


def test_the_page_says_which_policies_differ_after_a_number_of_views(made):
    tables = results.load(made).tables
    table = tables.levels.assign(p_holm=1.0)
    assert level_differences(replace(tables, levels=table), "random") is None
    table.loc[(table["level"] == "heavy") & (table["n_views"] == 3), ["p_holm", "difference"]] = 0.04, 0.1234
    told = level_differences(replace(tables, levels=table), "random")
    assert "visibility by +12.3 points after 3 views under heavy clutter" in told
    assert "oracle" not in told  # no robot can follow it
    assert "medium" not in told


def test_nothing_published_stands_beside_worlds(made, predictions):
    assert results.load(made).tables.summary["published"].isna().all()
    assert comparable_classes(predictions) == ()
    alone = replace(predictions, names=tuple(f"thing_{i}" for i in range(len(predictions))))
    assert comparable_classes(alone) == TEN


def test_worlds_around_one_target_are_drawn_together():
    names = ("a@light-0", "b@light-0", "a@heavy-0", "c@heavy-0", "a@heavy-1")
    weights = target_weights(names, 200, np.random.default_rng(0))
    for same in (2, 4):
        np.testing.assert_array_equal(weights[:, 0], weights[:, same])
    np.testing.assert_array_equal(weights[:, [0, 1, 3]].sum(1), 3)  # as many targets as there are
    alone = tuple("abcde")
    plain = statistics.resample(5, 200, np.random.default_rng(0))
    np.testing.assert_array_equal(target_weights(alone, 200, np.random.default_rng(0)), plain)


def test_the_terminal_tells_levels_in_80_columns(made, capsys):
    from nextview.cli.leaderboard_table import print_leaderboard

    loaded = results.load(made)
    print_leaderboard(loaded)
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    heavy = text[text.index("heavy clutter, 2 worlds") :]
    cells = re.search(r"^ *visibility (.*)$", heavy, re.M)[1].split()
    of = loaded.tables.levels.query("level == 'heavy' and policy == 'visibility'")
    told = [f"{of['accuracy'].iloc[0]:.3f}"]
    for accuracy, difference in of[["accuracy", "difference"]].to_numpy()[1:]:
        told += [f"{accuracy:.3f}", f"{round(100 * difference, 1) + 0.0:+.1f}"]
    assert [cell.rstrip("*") for cell in cells] == told


def test_worlds_without_their_store_are_not_taken_for_single_objects(predictions, tmp_path):
    lost = replace(predictions, store=str(tmp_path / "lost.zarr"))
    with pytest.raises(DatasetError, match=r"of worlds, and there is no view store at .*lost.zarr any more"):
        make_specs(lost, 1, 0)
    with pytest.raises(DatasetError, match="are of worlds, and name no view store; predict again"):
        make_specs(replace(predictions, store=""), 1, 0)
    alone = replace(lost, names=tuple(f"thing_{i}" for i in range(len(lost))))
    assert make_specs(alone, 1, 0).worlds is None


def test_the_viewer_draws_things_and_what_shows_in_a_browser(made, scenes):
    shown = scenes[0]["episodes"][0]
    page = browse(made / "report.html", f"#scene=0&policy={shown['policy']}&step=0")
    shares = [round(100 * scenes[0]["world"]["shows"][view] + 1e-9) for view in shown["views"]]
    assert [int(share) for share in re.findall(r"azimuth \d+°, (\d+) % shows", page)] == shares
    host = made / "host.html"
    host.write_text(
        """<iframe id="page" src="report.html" style="width:900px;height:900px;border:0"></iframe><p id="said"></p>
        <script>document.getElementById("page").onload = () => {
          const canvas = document.getElementById("page").contentDocument.getElementById("sphere");
          const p = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          let red = 0, blue = 0;
          for (let i = 0; i < p.length; i += 4) {
            red += p[i] > 1.5 * p[i + 2] && p[i] > 90 && Math.abs(p[i + 1] - p[i + 2]) < 9;
            blue += p[i] + 20 < p[i + 2] && p[i + 1] + 5 < p[i + 2] && p[i] > 100;
          }
          document.getElementById("said").textContent = `${red} ${blue}`;
        };</script>"""
    )
    red, blue = map(int, re.search(r'id="said">(\d+) (\d+)<', browse(host)).groups())
    assert red > 300
    assert blue > 100


# How far the belief can be trusted


def test_what_the_script_judges_is_what_replay_believes(predictions):
    specs = make_specs(predictions, 4, 0)
    path = replay("random-all", specs, 4, 0)
    assert (path.views >= 0).all()
    shown = specs.worlds.all_shown()[specs.objects[:, None], path.views]
    found = SCRIPT["Believed"].of(predictions, specs.objects, path.views, shown)
    np.testing.assert_allclose(found.confidence, path.confidences, rtol=1e-6)
    sure = found.confidence > 0.11  # else all classes are alike
    np.testing.assert_array_equal(found.right[sure], (path.answers == specs.labels[:, None])[sure])
    np.testing.assert_allclose(found.loss[found.right], -np.log(found.confidence[found.right]), rtol=1e-6)
    assert (found.loss[~found.right] >= np.log(2)).all()


def test_confident_nonsense_is_told_from_a_belief_that_is_right_as_often_as_it_says():
    """Of 200 walks the worlds are 0.95 sure and right in half, and single objects 0.75 sure and right in three of four.

    Their gaps are 45 and 0 points; the log-losses are those of a coin and of three in four.
    """
    of, rng = SCRIPT["Believed"], np.random.default_rng(0)
    right = [np.arange(200)[:, None] % 2 == 0, np.arange(200)[:, None] % 4 > 0]
    both = [
        of(np.full((200, 1), c), r, -np.log(np.where(r, c, 1 - c))) for c, r in zip((0.95, 0.75), right, strict=True)
    ]
    targets = np.arange(200) // 10
    accuracy, gap, error, loss, nonsense = SCRIPT["trusted"](both, np.ones(200, bool), 1, targets, 200, rng).split(
        " | "
    )
    assert accuracy == "0.500, 0.750"
    assert re.fullmatch(r"\+45.0 \(.*\), \+0.0 \(.*\)", gap)
    assert error == "0.450, 0.000"
    assert loss == f"{-np.log(0.95 * 0.05) / 2:.3f}, {-0.75 * np.log(0.75) - 0.25 * np.log(0.25):.3f}"
    assert nonsense == "50.0 %, 0.0 %"


def test_worlds_are_paired_with_their_targets_alone(predictions, tmp_path, capsys, monkeypatch):
    """A target alone that says what it says in its world is believed as much: both numbers of each cell are equal."""
    targets = [name.partition("@")[0] for name in predictions.names]
    kinds = sorted({*targets})
    first = np.array([targets.index(name) for name in kinds])
    plain = replace(predictions, calibration=Calibration(1.0, 0.3))
    replace(plain.of_objects(first), names=tuple(kinds), store="").save(tmp_path / "alone.npz")
    rows = first[[kinds.index(name) for name in targets]]
    replace(plain, logits=plain.logits[rows], labels=plain.labels[rows]).save(tmp_path / "worlds.npz")
    monkeypatch.setitem(SCRIPT["calibration"].__globals__, "LEAST", 1)
    SCRIPT["calibration"]((tmp_path / "worlds.npz",), (tmp_path / "alone.npz",), walks=20, samples=20)
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert {row[0].strip("| ") for row in rows} == {"light", "medium", "heavy", "any"}
    for _, _, _, n, accuracy, _, error, loss, nonsense in rows:
        assert int(n.split()[0]) > 0
        for cell in (accuracy, error, loss, nonsense.strip(" |")):
            ours, alone = cell.split(", ")
            assert ours == alone
    whole = [row for row in rows if row[0].strip("| ") == "any" and row[2] == "all"]
    assert [row[3].split()[0] for row in whole] == ["120"] * 4
