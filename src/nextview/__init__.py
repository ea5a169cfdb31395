"""nextview: active 3D object recognition. What the object is, and where to look next.

>>> import nextview
>>> from nextview.data.samples import sample_mesh
>>> nextview.recognise(sample_mesh("chair"), start=3).answer
'chair'
"""

from typing import Any

from nextview.errors import (
    DatasetError,
    MeshError,
    MissingExtraError,
    ModelError,
    NextviewError,
    NoViewLeftError,
    ObservationError,
    OtherUseError,
    PolicyError,
    ResultsError,
    RiskError,
    SessionError,
    UsageError,
)
from nextview.geometry.mesh import Mesh, load_mesh
from nextview.geometry.observation import Camera, Observation
from nextview.geometry.viewsphere import Directions, ViewSphere
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.registry import make_policy
from nextview.recognition.belief import Stopping
from nextview.recognition.inference import Models
from nextview.session.result import Recognition
from nextview.session.session import Session
from nextview.session.system import System, load, recognise
from nextview.session.view import View

__version__ = "0.4.0"

__all__ = [
    "Camera",
    "DatasetError",
    "Directions",
    "EpisodeState",
    "Evidence",
    "Mesh",
    "MeshError",
    "MissingExtraError",
    "ModelError",
    "Models",
    "NextviewError",
    "NoViewLeftError",
    "Observation",
    "ObservationError",
    "OtherUseError",
    "Policy",
    "PolicyError",
    "Recognition",
    "ResultsError",
    "RiskError",
    "Scene",
    "Session",
    "SessionError",
    "SimulatedCamera",
    "Stopping",
    "System",
    "Tracker",
    "UsageError",
    "View",
    "ViewSphere",
    "learn",
    "load",
    "load_mesh",
    "make_policy",
    "recognise",
]


def __getattr__(name: str) -> Any:
    """``Scene``, ``Tracker``, the simulated camera and ``learn``, imported when they are used."""
    if name == "Scene":
        from nextview.scene.scene import Scene

        return Scene
    if name == "Tracker":
        from nextview.scene.tracker import Tracker

        return Tracker
    if name == "SimulatedCamera":
        from nextview.simulation.simulated import SimulatedCamera

        return SimulatedCamera
    if name == "learn":
        from nextview.teaching.learn import learn

        return learn
    raise AttributeError(f"module 'nextview' has no attribute {name!r}")
