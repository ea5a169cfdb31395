"""nextview: active 3D object recognition. What the object is, and where to look next.

>>> from nextview.data.samples import sample_mesh
>>> models = load_models()
>>> sphere = ViewSphere.named("40")
>>> policy = make_policy("lem", sphere, models.valley_classes("lem"))
>>> result = recognise(SimulatedCamera(sample_mesh("chair")), models, policy, sphere, start=3)
>>> result.answer
'chair'
"""

from nextview.belief import Stopping
from nextview.cameras.simulated import SimulatedCamera
from nextview.mesh import Mesh, load_mesh
from nextview.models.inference import Models, load_models
from nextview.observation import Camera, Observation
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.registry import make_policy
from nextview.session import Recognition, Session, View, recognise
from nextview.viewsphere import ViewSphere

__all__ = [
    "Camera",
    "EpisodeState",
    "Evidence",
    "Mesh",
    "Models",
    "Observation",
    "Policy",
    "Recognition",
    "Session",
    "SimulatedCamera",
    "Stopping",
    "View",
    "ViewSphere",
    "load_mesh",
    "load_models",
    "make_policy",
    "recognise",
]
