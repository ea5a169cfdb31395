"""How large an object is counts for its class where it is known, and nowhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from factories import change_card, make_recogniser
from lab_programs import main, refused
from pipeline import train_predictions
from scipy.stats import norm

from nextview.errors import DatasetError
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.inference import NetworkRecogniser
from nextview.recognition.model_card import read_card
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.predicting import predict
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.rendering import RenderOptions, render
from nextview_lab.data.store import ViewStore
from nextview_lab.training.card_fits import ANY_SIZE, RADII, densities, fit_weight

SPHERE = ViewSphere.named("40")
CLASSES = ["big", "small"]


@pytest.fixture(scope="module")
def shop(tmp_path_factory):
    """Balls of two classes that differ in nothing but their size, in centimetres, and a
    recogniser.
    """
    folder, rng = tmp_path_factory.mktemp("shop"), np.random.default_rng(0)
    for label, radius in (("big", 80), ("small", 20)):
        for i in range(8):
            path = (
                folder
                / f"meshes/{label}/{'train' if i < 6 else 'test'}/{label}_{i}.off"
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            trimesh.creation.icosphere(2, radius * rng.uniform(0.8, 1.25)).export(path)
    list(render(folder / "meshes", folder / "views.zarr", SPHERE, 32, workers=0))
    change_card(
        make_recogniser(folder, CLASSES),
        held_out=["big_0", "big_1", "small_0", "small_1"],
    )
    return folder


def test_a_density_is_that_of_its_class_and_a_share_of_anything():
    rng = np.random.default_rng(0)
    radii = np.exp(
        np.concatenate(
            [rng.normal(np.log(0.1), 0.1, 500), rng.normal(np.log(2), 0.1, 500)]
        )
    )
    found = densities(radii, np.repeat([0, 1], 500), 2)
    span = np.log(RADII[-1] / RADII[0])
    share = np.exp(found).mean(1) * span  # under the curve
    assert share == pytest.approx([1, 1], rel=0.03)
    near = np.abs(RADII - 0.1).argmin()
    wanted = 0.95 * norm.pdf(
        np.log(RADII[near]),
        np.log(0.1),
        np.hypot(0.1, 0.1 * 500**-0.2),
    )
    assert np.exp(found[0, near]) == pytest.approx(wanted, rel=0.15)
    assert np.exp(found[1, near]) == pytest.approx(ANY_SIZE / span)
    strays = np.concatenate([radii[:500], np.full(20, 15.0)])  # drawn in another unit
    blurred = densities(strays, np.repeat(0, 520), 1)[0, near]
    assert np.exp(blurred) == pytest.approx(wanted * 500 / 520, rel=0.15)
    with pytest.raises(ValueError, match="objects of several sizes"):
        densities(radii[:3], np.array([0, 0, 1]), 2)


def test_the_weight_is_the_most_likely_one():
    """Log-odds of the shape and of the size that are both calibrated add up as they are."""
    rng = np.random.default_rng(0)
    n = 4000
    labels = rng.integers(0, 2, n)
    logs = rng.normal(np.log([0.3, 0.6])[labels], 0.5)
    density = norm.logpdf(np.log(RADII)[None], np.log([[0.3], [0.6]]), 0.5)
    # log-odds of the first class
    shape = rng.normal(np.where(labels == 0, 1, -1), np.sqrt(2))
    # three views, all alike
    logits = np.stack([shape, np.zeros(n)], 1)[:, None].repeat(3, 1).astype(np.float32)
    data = train_predictions(logits, labels, ViewSphere((0.0,), 3), ("a", "b"))
    evidence, before, after = fit_weight(data, np.exp(logs), density)
    assert evidence.weight == pytest.approx(1, abs=0.15)
    alone = np.log1p(np.exp(np.where(labels == 0, -shape, shape)))
    assert before == pytest.approx(
        np.mean([alone[labels == c].mean() for c in (0, 1)]),
        rel=1e-4,
    )
    assert after < before - 0.1
    assert fit_weight(data, np.exp(rng.permutation(logs)), density)[
        0
    ].weight == pytest.approx(0, abs=0.1)


def test_from_the_meshes_to_the_belief(shop, tmp_path, capsys):
    views, card, honest = (
        str(shop / "views.zarr"),
        str(shop / "tiny.json"),
        str(tmp_path / "held-out.npz"),
    )
    assert np.isnan(ViewStore.open(views).radii).all()
    main(["predict", views, honest, "--held-out", card, "--recogniser", card, "--maps"])
    assert "--unit" in refused(capsys, "fit", "size", views, honest, card)
    render_line = ["render", str(shop / "meshes"), views, "--size", "32"]
    main([*render_line, "--unit", "cm", "--workers", "0"])
    radii = dict(
        zip(ViewStore.open(views).names, ViewStore.open(views).radii, strict=True)
    )
    assert radii["small_3"] == pytest.approx(
        load_mesh(shop / "meshes/small/train/small_3.off", unit="cm").metres
    )
    assert 0.15 < radii["small_3"] < 0.26
    with pytest.raises(DatasetError, match="measured in cm, not m"):
        list(
            render(
                shop / "meshes",
                Path(views),
                SPHERE,
                32,
                workers=0,
                options=RenderOptions(unit="m"),
            )
        )

    test = shop / "test.npz"
    list(predict(Path(views), test, read_card(Path(card)), {}, "test", workers=0))
    by_shape = Predictions.load(test)
    assert by_shape.of_size is None
    main(["fit", "size", views, honest, card])
    assert (
        read_card(Path(card))
        .fitted_to["size"]
        .startswith("8 objects of the training split, ")
    )
    list(
        predict(
            Path(views),
            test,
            read_card(Path(card)),
            {},
            "test",
            workers=0,
            overwrite=True,
        )
    )
    known = Predictions.load(test)
    assert (known.logits.argmax(2) == known.labels[:, None]).all()
    np.testing.assert_allclose(known.by_shape().logits, by_shape.logits, atol=1e-5)
    list(
        predict(
            Path(views),
            test,
            read_card(Path(card)),
            {},
            "test",
            size=False,
            workers=0,
            overwrite=True,
        )
    )
    np.testing.assert_allclose(
        Predictions.load(test).logits,
        by_shape.logits,
        atol=1e-5,
    )
    list(
        predict(
            Path(views),
            tmp_path / "new.npz",
            read_card(Path(card)),
            {},
            "test",
            workers=0,
        )
    )
    np.testing.assert_allclose(
        Predictions.load(tmp_path / "new.npz").logits,
        known.logits,
        atol=1e-5,
    )

    recogniser = NetworkRecogniser(card)
    path = shop / "meshes/small/test/small_7.off"
    n_views = [
        SimulatedCamera(load_mesh(path, unit=unit), 32).observe(SPHERE.poses[9])
        for unit in ("cm", None)
    ]
    assert [observation.radius for observation in n_views] == [
        pytest.approx(radii["small_7"]),
        None,
    ]
    row = known.names.index("small_7")
    found = recogniser(n_views).logits
    # depth is rounded
    np.testing.assert_allclose(
        found,
        [known.logits[row, 9], by_shape.logits[row, 9]],
        atol=2e-3,
    )
    strange = tmp_path / "strange.npz"
    replace(Predictions.load(honest), names=("a", "b", "c", "d")).save(strange)
    assert "holds 'a'" in refused(capsys, "fit", "size", views, strange, card)
