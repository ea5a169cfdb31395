"""The side from which a view sees its object, and learning on from an exported recogniser."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lightning")

from nextview.cameras.simulated import SimulatedCamera  # noqa: E402
from nextview.data.folders import Entry  # noqa: E402
from nextview.data.rendering import Deform, render, render_object, turns  # noqa: E402
from nextview.data.store import DONE, ViewStore  # noqa: E402
from nextview.errors import ModelError  # noqa: E402
from nextview.mesh import make_mesh  # noqa: E402
from nextview.models.inference import RECOGNISER, MapNetwork, Recogniser  # noqa: E402
from nextview.models.model_card import find_card  # noqa: E402
from nextview.training.architectures import ResNet, ViewMap  # noqa: E402
from nextview.training.checkpoints import exported_networks, load_exported, refuse_seen  # noqa: E402
from nextview.training.hardware import Hardware  # noqa: E402
from nextview.training.maps import map_module as maps  # noqa: E402
from nextview.training.recipes import MapRecipe  # noqa: E402
from nextview.training.recogniser.azimuth_bins import azimuth_bins, mirror_planes, side_loss  # noqa: E402
from nextview.viewsphere import ViewSphere  # noqa: E402

SPHERE = ViewSphere((0.0, 30.0), 8, 3.0)


def measured_store(path, values, labels, facts=None):
    """A store of which only the depth-entropy of the views matters."""
    entries = [Entry(path / f"{i}.off", f"object_{i}", "abcdef"[label], "train") for i, label in enumerate(labels)]
    store = ViewStore.create(path / "views.zarr", entries, SPHERE, 16, facts or {})
    store.group["measures/depth_entropy"][:] = values
    store.group["status"][:] = DONE
    return store


def test_the_mirror_plane_is_the_one_that_maps_the_views_into_each_other(tmp_path):
    rng = np.random.default_rng(0)
    azimuth = np.arange(8)
    labels = np.repeat([0, 1, 2], 5)
    values = []
    for plane in labels:  # class k is its own mirror image in the plane at k steps: values depend on the distance to it
        profile = rng.random((2, 5))
        distance = np.minimum((azimuth - plane) % 8, (plane - azimuth) % 8)
        values.append(profile[:, distance].ravel())
    store = measured_store(tmp_path, np.array(values), labels)
    assert mirror_planes(store, np.arange(15)).tolist() == [0, 1, 2]
    assert azimuth_bins(store, 8, np.array([0.0, 1.0, 2.0])).reshape(15, 2, 8)[:, :, 0].tolist() == [
        [(-label) % 8] * 2 for label in labels
    ]


def test_a_turned_object_is_seen_from_the_side_that_its_turn_says():
    """The mesh is turned back by the angle and views as if it had never been turned."""
    mesh = make_mesh(
        np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0.7]], float), np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3]])
    )
    turned = Deform(turn=True)(mesh, 5, "chair_1")
    _, angle = Deform(turn=True).draw(5, "chair_1")
    c, s = np.cos(-angle), np.sin(-angle)
    back = make_mesh(turned.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T, mesh.faces)
    cameras = (SimulatedCamera(m, 32, SPHERE.distance) for m in (mesh, back))
    a, b = (render_object(camera, SPHERE, 32)["depth"].astype(int) for camera in cameras)
    assert (np.abs(a - b) > 3).mean() < 0.01


def test_the_turns_of_a_store_are_those_of_its_rendering(tmp_path):
    folder = tmp_path / "meshes/cone/train"
    folder.mkdir(parents=True)
    (folder / "cone_0001.off").write_text(
        "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"
    )
    list(render(tmp_path / "meshes", tmp_path / "plain.zarr", SPHERE, 32, workers=1))
    list(render(tmp_path / "meshes", tmp_path / "turned.zarr", SPHERE, 32, seed=3, deform=Deform(turn=True), workers=1))
    assert turns(ViewStore.open(tmp_path / "plain.zarr")).tolist() == [0]
    store = ViewStore.open(tmp_path / "turned.zarr")
    angle = turns(store)[0]
    assert angle == Deform(turn=True).draw(3, store.names[0])[1]
    # Views of the turned object from between two viewpoints: the side moves by the same angle the other way.
    assert azimuth_bins(store, 8, np.zeros(1))[0, 0] == pytest.approx((-angle / (2 * np.pi / 8)) % 8, abs=1e-4)


def test_the_side_between_two_steps_counts_by_nearness():
    torch.manual_seed(0)
    likely = torch.randn(3, 4, 8).log_softmax(2)
    label, side = torch.tensor([0, 3, 1]), torch.tensor([2.0, 5.25, 7.5])
    expected = -(
        likely[0, 0, 2]
        + 0.75 * likely[1, 3, 5]
        + 0.25 * likely[1, 3, 6]
        + 0.5 * likely[2, 1, 7]
        + 0.5 * likely[2, 1, 0]
    )
    assert side_loss(likely, label, side) == pytest.approx(float(expected) / 3, rel=1e-5)


def test_a_network_of_sides_answers_with_likelihoods_of_each_class():
    logits, likely = ResNet(18, 3, 4, azimuths=8).eval()(torch.rand(2, 4, 64, 64))
    assert (logits.shape, likely.shape) == ((2, 3), (2, 3, 8))
    assert torch.allclose(likely.exp().sum(2), torch.ones(2, 3), atol=1e-5)


def bundled():
    return Path(find_card(RECOGNISER).path).with_suffix(".json")


@pytest.fixture(scope="module")
def boxes():
    """Views of objects that have edges, faces and background."""
    rng = np.random.default_rng(0)
    views = np.zeros((16, 4, 112, 112), np.uint8)
    for view in views:
        for _ in range(4):
            top, left = rng.integers(10, 60, 2)
            view[:, top : top + 40, left : left + 40] = rng.integers(1, 255, 4)[:, None, None]
    return views


def test_a_network_goes_on_from_the_exported_one(boxes):
    exported = Recogniser(bundled())
    views = torch.from_numpy(boxes).float() / 255
    networks = exported_networks(bundled(), 4, views)
    wanted = exported.from_inputs(boxes).logits
    with torch.no_grad():
        kept = torch.stack([network.eval()(views)[0] for network in networks]).mean(0).numpy()
        moving = torch.stack([network.train()(views)[0] for network in networks]).mean(0).numpy()
    assert np.abs(kept - wanted).max() < 0.02
    assert np.abs(moving - wanted).max() < 0.1  # its norms have the moments of what they see
    first = networks[0].conv1.weight
    assert first.std().item() == pytest.approx((2 / (64 * 49)) ** 0.5, rel=0.01)
    alone = ResNet(18, 10, 4, azimuths=8)  # the only one of its kind there
    load_exported(alone, bundled(), views)
    assert torch.equal(alone.conv1.weight, first)
    assert torch.equal(alone.fc.weight, networks[0].fc.weight)


def test_a_map_network_starts_from_what_the_recogniser_knows(boxes, tmp_path):
    sphere = ViewSphere.named("40")
    seen = np.random.default_rng(0).choice(boxes[:, :, ::2, ::2], (4, 40))
    values = np.random.default_rng(1).random((4, 40)).astype(np.float32)
    recipe = MapRecipe(epochs=1, views=4, batch=4, lr=1e-9)
    objects = np.arange(4)
    hardware = Hardware(precision="32-true")
    network = maps.fit_map(seen, values, sphere, objects[:3], objects[3:], recipe, tmp_path, hardware, bundled())
    begun = ResNet(18, 10, 4)
    load_exported(begun, bundled(), torch.from_numpy(boxes[:, :, ::2, ::2].copy()).float() / 255)
    for name in ("conv1", "layer2.0.conv1", "layer4.1.conv2"):
        ours, theirs = (net.get_submodule(name).weight for net in (network.resnet, begun))
        assert torch.allclose(ours, theirs, atol=1e-6)
    assert network.resnet.fc.weight.shape == (40, 512)
    cloud = replace(recipe, input="cloud")
    with pytest.raises(ModelError, match="a PointNet cannot start from a ResNet"):
        maps.fit_map(seen, values, sphere, objects[:3], objects[3:], cloud, tmp_path / "cloud", hardware, bundled())


def test_a_map_network_goes_on_from_an_exported_one(boxes, tmp_path):
    lem = Path(find_card("lem-modelnet10").path).with_suffix(".json")
    begun, views = ViewMap(5, 8, 18, 4), torch.from_numpy(boxes).float() / 255
    load_exported(begun.resnet, lem, views, kinds=("lem",))
    with torch.no_grad():
        output = begun.eval()(views)[0].numpy()
    wanted = MapNetwork(lem).from_inputs(boxes)["lem-sphere"]
    assert np.abs(output - wanted).max() < 0.02
    assert np.ptp(wanted) > 0.1
    sphere, values = ViewSphere.named("40"), np.random.default_rng(1).random((4, 40)).astype(np.float32)
    seen = np.random.default_rng(0).choice(boxes[:, :, ::2, ::2], (4, 40))
    recipe = MapRecipe(epochs=1, views=4, batch=4, lr=1e-9, output="sphere")
    hardware = Hardware(precision="32-true")
    network = maps.fit_map(seen, values, sphere, np.arange(3), np.array([3]), recipe, tmp_path, hardware, lem)
    assert torch.allclose(network.resnet.fc.weight, begun.resnet.fc.weight, atol=1e-6)


def test_other_classes_keep_a_last_layer_of_their_own(boxes):
    network = ResNet(18, 3, 4)
    before = network.fc.weight.clone()
    load_exported(network, bundled(), torch.from_numpy(boxes[:2]).float() / 255)
    assert torch.equal(network.fc.weight, before)


@pytest.mark.parametrize(("depth", "channels"), [(34, 4), (18, 1)], ids=["depth", "input"])
def test_another_network_is_refused(boxes, depth, channels):
    with pytest.raises(ModelError, match="not one network of this depth and input"):
        load_exported(ResNet(depth, 10, channels), bundled(), torch.zeros(2, channels, 64, 64))


def test_a_recogniser_does_not_go_on_from_a_map_network():
    card = Path(find_card("lem-modelnet10").path).with_suffix(".json")
    with pytest.raises(ModelError, match="is a lem, not a recogniser"):
        load_exported(ResNet(18, 10, 4), card, torch.zeros(2, 4, 64, 64))


def test_a_network_that_has_seen_what_is_to_be_kept_is_refused():
    held_out = list(find_card(bundled()).held_out)
    refuse_seen(bundled(), held_out[:50])
    refuse_seen(bundled(), ["another", "dataset"])
    with pytest.raises(ModelError, match=r"was trained on 1 of the 3 objects .* mug_0001 among them; take the --seed"):
        refuse_seen(bundled(), [*held_out[:2], "mug_0001"])
