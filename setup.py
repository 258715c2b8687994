# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The package for colcon (ament_python) and for pip."""

import os
from glob import glob

from setuptools import find_packages, setup

package_name = "rs_localizer"

requirements = [
    "numba",
    "numpy>=1.26",
    "opencv-python-headless>=4.6",
    "PyYAML",
    "rosbags",
    "scipy",
    "tqdm",
]
if os.environ.get("AMENT_PREFIX_PATH"):
    # In a ROS environment rosdep brings them, from package.xml. Some are then invisible to pip
    # (Ubuntu's OpenCV has no metadata), and a requirement that is not met ends the installed
    # executables as soon as a library imports pkg_resources, as Ubuntu's Matplotlib does.
    requirements = ["setuptools"]

setup(
    name=package_name,
    version="1.0.0",
    description="Pose and velocity of a rolling-shutter camera from a single image",
    maintainer="rs_localizer maintainers",
    maintainer_email="maintainers@users.noreply.h-seed-b0484be4.example",
    license="Apache-2.0",
    packages=find_packages(include=[package_name, f"{package_name}.*"]),
    package_data={package_name: ["py.typed", "data/**/*"]},
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
        "ros": [
            "ros-jazzy-rclpy",
            "ros-jazzy-common-interfaces",
            "ros-jazzy-rmw-fastrtps-cpp",
        ],
        "colcon": ["colcon-common-extensions", "ros-jazzy-ament-package"],
        "docs": ["sphinx", "myst-parser", "sphinxcontrib-mermaid"],
        "evo": ["evo"],
        "examples": ["h5py", "pyarrow", "pycolmap", "rerun-sdk"],
        "fleet": ["dask", "distributed"],
        "peers": ["poselib"],  # of the benchmarks
        "mapping": ["pycolmap", "matplotlib"],
        "plots": ["matplotlib", "Pillow>=9.1"],
        "table": ["pyarrow"],
        # Of telemetry-parser there is no wheel for 3.13, and a build needs Rust. PyAV decodes
        # what OpenCV may not (AV1), and says where a video stops.
        "video": ["av", "telemetry-parser; python_version < '3.13'"],
        "test": [
            "build",
            "catkin_pkg",
            "codespell==2.4.*",
            # Against whose bundle adjustment the own one is tested.
            "gtsam; platform_machine == 'x86_64'",
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
            "example_matcher = rs_localizer.ros.main:example_matcher",
            "rs_localizer = rs_localizer.__main__:run",
        ],
    },
)
