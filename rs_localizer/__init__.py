# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rolling-shutter absolute pose: the camera's pose and velocities from 2D-3D correspondences."""

import importlib

TYPE_CHECKING = False  # type checkers take it for typing's, which takes milliseconds to import
if TYPE_CHECKING:
    from rs_localizer.config import Acceleration, CalibrationErrors, LocalizerConfig, VelocityPrior
    from rs_localizer.core.camera import Camera, DistortionModel, Roi
    from rs_localizer.core.reasons import Reason
    from rs_localizer.core.rectification import rectify
    from rs_localizer.core.rig import Rig, RigEstimate
    from rs_localizer.core.scanning import ScanDirection
    from rs_localizer.core.shutter import Motion
    from rs_localizer.core.types import Estimate, Failure
    from rs_localizer.core.units import CameraState, camera_state
    from rs_localizer.estimation.prior import Prior
    from rs_localizer.io.camera_files import read_calibration
    from rs_localizer.io.rigs import RigParts, read_camchain
    from rs_localizer.localizer import Localizer
    from rs_localizer.offline.frame_table import localize_recording
    from rs_localizer.solvers.minimal import solve_minimal
    from rs_localizer.tracking import Tracker

__version__ = "0.9.0"

__all__ = [
    "Acceleration",
    "CalibrationErrors",
    "Camera",
    "CameraState",
    "DistortionModel",
    "Estimate",
    "Failure",
    "Localizer",
    "LocalizerConfig",
    "Motion",
    "Prior",
    "Reason",
    "Rig",
    "RigEstimate",
    "RigParts",
    "Roi",
    "ScanDirection",
    "Tracker",
    "VelocityPrior",
    "camera_state",
    "localize_recording",
    "read_calibration",
    "read_camchain",
    "rectify",
    "solve_minimal",
]

if not TYPE_CHECKING:  # type checkers know the names from above, and refuse all others
    # NumPy and OpenCV take tenths of a second to import. Who imports this package only to start a
    # program does not wait for them, and it can take Ctrl-C in hand before they come (PEP 562).
    _HOMES = {
        "config": ("Acceleration", "CalibrationErrors", "LocalizerConfig", "VelocityPrior"),
        "core.camera": ("Camera", "DistortionModel", "Roi"),
        "core.reasons": ("Reason",),
        "core.rectification": ("rectify",),
        "core.rig": ("Rig", "RigEstimate"),
        "core.scanning": ("ScanDirection",),
        "core.shutter": ("Motion",),
        "core.types": ("Estimate", "Failure"),
        "core.units": ("CameraState", "camera_state"),
        "estimation.prior": ("Prior",),
        "io.camera_files": ("read_calibration",),
        "io.rigs": ("RigParts", "read_camchain"),
        "localizer": ("Localizer",),
        "offline.frame_table": ("localize_recording",),
        "solvers.minimal": ("solve_minimal",),
        "tracking": ("Tracker",),
    }

    def __getattr__(name):
        for module, names in _HOMES.items():
            if name in names:
                value = getattr(importlib.import_module(f"{__name__}.{module}"), name)
                globals()[name] = value
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__})
