# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The package for colcon (ament_python) and for pip."""

import os
import runpy
import sys
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

package_name = "rs_localizer"
# Of rs_localizer/native: what only the build needs.
build_tools = ("bitcode", "build", "jit", "sources")


class BuildKernels(build_ext):
    """Compiles the kernels; see rs_localizer/native/build.py.

    ``RS_LOCALIZER_LEVELS``, as "v2 v3 v4", makes portable modules of these levels (`make wheel`);
    without it, one for this machine.
    """

    def run(self):
        folder = Path(__file__).resolve().parent
        sys.path.insert(0, str(folder))
        from rs_localizer.native import build

        in_place = bool(self.inplace or getattr(self, "editable_mode", False))
        to = folder if in_place else Path(self.build_lib)
        levels = os.environ.get("RS_LOCALIZER_LEVELS", "").split()
        try:
            build.build(to / package_name / "native", levels, bool(levels), is_checkout=in_place)
        except build.CannotBuild as fault:
            sys.exit(f"rs_localizer: {fault}")

    def get_outputs(self):
        return sorted(map(str, Path(self.build_lib, package_name, "native").glob("*.so")))

    def get_source_files(self):
        return []


class BuildPython(build_py):
    """Leaves out of wheels what only the build needs."""

    def find_package_modules(self, package, package_dir):
        modules = super().find_package_modules(package, package_dir)
        if package != f"{package_name}.native":
            return modules
        return [module for module in modules if module[1] not in build_tools]


# Where the commands say them, too, to whom lacks one.
bounds = runpy.run_path("rs_localizer/process/missing.py")["BOUNDS"]
requirements = [
    "numpy>=1.26.4",
    "opencv-python-headless>=4.6",
    "PyYAML",
    f"rosbags{bounds['rosbags']}",
    "tqdm",
]
if os.environ.get("AMENT_PREFIX_PATH"):
    # In a ROS environment rosdep brings them, from package.xml. Some are then invisible to pip
    # (Ubuntu's OpenCV has no metadata), and a requirement that is not met ends the installed
    # executables as soon as a library imports pkg_resources, as Ubuntu's Matplotlib does.
    requirements = ["setuptools"]

setup(
    name=package_name,
    version="0.9.0",
    description="Pose and velocity of a rolling-shutter camera from a single image",
    maintainer="rs_localizer maintainers",
    maintainer_email="maintainers@users.noreply.h-seed-b0484be4.example",
    license="Apache-2.0",
    packages=find_packages(include=[package_name, f"{package_name}.*"]),
    package_data={package_name: ["py.typed", "data/**/*"]},
    cmdclass={"build_ext": BuildKernels, "build_py": BuildPython},
    # One module serves Python 3.11 and all that follow.
    ext_modules=[Extension(f"{package_name}.native._kernels", [], py_limited_api=True)],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", sorted(glob("config/*"))),
        (f"share/{package_name}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    zip_safe=False,
    python_requires=">=3.11",
    install_requires=requirements,
    extras_require={
        # ROS 2 Jazzy without an installation of ROS.
        "ros": ["ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"],
        "colcon": ["colcon-common-extensions", "ros-jazzy-ament-package"],
        "docs": ["sphinx", "myst-parser", "sphinxcontrib-mermaid"],
        # Of telemetry-parser there is no wheel for 3.13, and a build needs Rust.
        "examples": [
            "h5py",
            "pyarrow",
            "pycolmap",
            "rerun-sdk",
            "telemetry-parser; python_version < '3.13'",
        ],
        # calibrate, map survey, --smooth; pictures.
        "tools": ["scipy", "matplotlib", "Pillow>=9.1"],
        "evaluate": ["evo", "scipy", "matplotlib", "Pillow>=9.1"],
        "fleet": ["dask", "distributed"],
        "peers": ["poselib"],  # of the benchmarks
        "mapping": ["pycolmap", "scipy", "matplotlib"],
        "table": ["pyarrow"],
        "video": ["av"],
        "test": [
            "build",
            # Runs kernels that are edited.
            f"numba{bounds['numba']}",
            "scipy",
            "cmeel-eigen>=3.4,<4",
            "catkin_pkg",
            "codespell==2.4.*",
            "hypothesis",
            # AprilRobotics' detector, for what it publishes; elsewhere its build needs CMake.
            "pupil-apriltags; platform_machine == 'x86_64' and python_version < '3.14'",
            "mypy==2.4.*",  # pinned, as is Ruff: what passes today passes with the next release
            "pytest",
            "pytest-timeout",
            "pytest-xdist",
            "ruff==0.17.*",
            "setuptools>=70.1",  # the first that builds wheels on its own
        ],
    },
    entry_points={
        "console_scripts": [
            "localizer = rs_localizer.ros.main:main",
            "marker_detector = rs_localizer.ros.main:marker_detector",
            "feature_detector = rs_localizer.ros.main:feature_detector",
            "doctor = rs_localizer.ros.main:doctor",
            "rs_localizer = rs_localizer.__main__:run",
        ]
    },
)
