"""The measures of the thesis's chapter 3, and one that it suggests, with what each needs and which
values are good.

nextview-lab measure views.zarr --measures research.measures:view_area
"""

from __future__ import annotations

from nextview_lab.data.measures import Measure
from research import area, curvature, depth_spread, saliency, semantic, silhouette
from research import gradient_entropy as gradient

viewpoint_entropy = Measure(
    area.viewpoint_entropy,
    "mesh",
    "Vázquez et al. 2001; eq. 3",
)
view_area = Measure(area.view_area, "depth", "Dutagaci et al. 2010")
visible_area_ratio = Measure(area.visible_area_ratio, "mesh", "Polonsky et al. 2005")
surface_visibility = Measure(area.surface_visibility, "mesh", "Secord et al. 2011")
silhouette_length = Measure(
    silhouette.silhouette_length,
    "depth",
    "Polonsky et al. 2005",
)
silhouette_entropy = Measure(
    silhouette.silhouette_entropy,
    "depth",
    "Polonsky et al. 2005",
)
curvature_entropy = Measure(
    curvature.curvature_entropy,
    "mesh",
    "Polonsky et al. 2005; eq. 4",
)
depth_distribution = Measure(
    depth_spread.depth_distribution,
    "depth",
    "Secord et al. 2011; eq. 5",
)
max_depth = Measure(depth_spread.max_depth, "depth", "Secord et al. 2011")
mean_curvature = Measure(curvature.mean_curvature, "mesh", "Secord et al. 2011")
gaussian_curvature = Measure(curvature.gaussian_curvature, "mesh", "Secord et al. 2011")
mesh_saliency = Measure(saliency.mesh_saliency, "mesh", "Lee et al. 2005")
above_preference = Measure(semantic.above_preference, "depth", "Secord et al. 2011")
base_avoidance = Measure(semantic.base_avoidance, "mesh", "Secord et al. 2011")
fused_descriptor = Measure(depth_spread.fused_descriptor, "depth", "Ding et al.")
gradient_entropy = Measure(
    gradient.gradient_entropy,
    "depth",
    "suggested in the thesis, section 6",
)

MEASURES = {
    name: value for name, value in globals().items() if isinstance(value, Measure)
}
