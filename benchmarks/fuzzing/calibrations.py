# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of every program that is read, to be damaged."""

from __future__ import annotations

_ROS = b"""
image_width: 640
image_height: 480
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
_OPENCV = b"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 319.5, 0., 500., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 0.1, 0., 0., 0. ]
"""
_XML = b"""<?xml version="1.0"?>
<opencv_storage><image_width>640</image_width><image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>500. 0. 319.5 0. 500. 239.5 0. 0. 1.</data></camera_matrix></opencv_storage>
"""
_KALIBR = b"""cam0:
  camera_model: pinhole
  intrinsics: [500.0, 500.0, 319.5, 239.5]
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [640, 480]
"""
_COLMAP = b"# cameras\n1 OPENCV 640 480 500 500 320 240 0.1 0 0 0\n"
_JSON = (
    b'{"width": 640, "height": 480, "K": [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], "D": [0.1, '
    b'0, 0, 0], "distortion_model": "fisheye"}'
)

SEEDS = (_ROS, _OPENCV, _XML, _KALIBR, _COLMAP, _JSON)
