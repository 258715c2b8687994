# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What NVIDIA's NCore stores of a rolling-shutter camera: poses when a frame starts and ends.

``ncore.json`` has the fields of its camera models (``OpenCVPinholeCameraModelParameters``,
``OpenCVFisheyeCameraModelParameters``) under their names, and of each frame what
``CameraSensorComponent.Writer.store_frame`` and ``PosesComponent.Writer.store_dynamic_pose`` take:
timestamps (us) and ``T_sensor_world`` at the first and at the last exposed row. NCore's own package
makes a sequence of them (docs/integrations.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.io.gsplat import shutter_type
from rs_localizer.io.nerfstudio import pixel_intrinsics

_COEFFICIENTS = 8  # of plumb_bob and rational_polynomial: k1 k2 p1 p2 k3 k4 k5 k6


def sequence(camera: Camera, names: list[str], stamps_ns: IntArray, poses: Array) -> dict[str, Any]:
    """What ``ncore.json`` holds.

    Args:
        camera: of all images.
        names: (n) of the image files.
        stamps_ns: (n,2) exposure of the first and of the last row.
        poses: (n,2,4,4) map_from_camera then.
    """
    focal, centre = pixel_intrinsics(camera)
    model: dict[str, Any] = {
        "resolution": list(camera.size),
        "shutter_type": shutter_type(camera),
        "external_distortion_parameters": None,
        "principal_point": centre.tolist(),
        "focal_length": focal.tolist(),
    }
    D = [*camera.D.tolist(), *[0.0] * _COEFFICIENTS][:_COEFFICIENTS]
    if camera.distortion_model == DistortionModel.EQUIDISTANT:
        model |= {"camera_model_type": "opencv-fisheye", "radial_coeffs": D[:4]}
        corners = np.array(
            [[x, y] for x in (0, camera.size[0] - 1) for y in (0, camera.size[1] - 1)]
        )
        slopes = np.hypot(*camera.rays(corners.astype(float)).T)  # NaN beyond 90 degrees
        model["max_angle"] = float(np.nanmax(np.arctan(slopes), initial=0.0))
    elif not camera.law.is_polynomial:
        raise ValueError(f"ncore.json has no lens {camera.distortion_model}")
    else:
        model |= {
            "camera_model_type": "opencv-pinhole",
            "radial_coeffs": [D[0], D[1], *D[4:]],
            "tangential_coeffs": D[2:4],
            "thin_prism_coeffs": [0.0] * 4,
        }
    frames = [
        {
            "file_path": name,
            "timestamps_us": [round(stamp / 1000) for stamp in stamps],
            "T_sensor_world": pair.tolist(),
        }
        for name, stamps, pair in zip(names, stamps_ns.tolist(), poses, strict=True)
    ]
    return {"camera_model_parameters": model, "frames": frames}
