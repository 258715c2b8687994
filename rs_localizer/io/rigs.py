# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras of a rig: lenses, shutters, mounts, clocks, by ``calibrate --rig`` or Kalibr.

In the params file of ``calibrate --rig``, ``lens`` has an entry for each camera, with the 16
numbers of ``camera_from_rig`` (``X_camera = T X_rig``); shutters and clocks are settings.

Kalibr's camchain has a mapping for each camera, in their order. Its names are Kalibr's, ``cam0``,
or any other; besides what Kalibr writes, each may have ``readout_time`` (s) and ``scan_direction``.

=====================  =================================================================
``T_cn_cnm1``          ``X_camera = T X_camera_before``, of all but the first
``T_cam_imu``          ``X_camera = T X_imu``; if all have it, the rig's axes are the IMU's
``timeshift_cam_imu``  s, ``t_imu = t_camera + shift``: what is to be added to its stamps
=====================  =================================================================
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io import camera_files
from rs_localizer.io.reading import LENS, flat, load_yaml, parameter_blocks, read_text
from rs_localizer.io.transforms import Transform

_CHAIN, _IMU, _SHIFT = "T_cn_cnm1", "T_cam_imu", "timeshift_cam_imu"
_MOUNT = "camera_from_rig"
_SHUTTER = ("readout_time", "scan_direction")
# Entries of R R^T - I beyond this are no rounding of a file's digits.
_ORTHONORMAL = 1e-3


class RigParts(NamedTuple):
    """Arguments of :class:`rs_localizer.Rig`: ``Rig(*parts)``."""

    cameras: dict[str, Camera]
    camera_from_rig: dict[str, tuple[Array, Array]]  # (3,3) and (3,) m, X_camera = R X_rig + t
    time_offset: dict[str, float]  # s, to add to a camera's stamps


def read_camchain(path: Path | str) -> RigParts:
    """Read the cameras of a camchain or of ``calibrate --rig``.

    Without ``T_cam_imu``, a camchain is in the axes of its first camera.

    Raises:
        CalibrationError: for anything else, saying what was found.
    """
    with camera_files.calibration_faults(path := Path(path), "YAML or JSON", "no usable rig"):
        tree = load_yaml(read_text(path))
        own = [parameters for _, parameters in parameter_blocks(tree)]
        return _read_own_rig(own[0]) if own else _camchain(tree)


def mounted_lenses(parts: RigParts) -> dict[str, Any]:
    """Return ``lens`` of the params file of a rig; :func:`node_parameters` are its settings."""
    lenses = {}
    for name, camera in parts.cameras.items():
        mount = np.eye(4)
        mount[:3, :3], mount[:3, 3] = parts.camera_from_rig[name]
        lenses[name] = camera_files.lens_parameters(camera) | {_MOUNT: mount.ravel().tolist()}
    return lenses


def _read_own_rig(tree: Any) -> RigParts:
    values = dict(flat(tree))
    cameras, poses, offsets = {}, {}, {}
    for name in values["cameras"]:
        lens = tree[LENS][name]
        own = {of: values[key] for of in _SHUTTER if (key := f"{name}.{of}") in values}
        cameras[name] = replace(camera_files.lens_camera(lens), **own)
        pose = _rigid(_MOUNT, np.reshape(lens[_MOUNT], (4, 4)))
        poses[name] = pose[:3, :3].copy(), pose[:3, 3].copy()
        offsets[name] = float(values.get(f"{name}.stamp_offset", 0.0))
    return RigParts(cameras, poses, offsets)


def _camchain(tree: Any) -> RigParts:
    if not isinstance(tree, dict) or not tree:
        raise ValueError("a camchain has a mapping for each camera")
    cameras, poses, offsets = {}, {}, {}
    by_imu = all(isinstance(item, dict) and _IMU in item for item in tree.values())
    pose = np.eye(4)
    for place, (name, item) in enumerate(tree.items()):
        try:
            if not isinstance(item, dict):
                raise ValueError(f"expected a mapping, found {item!r}")
            shutter = {of: item[of] for of in _SHUTTER if of in item}
            cameras[str(name)] = replace(camera_files.kalibr_camera(item), **shutter)
            if by_imu:
                pose = _rigid(_IMU, item[_IMU])
            elif place > 0:
                pose = _rigid(_CHAIN, item[_CHAIN]) @ pose
            poses[str(name)] = pose[:3, :3].copy(), pose[:3, 3].copy()
            # Without an IMU there is nothing that it could be the shift to.
            offsets[str(name)] = float(item.get(_SHIFT, 0.0)) if by_imu else 0.0
        except KeyError as error:
            raise ValueError(f"{name} has no {error}") from error
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: {error}") from error
    return RigParts(cameras, poses, offsets)


def _rigid(name: str, values: Any) -> Array:
    matrix = np.array(values, float)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} must be a finite 4x4 matrix, found {values!r}")
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _ORTHONORMAL or np.linalg.det(rotation) < 0.0 or np.any(matrix[3] != (0, 0, 0, 1)):
        raise ValueError(f"{name} is no rigid transform: {matrix.tolist()}")
    return matrix


def node_parameters(parts: RigParts) -> dict[str, Any]:
    """Return the node's parameters for a rig, without the extrinsics, which come from TF."""
    own: dict[str, Any] = {}
    for name, camera in parts.cameras.items():
        own[f"{name}.readout_time"] = camera.readout_time
        own[f"{name}.scan_direction"] = str(camera.scan_direction)
        if (offset := parts.time_offset.get(name, 0.0)) != 0.0:
            own[f"{name}.stamp_offset"] = offset
    return {"cameras": list(parts.cameras), **own}


def write_static_transforms(path: Path, parts: RigParts, frames: Mapping[str, str]) -> None:
    """Write a launch file (XML) that publishes where cameras are in the axes of the first one.

    Args:
        frames: of the cameras' optical axes, by name.
    """
    first, *others = parts.cameras
    root, lines = Transform(*parts.camera_from_rig[first]), ["<launch>"]
    for name in others:
        pose = root @ Transform(*parts.camera_from_rig[name]).inverse()
        x, y, z = pose.translation.tolist()
        qx, qy, qz, qw = so3.quaternion(np.ascontiguousarray(pose.rotation)).tolist()
        values = {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
        args = " ".join(f"--{key} {value:.17g}" for key, value in values.items())
        args += f" --frame-id {frames[first]} --child-frame-id {frames[name]}"
        node = f'pkg="tf2_ros" exec="static_transform_publisher" name="{name}_on_{first}"'
        lines.append(f"  <node {node} args={quoteattr(args)}/>")
    path.write_text("\n".join([*lines, "</launch>", ""]), "utf-8")
