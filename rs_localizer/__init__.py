"""Rolling-shutter absolute pose: the camera's pose and velocities from 2D-3D correspondences."""

from rs_localizer.config import LocalizerConfig, VelocityPrior
from rs_localizer.core.camera import Camera, DistortionModel, Roi, ScanDirection
from rs_localizer.core.prior import Prior
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate, Failure, Reason
from rs_localizer.localizer import Localizer
from rs_localizer.solvers import solve_minimal

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "DistortionModel",
    "Estimate",
    "Failure",
    "Localizer",
    "LocalizerConfig",
    "Motion",
    "Prior",
    "Reason",
    "Roi",
    "ScanDirection",
    "VelocityPrior",
    "solve_minimal",
]
