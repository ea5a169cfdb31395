"""Start the node on the topics of a camera's driver:

ros2 launch nextview_ros nextview.launch.py driver:=realsense
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from nextview_ros.parameters import PARAMETERS

DRIVERS = {  # namespace of the first camera's depth topics, and topic of its images
    "realsense": ("/camera/camera/depth", "image_rect_raw"),  # realsense2_camera
    "realsense_aligned": (
        "/camera/camera/aligned_depth_to_color",
        "image_raw",
    ),  # with align_depth.enable:=true
    "orbbec": ("/camera/depth", "image_raw"),  # orbbec_camera
}
BY_DRIVER = {  # empty values mean those of the driver
    "cameras": "namespaces of the depth cameras, with commas between them",
    "image": "topic of the depth images in the namespace of a camera",
}


def node(context):
    """The node, with the arguments as parameters."""
    given = {name: LaunchConfiguration(name) for name in (*PARAMETERS, "use_sim_time")}
    camera, image = DRIVERS[LaunchConfiguration("driver").perform(context)]
    parameters = {
        "cameras": (given.pop("cameras").perform(context) or camera).split(","),
        "image": given.pop("image").perform(context) or image,
        "models": given.pop("models").perform(context).split(","),
    }
    kinds = {
        name: type(PARAMETERS[name].default) for name in given if name in PARAMETERS
    }
    parameters |= {
        name: ParameterValue(value, value_type=kinds.get(name, bool))
        for name, value in given.items()
    }
    return [
        Node(
            package="nextview_ros",
            executable="nextview_node",
            name="nextview",
            output="screen",
            parameters=[parameters],
        )
    ]


def text(default):
    """A default of a parameter as a launch argument."""
    return ",".join(default) if isinstance(default, list) else str(default).lower()


def generate_launch_description():
    """The arguments are the parameters of the node, and the driver that they suit."""
    declared = [
        DeclareLaunchArgument(
            "driver",
            default_value="realsense",
            choices=list(DRIVERS),
            description="camera driver whose topics are taken",
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            description="take the time from /clock, such as that of a bag",
        ),
    ]
    declared += [
        DeclareLaunchArgument(
            name,
            default_value="" if name in BY_DRIVER else text(one.default),
            description=f"{BY_DRIVER[name]}; empty for that of the driver"
            if name in BY_DRIVER
            else one.about,
        )
        for name, one in PARAMETERS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=node)])
