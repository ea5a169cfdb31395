"""View measures by name, or by the import path of a user's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from nextview.arguments import of_kind
from nextview.errors import MeasureError
from nextview.measures.area import surface_visibility, view_area, viewpoint_entropy, visible_area_ratio
from nextview.measures.curvature import curvature_entropy, gaussian_curvature, mean_curvature
from nextview.measures.depth_entropy import entropy_of_depths
from nextview.measures.depth_spread import depth_distribution, max_depth
from nextview.measures.fused_descriptor import fused_descriptor
from nextview.measures.gradient_entropy import gradient_entropy
from nextview.measures.map_names import Good
from nextview.measures.measured_view import MeasuredView
from nextview.measures.saliency import mesh_saliency
from nextview.measures.semantic import above_preference, base_avoidance
from nextview.measures.silhouette import silhouette_entropy, silhouette_length
from nextview.own_code import import_own, own_code


@dataclass(frozen=True)
class Measure:
    """A view measure, and what is to be known of it.

    Attributes:
        function: from a view to a finite number.
        needs: "depth", or "mesh": the mesh and which face of it each pixel shows.
        source: where it comes from.
        good: which values are those of good views, by its source.
    """

    function: Callable[[MeasuredView], float]
    needs: Literal["depth", "mesh"] = "depth"
    source: str = "your own"
    good: Good = "peak"

    def __call__(self, view: MeasuredView) -> float:
        """The measure of a view.

        Raises:
            MeasureError: it needs a mesh, and the view has none.
        """
        return self.function(view)


MEASURES: dict[str, Measure] = {
    "viewpoint_entropy": Measure(viewpoint_entropy, "mesh", "Vázquez et al. 2001; eq. 3"),
    "depth_entropy": Measure(
        lambda view: entropy_of_depths(view.depths, view.depth.size), "depth", "Parisotto et al.; eq. 3"
    ),
    "view_area": Measure(view_area, "depth", "Dutagaci et al. 2010"),
    "visible_area_ratio": Measure(visible_area_ratio, "mesh", "Polonsky et al. 2005"),
    "surface_visibility": Measure(surface_visibility, "mesh", "Secord et al. 2011"),
    "silhouette_length": Measure(silhouette_length, "depth", "Polonsky et al. 2005"),
    "silhouette_entropy": Measure(silhouette_entropy, "depth", "Polonsky et al. 2005"),
    "curvature_entropy": Measure(curvature_entropy, "mesh", "Polonsky et al. 2005; eq. 4"),
    "depth_distribution": Measure(depth_distribution, "depth", "Secord et al. 2011; eq. 5"),
    "max_depth": Measure(max_depth, "depth", "Secord et al. 2011"),
    "mean_curvature": Measure(mean_curvature, "mesh", "Secord et al. 2011"),
    "gaussian_curvature": Measure(gaussian_curvature, "mesh", "Secord et al. 2011"),
    "mesh_saliency": Measure(mesh_saliency, "mesh", "Lee et al. 2005"),
    "above_preference": Measure(above_preference, "depth", "Secord et al. 2011"),
    "base_avoidance": Measure(base_avoidance, "mesh", "Secord et al. 2011"),
    "fused_descriptor": Measure(fused_descriptor, "depth", "Ding et al."),
    "gradient_entropy": Measure(gradient_entropy, "depth", "suggested in the thesis, section 6"),
}
"""The sixteen of the thesis's chapter 3, and one that it suggests."""


def find_measure(name: str) -> Measure:
    """A measure by name.

    Args:
        name: one of MEASURES, or "module:function" for one of your own: a function of a ``MeasuredView`` that needs
            nothing but the depth, or a ``Measure``, which says what it needs.

    Raises:
        MeasureError: there is none, or it cannot be imported.
    """
    of_kind(name, str, "a measure is a name", MeasureError)
    if name in MEASURES:
        return MEASURES[name]
    if ":" not in name:
        raise MeasureError(f"no measure is called {name!r}; there are {', '.join(MEASURES)}, or MODULE:FUNCTION")
    with own_code(lambda said: MeasureError(f"measure {name} cannot be imported ({said})")):
        found = import_own(name)
    if not callable(found):
        raise MeasureError(f"measure {name} is no function of a view")
    return found if isinstance(found, Measure) else Measure(found)


def names_of(names: Sequence[str], meshes: bool) -> tuple[str, ...]:
    """The measures that are meant.

    Args:
        names: as for ``find_measure``, or "all"; none for all that can be had.
        meshes: whether the meshes are known.

    Raises:
        MeasureError: there is no such measure, or it needs the meshes and these are not known.
    """
    if not names:
        return tuple(name for name, measure in MEASURES.items() if meshes or measure.needs == "depth")
    names = tuple(dict.fromkeys(each for name in names for each in (MEASURES if name == "all" else (name,))))
    for name in names:
        if find_measure(name).needs == "mesh" and not meshes:
            raise MeasureError(f"the measure {name} needs the meshes: name the folder that the store was rendered from")
    return names
