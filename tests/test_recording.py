"""A recording holds what the session held: read back by Rerun's own reader."""

import numpy as np
import pytest

pytest.importorskip("rerun", reason="the extra 'record' is not installed")

from rerun.chunk import RrdReader

import nextview
from nextview.data.samples import sample_mesh
from nextview.sensing.observation import Observation
from nextview.session.system import simulated
from nextview.viewers.recording import Recorder


class Recording:
    """The rows of a recording by entity, component and step; the last one that was written
    counts.
    """

    def __init__(self, path):
        self.rows = {}
        # by time
        chunks = sorted(
            RrdReader(path).stream().to_chunks(), key=lambda chunk: str(chunk.id)
        )
        for chunk in chunks:
            if chunk.is_static:
                continue
            batch = chunk.to_record_batch().to_pydict()
            for row, step in enumerate(batch["step"]):
                for component, values in batch.items():
                    if ":" in component:
                        self.rows.setdefault(
                            (chunk.entity_path.strip("/"), component), {}
                        ).setdefault(step, [])
                        self.rows[chunk.entity_path.strip("/"), component][step].append(
                            values[row]
                        )

    def at(self, entity, component, step):
        return np.asarray(self.rows[entity, component][step][-1])

    def steps(self, entity, component):
        return sorted(self.rows[entity, component])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An episode of several views, and its recording."""
    path = tmp_path_factory.mktemp("recorded") / "episode.rrd"
    session = nextview.load(threshold=0.9999, max_views=3, threads=1).session(start=3)
    session.observers.append(Recorder(path))
    result = session.run(simulated(sample_mesh("table"), "kinect"))
    assert len(result.views) > 1
    return session, result, Recording(path)


def test_belief_and_travel_over_the_steps(made):
    session, result, recording = made
    steps = list(range(1, len(result.views) + 1))
    for step, view in zip(steps, result.views, strict=True):
        for name, belief in zip(result.classes, view.belief, strict=True):
            assert recording.at(f"belief/{name}", "Scalars:scalars", step) == [belief]
        assert recording.at("travel/cells", "Scalars:scalars", step) == [view.travel]
        assert recording.at("travel/radians", "Scalars:scalars", step) == [view.arc]
        assert recording.at("threshold", "Scalars:scalars", step) == [
            session.stopping.threshold_at(step)
        ]
        for name, values in (
            ("belief_now", view.belief),
            ("this_view_alone", view.alone),
        ):
            np.testing.assert_array_equal(
                recording.at(name, "BarChart:values", step)[0]["buffer"], values
            )
    assert recording.steps("belief/chair", "Scalars:scalars") == steps


def test_candidates_values_and_choices(made):
    session, result, recording = made
    poses = session.sphere.poses[:, :3, 3]
    for step, view in enumerate(result.views, 1):
        shown = np.array(
            recording.at("world/candidates", "Points3D:positions", step).tolist()
        )
        np.testing.assert_allclose(shown, poses, atol=1e-6)
        chosen = np.array(
            recording.at("world/next", "Points3D:positions", step).tolist()
        ).reshape(-1, 3)
        np.testing.assert_allclose(
            chosen, poses[[] if view.next_view is None else [view.next_view]], atol=1e-6
        )
        values = np.array(recording.at("values", "BarChart:values", step)[0]["buffer"])
        if view.values is None:
            assert len(values) == 0
        else:
            np.testing.assert_array_equal(values, view.values[np.isfinite(view.values)])
        for name, expected in view.maps.items():
            tensor = recording.at(f"maps/{name}", "Tensor:data", step)[0]
            assert tensor["shape"] == list(expected.shape)
            np.testing.assert_array_equal(np.array(tensor["buffer"]), expected.ravel())
    (last,) = recording.at("log", "TextLog:text", len(result.views)).tolist()
    assert last == f"done: {result!r}"


def test_a_recording_under_way_can_be_read_and_one_that_is_closed_is_complete(tmp_path):
    path = tmp_path / "a.rrd"
    session = nextview.load(max_views=2, threads=1).session(start=3)
    session.observers.append(Recorder(path))
    seen = simulated(sample_mesh("table")).observe(session.pose)
    session.update(Observation(np.zeros_like(seen.depth), seen.pose, seen.intrinsics))
    with pytest.warns(Warning, match="no footer"):  # as long as it is not complete
        recording = Recording(path)
    assert (
        len(recording.at("world/seen/1", "Points3D:positions", 1)) == 0
    )  # nothing was seen
    (recorder,) = session.observers
    recorder.close()
    size = path.stat().st_size
    assert Recording(path).rows.keys() == recording.rows.keys()
    session.update(seen)  # goes on, unrecorded
    assert path.stat().st_size == size
