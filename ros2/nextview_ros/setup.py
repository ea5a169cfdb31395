"""The ROS 2 package around nextview; nextview itself comes from pip."""

from setuptools import setup

setup(
    name="nextview_ros",
    version="0.4.0",
    packages=["nextview_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/nextview_ros"]),
        ("share/nextview_ros", ["package.xml"]),
        ("share/nextview_ros/launch", ["launch/nextview.launch.py"]),
    ],
    install_requires=["setuptools", "nextview"],
    entry_points={
        "console_scripts": [
            "nextview_node = nextview_ros.node:main",
            "nextview_player = nextview_ros.player:main",
        ]
    },
    license="Apache-2.0",
)
