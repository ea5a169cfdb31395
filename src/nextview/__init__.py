"""nextview: active 3D object recognition. What the object is, and where to look next.

>>> import nextview
>>> from nextview.data.samples import sample_mesh
>>> nextview.recognise(sample_mesh("chair"), start=3).answer
'chair'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from nextview.geometry.mesh import Mesh, load_mesh
    from nextview.geometry.viewsphere import Directions, ViewSphere
    from nextview.policies.base import EpisodeState, Evidence, Policy
    from nextview.policies.registry import make_policy
    from nextview.recognition.belief import Stopping
    from nextview.recognition.inference import Models
    from nextview.scene.scene import Scene
    from nextview.scene.tracker import Tracker
    from nextview.sensing.observation import Camera, Observation
    from nextview.session.result import Recognition
    from nextview.session.session import Session
    from nextview.session.system import System, load, recognise
    from nextview.session.view import View
    from nextview.simulation.simulated import SimulatedCamera
    from nextview.teaching.learn import learn

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

# imported when they are used: NumPy, SciPy and the networks make the start of a command slow
_HOMES = {
    "Camera": "sensing.observation",
    "Directions": "geometry.viewsphere",
    "EpisodeState": "policies.base",
    "Evidence": "policies.base",
    "Mesh": "geometry.mesh",
    "Models": "recognition.inference",
    "Observation": "sensing.observation",
    "Policy": "policies.base",
    "Recognition": "session.result",
    "Scene": "scene.scene",
    "Session": "session.session",
    "SimulatedCamera": "simulation.simulated",
    "Stopping": "recognition.belief",
    "System": "session.system",
    "Tracker": "scene.tracker",
    "View": "session.view",
    "ViewSphere": "geometry.viewsphere",
    "learn": "teaching.learn",
    "load": "session.system",
    "load_mesh": "geometry.mesh",
    "make_policy": "policies.registry",
    "recognise": "session.system",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'nextview' has no attribute {name!r}")
    found = getattr(import_module(f"nextview.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """List the public names, those not imported yet too."""
    return sorted({*globals(), *_HOMES})
