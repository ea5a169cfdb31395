"""How many cores are used: one setting, on which no answer depends."""

import numpy as np
from factories import camera_over, meshes_of, view

import nextview
from nextview.cores import CORES
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.inference import NetworkRecogniser
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.surface import SurfaceCaster
from nextview.things.visible_points import VisiblePoints

COUNTS = (1, 2, 5)


def with_each_count(monkeypatch, answer):
    """What is answered with each number of cores."""
    found = []
    for count in COUNTS:
        monkeypatch.setenv(CORES, str(count))
        found.append(answer())
    return found


def test_networks_and_points_answer_alike_with_any_number(monkeypatch, ycb):
    camera = SimulatedCamera(sample_mesh("chair"))
    seen = [camera.observe(pose) for pose in ViewSphere.named("40").poses[:3]]
    said = with_each_count(monkeypatch, lambda: NetworkRecogniser()(seen))
    for one in said[1:]:
        np.testing.assert_array_equal(one.logits, said[0].logits)
        np.testing.assert_array_equal(one.azimuth_bins, said[0].azimuth_bins)

    surfaces = ycb.models.recogniser.library.caster.surfaces
    few = SurfaceCaster(surfaces[5:8])
    drawn = with_each_count(monkeypatch, lambda: VisiblePoints(few, 0))
    for one in drawn[1:]:
        np.testing.assert_array_equal(one.points, drawn[0].points)
        np.testing.assert_array_equal(one.normals, drawn[0].normals)


def test_a_scene_answers_alike_with_any_number(monkeypatch, ycb):
    names = ("mustard_bottle", "tuna_fish_can", "banana")
    camera = camera_over(list(meshes_of(names).values()), seed=11)
    frame = camera.frame(view(70))

    def answer():
        scene = nextview.Scene(ycb, segmentation=lambda frame: camera.owner + 1)
        scene.update(frame)
        return scene.objects

    first, *others = with_each_count(monkeypatch, answer)
    assert len(first) == 3
    for objects in others:
        for one, before in zip(objects, first, strict=True):
            assert one.beliefs == before.beliefs
            assert one.confident == before.confident
            np.testing.assert_array_equal(one.pose, before.pose)
