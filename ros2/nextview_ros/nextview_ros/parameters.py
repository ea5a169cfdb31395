"""The parameters of the node: their defaults, descriptions and ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from nextview.sensing.frame import CAMERA_AXES


@dataclass(frozen=True)
class NodeParameter:
    """A parameter.

    Attributes:
        default: its value if none is given, which determines the type.
        about: description.
        low: least value; None for any.
        high: greatest value.
        fixed: whether it is read only when the node starts.
    """

    default: Any
    about: str
    low: float | None = None
    high: float | None = None
    fixed: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """The description for ROS."""
        made = ParameterDescriptor(description=self.about, read_only=self.fixed)
        if self.low is None:
            return made
        ends = {"from_value": self.low, "to_value": self.high}
        if isinstance(self.default, int):
            made.integer_range = [IntegerRange(**ends)]
        else:
            made.floating_point_range = [FloatingPointRange(**ends)]
        return made


USUAL = "metres; nan for the usual limit"
PARAMETERS = {
    "cameras": NodeParameter(
        ["/camera/camera/depth"],
        "namespaces of the depth cameras; next poses are for the first one",
        fixed=True,
    ),
    "image": NodeParameter(
        "image_rect_raw",
        "topic of the depth images in the namespace of a camera",
        fixed=True,
    ),
    "world_frame": NodeParameter(
        "base_link",
        "tf frame of all poses; it does not move, z is up",
        fixed=True,
    ),
    "models": NodeParameter(
        ["ycb"],
        "known things: bundled models or folders; the service learn adds to the last one",
        fixed=True,
    ),
    "policy": NodeParameter(
        "",
        "how the action recognise chooses views; empty for what goes with the models",
        fixed=True,
    ),
    "threshold": NodeParameter(0.97, "belief that ends an episode", 0.0, 1.0),
    "max_views": NodeParameter(5, "views after which an episode ends", 1, 1000),
    "period": NodeParameter(
        0.0,
        "seconds between looks that the node takes by itself until the scene is done; 0: it looks"
        " only when asked",
        0.0,
        3600.0,
        fixed=True,
    ),
    "patience": NodeParameter(
        2.0,
        "seconds that a look waits for an image and its transform",
        0.0,
        60.0,
    ),
    "tf_rate": NodeParameter(
        10.0,
        "rate at which the poses of confident objects are published on /tf, hertz; 0 for never",
        0.0,
        100.0,
        fixed=True,
    ),
    "track_rate": NodeParameter(
        10.0,
        "rate at which objects with confident names are followed between looks, in images a second"
        " at most; 0 for never",
        0.0,
        100.0,
        fixed=True,
    ),
    "standing": NodeParameter(
        False,
        "the only camera never moves, so that what changes in its images has moved",
    ),
    "rectified": NodeParameter(
        True, "the images are rectified: P of camera_info counts, not K and D"
    ),
    "axes": NodeParameter(
        "opencv",
        f"axes of the images' frame: {', '.join(CAMERA_AXES)}; opencv for an optical frame, ros"
        " for that of a body",
    ),
    "life_size": NodeParameter(
        False,
        "the objects are as large as their kind is in life; taught things always are",
    ),
    "min_height": NodeParameter(
        math.nan, f"least height of the camera above the plane: {USUAL}"
    ),
    "max_height": NodeParameter(
        math.nan, f"greatest height of the camera above the plane: {USUAL}"
    ),
    "clearance": NodeParameter(
        math.nan, f"least distance of the camera from what was seen: {USUAL}"
    ),
}


def declare(node: Node) -> None:
    """Declare all parameters of a node."""
    for name, one in PARAMETERS.items():
        node.declare_parameter(name, one.default, one.descriptor())
