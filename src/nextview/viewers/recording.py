"""Record a session for the Rerun viewer."""

from pathlib import Path
from uuid import uuid4

import numpy as np

from nextview.checks import extras
from nextview.errors import UsageError
from nextview.figures.style import ACCENT, INK, heat, rgb
from nextview.session.session import Session
from nextview.session.view import View

with extras():
    import rerun as rr
    import rerun.blueprint as rrb

TIMELINE = "step"


class Recorder:
    """Recorder of a session; add it to ``Session.observers``, or call it with a session.

    On the timeline ``step`` the file contains, in the object frame and object radii:

    - ``world/camera``: pose and pinhole of the last view; ``depth`` and ``image`` below it.
    - ``world/views/K`` and ``world/seen/K``: pose of view K, and its observed points. They are
      written again when a later frame improves the estimate of the object's position.
    - ``world/thing``: the scan of the most likely thing in its estimated pose.
    - ``world/candidates``: the candidate views, coloured by value, and ``world/next``: the chosen
      one.
    - ``belief/CLASS``, ``threshold``, ``travel/cells``, ``travel/radians``: numbers over the steps,
      as they were then.
    - ``belief_now``, ``this_view_alone``, ``values``: bar charts over classes, and over the views
      that the policy considered.
    - ``maps/NAME``: predicted maps. ``log``: each step in words, with its warnings.

    The file can be read at any time; it is complete once the session is done, or after ``close``. A
    UsageError is raised if its name does not end in .rrd, or it cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        if Path(path).suffix != ".rrd":
            raise UsageError(f"{path}: a recording for Rerun is called .rrd")
        self._stream = rr.RecordingStream("nextview", recording_id=uuid4())
        try:
            self._stream.save(path, default_blueprint=blueprint())
        except (OSError, RuntimeError, ValueError) as error:
            raise UsageError(f"{path}: cannot be written ({error})") from None
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._shown: list[object] = []
        self._shows_surface = False
        self._open = True

    def __call__(self, session: "Session") -> None:
        """Record the changes of a session."""
        if not (self._open and session.views):
            return
        step = len(session.views)
        view = session.views[-1]
        new = len(session.views) > len(self._shown)

        self._stream.set_time(TIMELINE, sequence=step)
        for k, earlier in enumerate(session.views):
            if k >= len(self._shown) or self._shown[k] is not earlier.observation:
                self._log_place(k + 1, earlier)
        self._shown = [earlier.observation for earlier in session.views]

        if new:
            self._log_belief(session, view, step)
            self._log_surface(session)
        self._log_choice(session, view, step)
        self._stream.flush()

        if session.done:
            self._log_text(f"done: {session.result!r}")
            self.close()

    def close(self) -> None:
        """Complete the file; nothing more can be written."""
        if self._open:
            self._stream.disconnect()
        self._open = False

    def _log_place(self, step: int, view: "View") -> None:
        observation = view.observation
        height, width = observation.depth.shape
        pose = rr.Transform3D(
            translation=observation.pose[:3, 3],
            mat3x3=observation.pose[:3, :3],
        )
        how = {"camera_xyz": rr.ViewCoordinates.RDF, "image_plane_distance": 0.4}
        pinhole = rr.Pinhole(
            image_from_camera=observation.intrinsics,
            resolution=(width, height),
            **how,
        )

        for name in (f"world/views/{step}", "world/camera"):
            self._stream.log(name, pose, pinhole)
        points = (
            observation.points if observation.seen else np.zeros((0, 3), np.float32)
        )
        self._stream.log(
            f"world/seen/{step}",
            rr.Points3D(points, colors=rgb(ACCENT), radii=0.006),
        )
        self._stream.log(
            "world/camera/depth",
            rr.DepthImage(observation.depth, meter=1.0),
        )
        self._stream.log(
            "world/camera/image",
            rr.Image(observation.picture, color_model="L"),
        )

    def _log_surface(self, session: "Session") -> None:
        """Record the scan of the most likely thing in its estimated pose."""
        posed = session.result.posed_surface
        if posed is None:
            if self._shows_surface:
                self._stream.log("world/thing", rr.Clear(recursive=False))
            self._shows_surface = False
            return

        vertices, faces = posed
        colours = np.tile([*rgb(ACCENT), 90], (len(vertices), 1)).astype(np.uint8)
        mesh = rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            vertex_colors=colours,
        )
        self._stream.log("world/thing", mesh)
        self._shows_surface = True

    def _log_belief(self, session: "Session", view: "View", step: int) -> None:
        for name, belief in zip(session.models.classes, view.belief, strict=True):
            self._stream.log(
                f"belief/{rr.escape_entity_path_part(name)}",
                rr.Scalars(float(belief)),
            )

        self._stream.log("belief_now", rr.BarChart(view.belief))
        self._stream.log("this_view_alone", rr.BarChart(view.alone))
        self._stream.log(
            "threshold",
            rr.Scalars(float(session.stopping.threshold_at(step))),
        )
        self._stream.log("travel/cells", rr.Scalars(view.travel))
        self._stream.log("travel/radians", rr.Scalars(view.arc))

        for name, values in view.maps.items():
            self._stream.log(
                f"maps/{name}",
                rr.Tensor(values, dim_names=("ring", "azimuth")),
            )
        for warning in view.warnings:
            self._log_text(
                f"step {step}: warning ({warning.name}): {warning.message}",
                rr.TextLogLevel.WARN,
            )

    def _log_choice(self, session: "Session", view: "View", step: int) -> None:
        """Record the values of the views and the chosen one, each time it is chosen."""
        places = session.sphere.poses[:, :3, 3]
        visited = [earlier.index for earlier in session.views]

        values = np.full(len(places), np.nan) if view.values is None else view.values
        colours = heat(values)
        colours[visited] = rgb(INK)
        names = [f"view {k}" for k in range(len(places))]
        candidates = rr.Points3D(
            places,
            colors=colours,
            radii=0.07,
            labels=names,
            show_labels=False,
        )
        self._stream.log("world/candidates", candidates)

        considered = np.flatnonzero(np.isfinite(values))
        self._stream.log("values", rr.BarChart(values[considered], abscissa=considered))

        best = int(view.belief.argmax())
        to = view.next_view
        self._stream.log(
            "world/next",
            rr.Points3D(
                places[[] if to is None else [to]],
                colors=rgb(ACCENT),
                radii=0.1,
            ),
        )

        onward = "the end" if to is None else f"next view {to}"
        believed = f"{session.models.classes[best]} {view.belief[best]:.3f}"
        self._log_text(
            f"step {step}: view {view.index}, {believed}, moved by"
            f" {np.degrees(view.arc):.0f}° around it so far, {onward}"
        )

    def _log_text(self, text: str, level: str = rr.TextLogLevel.INFO) -> None:
        self._stream.log("log", rr.TextLog(text, level=level))


def blueprint() -> rrb.Blueprint:
    """Return the initial layout of the viewer."""
    camera = "world/camera"
    bars = {
        "belief": "belief_now",
        "this view alone": "this_view_alone",
        "values": "values",
    }

    images = [
        rrb.Spatial2DView(origin=camera, contents=[f"{camera}/{k}"], name=k)
        for k in ("image", "depth")
    ]
    charts = [
        rrb.BarChartView(origin=origin, name=name) for name, origin in bars.items()
    ]
    belief = rrb.TimeSeriesView(
        origin="/",
        contents=["belief/**", "threshold"],
        name="belief over the steps",
    )

    rows = images, charts, [belief, rrb.TimeSeriesView(origin="travel", name="travel")]
    scene = rrb.Spatial3DView(origin="world", name="object frame")
    log = rrb.TextLogView(origin="log")
    left = rrb.Vertical(scene, log, row_shares=[4, 1])
    right = rrb.Vertical(*(rrb.Horizontal(*row) for row in rows))

    return rrb.Blueprint(
        rrb.Horizontal(left, right),
        rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )
