# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sentence on a package that is not installed, with the command that brings it."""

# Ubuntu's package for each imported name, and pip's where Ubuntu 24.04 has none.
_UBUNTU = {
    "cv2": "python3-opencv",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}
BOUNDS = {"numba": ">=0.63,<0.69", "rosbags": ">=0.11,<0.12"}
"""Versions of what has private or moving parts in use: the lowest that work, and the newest tried.

setup.py reads them here; tests hold the pages against them.
"""
_ASKED = " ".join(f'"{name}{versions}"' for name, versions in BOUNDS.items())
BESIDE_ROS = f'pip install --break-system-packages {_ASKED} "numpy<2"'
"""Beside the ROS of Ubuntu 24.04, which has neither, and whose NumPy this keeps."""
# Extras that bring packages which only some commands need.
_EXTRAS = {
    "av": "video",
    "dask": "fleet",
    "distributed": "fleet",
    "evo": "evaluate",
    "pyarrow": "table",
    "pycolmap": "mapping",
}
_PIP = {"cv2": "opencv-python-headless", "yaml": "PyYAML"}


def explain(error: ImportError) -> str:
    """Return the sentence that explains an import that failed."""
    name = (error.name or "").partition(".")[0]
    # A package that is there but broken (built for another NumPy, for example) reports itself.
    if not isinstance(error, ModuleNotFoundError):
        return f"{_one_line(error)}; a package it needs is installed and cannot be imported"
    if name in _UBUNTU:
        return (
            f"the Python package {name} is not installed: sudo apt install {_UBUNTU[name]}, or "
            f"pip install {_PIP.get(name, name)}"
        )
    if name in BOUNDS:
        return (
            f'the Python package {name} is not installed: pip install "{name}{BOUNDS[name]}"; with '
            f"Ubuntu 24.04's ROS: {BESIDE_ROS}; with 26.04's: sudo apt install python3-{name}"
        )
    if name in _EXTRAS:
        return (
            f"the Python package {name} is not installed: pip install {_PIP.get(name, name)} (the "
            f"extra {_EXTRAS[name]} of rs_localizer)"
        )
    return f"{_one_line(error)}; source a ROS 2 workspace, or install it with pip (docs/install.md)"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
