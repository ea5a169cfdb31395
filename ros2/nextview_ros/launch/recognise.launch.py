"""Start the node on a camera's topics: ros2 launch nextview_ros recognise.launch.py
camera:=/camera/depth.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "camera": ("/camera/depth", "namespace of the depth camera"),
    "image": ("image_rect_raw", "topic of the depth images below it"),
    "world_frame": ("base_link", "frame of the poses, z up"),
    "rectified": (
        "true",
        "the images are rectified: P of camera_info counts, not K and D",
    ),
    "axes": (
        "opencv",
        "axes of the images' frame: opencv for an optical frame, ros for a body's",
    ),
    "models": ("modelnet10", "bundled models, or a folder"),
    "policy": ("", "how the next view is chosen; empty for what goes with the models"),
    "life_size": ("false", "the objects are as large as their kind is in life"),
    "min_height": (
        "nan",
        "metres of the camera above the support plane, at least; nan for the usual limit",
    ),
    "max_height": (
        "nan",
        "metres of the camera above the support plane, at most; nan for the usual limit",
    ),
    "clearance": (
        "nan",
        "metres between the camera and what the frames show; nan for the usual limit",
    ),
}
TYPES = {
    "rectified": bool,
    "life_size": bool,
    "min_height": float,
    "max_height": float,
    "clearance": float,
}


def generate_launch_description():
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    parameters = {
        name: ParameterValue(value, value_type=TYPES.get(name, str))
        for name, value in given.items()
        if name not in ("camera", "image")
    }
    node = Node(
        package="nextview_ros",
        executable="recognise",
        name="nextview",
        output="screen",
        parameters=[parameters],
        remappings=[
            ("depth", PathJoinSubstitution([given["camera"], given["image"]])),
            ("camera_info", PathJoinSubstitution([given["camera"], "camera_info"])),
        ],
    )
    declared = [
        DeclareLaunchArgument(n, default_value=v, description=about)
        for n, (v, about) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, node])
