"""What is said of objects that nobody taught, and of known ones beside them.

    python -m benchmarks.strangers episodes data/ModelNet10 --split test --draws 3
        [--sensor wrist] [--aligned]
    python -m benchmarks.strangers episodes data/PSB --objects 300 --every-second
    python -m benchmarks.strangers episodes YCB --unit m [--models mine]
    python -m benchmarks.strangers episodes data/ModelNet10 --split test --objects 60 --around heavy

    python -m benchmarks.strangers shapes                      # 3, 6, 12 cm; the YCB objects
    python -m benchmarks.strangers shapes --shapes ball box rod can --radii 0.025 0.05 0.1 0.15
    python -m benchmarks.strangers shapes --models modelnet10 --radii 0.3 0.6    # furniture sizes

    nextview-lab render data/ModelNet10 views.zarr
    nextview-lab render data/PSB unseen.zarr
    python -m benchmarks.strangers views views.zarr unseen.zarr [--split test]
    python -m benchmarks.strangers maps unseen.zarr [--model lem-modelnet10]

``episodes``: how often whole episodes with all defaults end with a name, the right one, or
"unknown". Each object is turned about the vertical by a random angle, as real objects are, unless
``--aligned`` leaves it as its file has it. An episode begins at a random view. With ``--around``
the object stands among others of the folder, in drawn scenes of a level of clutter. "Most like"
also counts objects that were called unknown. ``--draws`` episodes are run with each object; each
has its own angle, first view and sensor noise.

``shapes``: the same for simple shapes: ball, box, rod, can, cone, capsule, ring, slab. Each stands
upright, turned at random, and is looked at through a sensor with all defaults, its size known. A
shape is marked (*) if the smallest box around it is, within a tenth along each axis, the size of
that around a taught thing of known geometry: it may be taken for that thing.

``views``: the novelty score alone. The classes of the second store must not be among the
recogniser's. Prints, after one, two, three and five random views, the area under the ROC curve of
the score, the share of known objects that are taken for unknown at the rates that were asked for
(calibrated on held-out training objects), the share of unknown ones that are caught, and what each
unknown class that is seldom caught is taken for. In brackets: 95 % of the bootstrap over objects.

``maps``: how well a map network does on objects of classes that it has never seen (the thesis's
third research question), beside the mean map of these very objects, over all views.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
import tyro
from numpy.typing import NDArray
from trimesh.bounds import oriented_bounds

import nextview
from benchmarks.shared import markdown, progress
from nextview.cli.exit_status import orderly_end
from nextview.data.folders import Entry, list_dataset
from nextview.errors import DatasetError, UsageError
from nextview.geometry.observation import Camera
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import rotation_z
from nextview.recognition.belief import log_evidence_of
from nextview.recognition.inference import Features, MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import RECOGNISER
from nextview.recognition.network_input import from_store
from nextview.session.session import FrameCamera
from nextview.simulation.sensed_camera import SensedCamera
from nextview.things.recogniser import VerifiedRecogniser
from nextview.types import Float
from nextview_lab.benchmark.statistics import interval, resample
from nextview_lab.data.measures import normalise_per_object
from nextview_lab.data.metrics import map_scores, ratio
from nextview_lab.data.scene_drawing import Meshes, draw_scene
from nextview_lab.data.store import ViewStore
from nextview_lab.worlds.robot_camera import Named, RobotCamera
from nextview_lab.worlds.scene import build_scene

BOOTSTRAP_SAMPLES = 1000
MOST_UNKNOWN_CLASSES = 5
REPORTED = ("unknown", "named right", "most like their class", "named and confident")

SHAPES = {
    "ball": lambda: trimesh.creation.icosphere(4),
    "box": lambda: trimesh.creation.box((1, 1, 1)),
    "rod": lambda: trimesh.creation.cylinder(0.06, 2, sections=64),
    "can": lambda: trimesh.creation.cylinder(0.5, 1.5, sections=64),
    "cone": lambda: trimesh.creation.cone(0.6, 1.4, sections=64),
    "capsule": lambda: trimesh.creation.capsule(1.5, 0.5),
    "ring": lambda: trimesh.creation.torus(1, 0.25),
    "slab": lambda: trimesh.creation.box((1.6, 1.1, 0.12)),
}
Key = tuple[str, float]  # name and radius of a shape

VIEWS = (1, 2, 3, 5)
RATES = (0.01, 0.05, 0.1)
HARD = 0.95  # share of an unknown class that is caught, below which the class is shown

PUBLISHED = (
    "published LEM, trained on 10 classes, tested on its own unseen ones (table 4): "
    "d <= 1 0.364"
)


def episodes(
    meshes: tyro.conf.Positional[Path],
    models: str = "modelnet10",
    objects: int = 10**6,
    split: str | None = None,
    every_second: bool = False,
    sensor: str | None = None,
    around: Literal["light", "medium", "heavy"] | None = None,
    named: Named = "mask",
    unit: str | None = None,
    aligned: bool = False,
    draws: int = 1,
    unknown: float | None = None,
    seed: int = 0,
) -> None:
    """Run episodes with the objects of a folder and print what they ended with.

    Args:
        meshes: folder of the objects.
        models: that recognise them.
        objects: so many, drawn.
        split: only the objects of this one.
        every_second: only every second class by the alphabet.
        sensor: that looks at them; none by default.
        around: how much stands around them.
        named: how the object is told from what stands around it.
        unit: of the meshes.
        aligned: do not turn the objects.
        draws: episodes with each object.
        unknown: significance level of the test for unknown objects.
        seed: of all draws.
    """
    system = nextview.load(models=models, unknown=unknown)
    entries = [entry for entry in list_dataset(meshes) if split in (None, entry.split)]
    if every_second:
        # Every second class by the alphabet: the other classes chose the novelty score.
        judged = sorted({entry.label for entry in entries})[1::2]
        entries = [entry for entry in entries if entry.label in judged]

    places = {
        entry.name: entry.path.relative_to(meshes).as_posix() for entry in entries
    }
    others = Meshes(meshes, tuple(sorted(places.values())))
    chosen = np.sort(np.random.default_rng(seed).permutation(len(entries))[:objects])
    entries = [entries[i] for i in chosen]

    def camera_before(
        entry: Entry,
        draw: int,
        rng: np.random.Generator,
    ) -> Camera | FrameCamera | None:
        if around is not None:
            scene = f"{entry.name}@{around}-{draw}"
            try:
                layout = draw_scene(places[entry.name], others, around, seed, scene)
            except DatasetError:  # no scene of this level was found around the object
                return None
            return RobotCamera(build_scene(layout, meshes), sensor or "none", named)

        mesh = nextview.load_mesh(entry.path, unit=unit)
        if not aligned:
            mesh = rotated(mesh, rotation_z(rng.uniform(0, 2 * np.pi)))
        if sensor is None:
            return nextview.SimulatedCamera(mesh)
        return SensedCamera(mesh, sensor, rng)

    # One row of outcomes for each object; each holds the means over its episodes.
    rows = []
    labels = []

    every = progress(entries, f"episodes of {meshes.name}")
    for number, entry in enumerate(every, 1):
        outcomes = []
        for draw in range(draws):
            rng = np.random.default_rng([seed, number, draw])
            camera = camera_before(entry, draw, rng)
            if camera is None:
                continue
            session = system.session_with(camera, None, int(rng.integers(2**32)))
            session.reachable = getattr(camera, "reachable", None)
            result = session.run(camera)
            most_like = entry.label == result.most_like
            named_right = most_like and not result.unknown
            sure = result.confident and not result.unknown
            outcomes.append(
                (result.unknown, named_right, most_like, sure, len(result.views))
            )
        if outcomes:
            rows.append(np.mean(outcomes, axis=0))
            labels.append(entry.label)
    table = np.array(rows)
    weights = resample(len(table), BOOTSTRAP_SAMPLES, np.random.default_rng(seed))
    low, high = interval(weights @ table / weights.sum(1, keepdims=True))

    print(f"{len(table)} objects, {draws} episodes each")
    for column, name in enumerate(REPORTED):
        mean = table[:, column].mean()
        print(f"{name:22} {mean:.3f} ({low[column]:.3f}-{high[column]:.3f})")
    print(f"{'views':22} {table[:, -1].mean():.2f}")

    of_class = np.array(labels)
    shares = {
        label: table[of_class == label, 0].mean() for label in sorted(set(labels))
    }
    most = sorted(shares, key=lambda label: -shares[label])[:MOST_UNKNOWN_CLASSES]
    print(
        "most often unknown: "
        + ", ".join(f"{label} {shares[label]:.3f}" for label in most)
    )


def write_shape(path: Path, name: str, radius: float, turn: float) -> Path:
    """Write a shape as a mesh file, metres; the radius is that of the sphere which holds it."""
    shape = SHAPES[name]()
    shape.apply_translation(-shape.bounds.mean(0))
    shape.apply_scale(radius / np.linalg.norm(shape.vertices, axis=1).max())
    shape.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
    shape.export(path)
    return path


def boxes_of_taught(system: nextview.System) -> list[Float]:
    """Float of the smallest boxes around the taught things of known geometry, metres, ascending."""
    recogniser = system.models.recogniser
    if not isinstance(recogniser, VerifiedRecogniser):
        return []
    surfaces = recogniser.things.verifier.caster.surfaces
    return [np.sort(oriented_bounds(surface.vertices)[1]) for surface in surfaces]


def is_like_taught(name: str, radius: float, taught: list[Float]) -> bool:
    """Whether the box around a shape is, within a tenth along each axis, that of a taught thing."""
    shape = SHAPES[name]()
    scale = radius / np.linalg.norm(shape.vertices - shape.bounds.mean(0), axis=1).max()
    sizes = scale * np.sort(oriented_bounds(shape.vertices)[1])
    return any(np.abs(np.log(sizes / own)).max() < np.log(1.1) for own in taught)


def shapes(
    models: str = "ycb",
    shapes: tuple[str, ...] = tuple(SHAPES),
    radii: tuple[float, ...] = (0.03, 0.06, 0.12),
    draws: int = 1,
    sensor: str = "wrist",
    seed: int = 0,
) -> None:
    """Print a table: what each shape of each size is called.

    Args:
        models: which know none of the shapes by name.
        shapes: names of the shapes that are shown.
        radii: of the spheres that hold the shapes, metres.
        draws: of the azimuth, the first view and the sensor's errors, for each shape of each size.
        sensor: through which they are looked at.
        seed: of all draws.
    """
    strange = sorted(set(shapes) - set(SHAPES))
    if strange:
        raise UsageError(
            f"no shape is called {strange[0]}; there are {', '.join(SHAPES)}"
        )
    system = nextview.load(models=models, threads=1)
    taught = boxes_of_taught(system)
    rng = np.random.default_rng(seed)
    asked = [
        (name, radius) for name in shapes for radius in radii for _ in range(draws)
    ]
    found: dict[Key, list[nextview.Recognition]] = {}

    with tempfile.TemporaryDirectory() as folder:
        for name, radius in progress(asked, f"shapes before {models}"):
            turn = rng.uniform(0, 2 * np.pi)
            path = write_shape(Path(folder) / f"{name}.ply", name, radius, turn)
            result = system.recognise(
                path,
                seed=int(rng.integers(2**32)),
                unit="m",
                sensor=sensor,
            )
            found.setdefault((name, radius), []).append(result)
    like = {key for key in found if is_like_taught(*key, taught)}
    print(shapes_table(found, radii, like))


def shapes_table(
    found: dict[Key, list[nextview.Recognition]],
    radii: tuple[float, ...],
    like: set[Key],
) -> str:
    """What was said, as text: names of confident answers in bold; ``like`` marks some shapes."""
    rows = []
    for name in dict.fromkeys(name for name, _ in found):
        cells = []
        for radius in radii:
            answers = ", ".join(said(result) for result in found[name, radius])
            cells.append(f"{answers} (*)" if (name, radius) in like else answers)
        rows.append([name, *cells])

    lines = [
        markdown(["shape", *(f"{100 * radius:g} cm" for radius in radii)], rows),
        "",
        counts(
            {key: found[key] for key in found if key not in like},
            "of no taught size",
        ),
    ]
    if like:
        lines.append(
            counts(
                {key: found[key] for key in like},
                "of the size of a taught thing (*)",
            )
        )
    return "\n".join(lines)


def counts(found: dict[Key, list[nextview.Recognition]], what: str) -> str:
    """How many episodes with some shapes end with a name, in words."""
    results = [result for each in found.values() for result in each]
    named = sum(result.answer is not None for result in results)
    sure = sum(result.confident for result in results)
    some = sum(
        any(result.answer is not None for result in each) for each in found.values()
    )
    return (
        f"{len(results)} episodes with shapes {what}: {named} end with a name, {sure} of them"
        f" confident. {some} of {len(found)} shapes get a name at least once."
    )


def said(result: nextview.Recognition) -> str:
    """What an episode ended with."""
    if result.answer is None:
        return "unknown"
    return f"**{result.answer}**" if result.confident else result.answer


@dataclass(frozen=True)
class Judged:
    """What the recogniser gives for some views of N objects, in random order.

    Attributes:
        labels: classes, (N,) strings.
        scores: novelty, (N, views).
        evidence: that can be summed over views, (N, views, D).
    """

    labels: NDArray[np.str_]
    scores: NDArray[np.float64]
    evidence: NDArray[np.float64]

    def after(self, n_views: int) -> NDArray[np.float64]:
        """Mean scores over disjoint runs of so many views, (N, runs)."""
        runs = self.scores.shape[1] // n_views
        return (
            self.scores[:, : runs * n_views]
            .reshape(len(self.scores), runs, n_views)
            .mean(2)
        )


def judge(
    store: Path,
    split: str | None,
    objects: int | None,
    recogniser: NetworkRecogniser,
    seed: int,
) -> Judged:
    views = ViewStore.open(store)
    rng = np.random.default_rng(seed)
    chosen = np.flatnonzero(views.done & ((views.splits == split) if split else True))
    chosen = np.sort(rng.permutation(chosen)[:objects])
    drawn = np.array(
        [rng.permutation(len(views.sphere))[: 2 * max(VIEWS)] for _ in chosen]
    )
    scores = []
    evidence = []
    features = Features()
    exact = views.attributes.sensor is None

    for k, i in enumerate(progress(chosen, f"views of {views.path.name}")):
        inputs = from_store(recogniser.card.input, views, int(i), drawn[k])
        found = recogniser.from_inputs(inputs)
        known = features.card.input == recogniser.card.input
        seen = features(
            inputs
            if known
            else from_store(features.card.input, views, int(i), drawn[k])
        )
        scores.append(recogniser.novelty.scores(seen, exact))
        evidence.append(
            log_evidence_of(
                found.logits,
                found.azimuth_bins,
                views.sphere.azimuth[drawn[k]],
            )
        )
    labels = np.array([views.classes[label] for label in views.labels[chosen]])
    return Judged(labels, np.array(scores), np.array(evidence, np.float64))


def roc_area(
    known: NDArray,
    unknown: NDArray,
    of_known: NDArray,
    of_unknown: NDArray,
) -> float:
    """Area under the ROC curve: how often an unknown object scores higher than a known one, equal
    scores half.

    Args:
        known, unknown: scores, (N, draws) and (M, draws).
        of_known, of_unknown: weights of the objects, (N,) and (M,).
    """
    k = known.ravel()
    u = unknown.ravel()
    weights = np.repeat(of_known, known.shape[1])
    order = np.argsort(k)
    below = np.r_[0, np.cumsum(weights[order])]
    at = (
        below[np.searchsorted(k[order], u, "left")]
        + below[np.searchsorted(k[order], u, "right")]
    ) / 2
    of_each = np.repeat(of_unknown, unknown.shape[1])
    return float(at @ of_each / weights.sum() / of_each.sum())


def views(
    known: tyro.conf.Positional[Path],
    unknown: tyro.conf.Positional[Path],
    split: str = "test",
    objects: int | None = None,
    recogniser: str = RECOGNISER,
    samples: int = 1000,
    seed: int = 0,
) -> None:
    """Print what the novelty score tells of known objects, and of objects of no known class.

    Args:
        known: store of known objects.
        unknown: store of objects of no known class.
        split: of the known objects.
        objects: so many unknown ones; None for all.
        recogniser: name or card.
        samples: of the bootstrap.
        seed: of views and the bootstrap.
    """
    network = NetworkRecogniser(recogniser)
    if network.novelty is None:
        raise SystemExit(
            f"{recogniser} cannot tell unknown objects; nextview-lab fit unknown teaches it"
        )
    ours = judge(known, split, None, network, seed)
    others = judge(unknown, None, objects, network, seed)
    print(
        f"{len(ours.labels)} known objects, {len(others.labels)} of {len(set(others.labels))}"
        " unknown classes\n"
    )
    rng = np.random.default_rng(seed)
    of_ours, of_others = (
        resample(len(each.labels), samples, rng) for each in (ours, others)
    )
    ones = np.ones(len(ours.labels)), np.ones(len(others.labels))

    def spread(values: list[float]) -> str:
        (low,), (high,) = interval(np.array(values)[:, None])
        return f"({low:.3f}-{high:.3f})"

    print(
        "| views | ROC area | known rejected, unknown caught at "
        + " | at ".join(f"{r:.0%}" for r in RATES)
        + " |"
    )
    print("|---|---|" + "---|" * len(RATES))
    for n in VIEWS:
        a = ours.after(n)
        b = others.after(n)
        area = roc_area(a, b, *ones)
        drawn = [roc_area(a, b, v, w) for v, w in zip(of_ours, of_others, strict=True)]
        cells = [f"{area:.3f} {spread(drawn)}"]
        for rate in RATES:
            shares = []
            for scores, weights in ((a, of_ours), (b, of_others)):
                flagged = (network.novelty.p_value(scores, n) < rate).mean(1)
                shares.append(
                    f"{flagged.mean():.3f} {spread(list((weights @ flagged) / weights.sum(1)))}"
                )
            cells.append(", ".join(shares))
        print(f"| {n} | " + " | ".join(cells) + " |")

    def answers(judged: Judged, n: int) -> NDArray[np.int64]:
        classes = len(network.classes)
        return network.calibration.log_belief(
            judged.evidence[:, :n].sum(1),
            n,
            classes,
        ).argmax(1)

    caught = {
        n: network.novelty.p_value(others.scores[:, :n].mean(1), n) < 0.05
        for n in (1, 3)
    }
    taken = answers(others, 3)
    print(f"\nUnknown classes of which less than {HARD:.0%} are caught after 3 views:")
    print(
        "\n| unknown class | objects | caught after 1 view | after 3 | most like, after 3"
        " |\n|---|---|---|---|---|"
    )
    classes = ((label, others.labels == label) for label in sorted(set(others.labels)))
    for label, here in (
        (label, here) for label, here in classes if caught[3][here].mean() < HARD
    ):
        most = Counter(network.classes[c] for c in taken[here]).most_common(3)
        named = ", ".join(f"{name} {count}" for name, count in most)
        print(
            f"| {label} | {here.sum()} | {caught[1][here].mean():.2f} |"
            f" {caught[3][here].mean():.2f} | {named} |"
        )
    right = answers(ours, 3) == np.array(
        [network.classes.index(label) for label in ours.labels]
    )
    kept = network.novelty.p_value(ours.scores[:, :3].mean(1), 3) >= 0.05
    print(
        f"\nknown objects after 3 views: right {right.mean():.3f}; of those not taken for unknown"
        f" at 5 %, {right[kept].mean():.3f}; of those taken for unknown, {right[~kept].mean():.3f}"
    )


def maps(
    store: tyro.conf.Positional[Path],
    model: str = "lem-modelnet10",
    samples: int = 2000,
    seed: int = 0,
) -> None:
    """Print how well a map network does on objects of unseen classes.

    Args:
        store: views of objects of unseen classes.
        model: the map network, by name or card.
        samples: of the bootstrap over objects.
        seed: of the bootstrap.
    """
    from nextview_lab.benchmark.evaluation import baselines

    views = ViewStore.open(store)
    network = MapNetwork(model)
    objects = np.flatnonzero(views.done)
    predicted = np.empty(
        (len(objects), len(views.sphere), views.sphere.rings, 3),
        np.float32,
    )

    for row, i in enumerate(progress(objects, f"maps of {views.path.name}")):
        inputs = from_store(network.card.input, views, int(i))
        predicted[row] = network.from_inputs(inputs)[network.card.kind]
    true = normalise_per_object(views.measure()[objects])[:, views.sphere.windows]
    labels = views.labels[objects]

    def flat(values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, *values.shape[2:])

    print(
        f"{len(objects)} objects of {len(views.classes)} classes, {len(views.sphere)} views each;"
        f" {PUBLISHED}\n"
    )
    print(
        f"{'':22}{'objects':>8}{'MSE':>9}{'d = 0':>8}{'d <= 1':>8}{'d < 2':>8}{'regret':>8}"
    )
    rows = {"all": (predicted, true)}
    rows["baselines: mean map"] = (baselines(true, labels)["mean map"], true)
    for name, (log_evidence, right) in rows.items():
        scores = map_scores(flat(log_evidence), flat(right))
        print(
            f"{name:22}{len(right):8}{scores['mse']:9.4f}",
            *(f"{v:7.3f}" for k, v in scores.items() if k != "mse"),
        )
    near = np.array(
        [map_scores(m, t)["d_le_1"] for m, t in zip(predicted, true, strict=True)]
    )
    weights = resample(len(objects), samples, np.random.default_rng(seed))
    (low,), (high,) = interval(ratio(near[:, None], np.ones((len(near), 1)), weights))
    print(
        f"\nd <= 1 of all: {near.mean():.3f}, 95 % of the bootstrap over objects {low:.3f} .."
        f" {high:.3f}"
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.extras.subcommand_cli_from_dict(
            {"episodes": episodes, "shapes": shapes, "views": views, "maps": maps}
        )
