# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Words on a calibration: the accepted readout time, and the quality of the lens."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.io.imu import ImuRecording
from rs_localizer.tools.camera_calibration import CameraCalibration

# Beyond this (s rms) the images' own times are mentioned.
_WORTH_A_WORD = 5e-4
# A ninth of the image is not covered where no keypoint lies in more than this part of its cells,
# of which there are this many along each side.
_EMPTY, _CELLS = 0.5, 3
_REGIONS = (
    ("top left", "top", "top right"), ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)  # fmt: skip

# A rotation that TF has otherwise by more than this (degrees), and more than chance, is doubted.
_MOST_TURN, _SIGMAS = 1.0, 4.0
# Source of the mount of the IMU on the camera.
_GIVEN = "TF"
# Corners that are bent by less (px) are those of a rectified film, or of a telephoto lens.
_STRAIGHT = 1.5
# A scale of the gyroscope that is worth a word.
_LEAST_SCALE = 0.005


def readout_time(result: CameraCalibration) -> float:
    """Return the readout time (s) to be set: 0 for a global shutter."""
    return 0.0 if result.global_shutter else abs(result.readout_time)


def scan_direction(result: CameraCalibration) -> ScanDirection:
    """Return the direction that the sign of the readout time means."""
    given = ScanDirection(result.fit.camera.scan_direction)
    return given if result.global_shutter or result.readout_time > 0.0 else REVERSED[given]


def lens_refusal(result: CameraCalibration) -> str:
    """Return one line with the figure if the recording determines no lens; or ''."""
    camera = result.fit.camera
    if np.all((camera.K[:2, 2] > 0.0) & (camera.K[:2, 2] < camera.size)):
        return ""
    return (
        f"no lens: the principal point would be at {camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}, "
        "outside the image; show the map from several sides, in all parts of the image"
    )


def refusal(result: CameraCalibration) -> str:
    """Return one line with the figure if lens or readout time is not determined; or ''."""
    return lens_refusal(result) or result.disbelief


def shape_is_free(result: CameraCalibration) -> bool:
    """Return True if the map's shape was estimated."""
    return result.fit.freedom.landmarks > 0.0


def moved(result: CameraCalibration, points: Array) -> Array:
    """Return points (n,3) of the map where they were found; unseen ones stay."""
    rows = {tuple(place): row for row, place in enumerate(result.posed.observations.landmarks)}
    places = [rows.get(tuple(point)) for point in points]
    return np.array([
        point if row is None else result.fit.state.landmarks[row]
        for point, row in zip(points, places, strict=True)
    ])  # fmt: skip


def remarks(result: CameraCalibration) -> list[str]:
    """Return sentences on oddities, and on the worth of the value."""
    said = []
    if result.global_shutter:
        said.append(
            f"global shutter: 0 lies within the error of {1e3 * result.readout_time:+.3f} +- "
            f"{1e3 * result.deviation:.3f} ms"
        )
    if result.stamps.irregular:
        said.append(
            f"stamps are irregular: {1e3 * result.stamps.jitter:.2f} ms rms about even intervals"
        )
    if result.jitter > _WORTH_A_WORD:
        said.append(
            f"exposures are {1e3 * result.jitter:.1f} ms rms off their stamps; their times were "
            "estimated, and the value depends on the mean interval"
        )
    if result.stamps.missing:
        said.append(f"{result.stamps.missing} images are missing between the others")
    if result.inflation > 1.0:
        said.append(
            f"parts of the recording differ ({result.parts} ms) by more than their noise: the "
            f"deviation is {result.inflation:.1f} times that of the noise alone"
        )
    if result.held:
        said.append(
            f"the map's {result.held} points are taken as they are given: more than are estimated "
            "along; where they may be off by a thousandth of its size, show a smaller board"
        )
    if regions := uncovered(result):
        said.append(
            f"never showed the map: {regions[0]} of the image ({', '.join(regions[1:])}); the lens "
            "is a guess there"
        )
    return said


def uncovered(result: CameraCalibration) -> list[str]:
    """Say how much of the image no keypoint covers, and where; empty: hardly any."""
    observations, camera = result.posed.observations, result.fit.camera
    pixels = observations.pixels[observations.trusted]
    cells = (pixels / camera.size * _CELLS * 3).astype(int).clip(0, 3 * _CELLS - 1)
    empty = np.ones((3 * _CELLS, 3 * _CELLS), np.bool_)
    empty[cells[:, 1], cells[:, 0]] = False
    regions = empty.reshape(3, _CELLS, 3, _CELLS).mean(axis=(1, 3))
    names = [
        name
        for row, line in zip(regions, _REGIONS, strict=True)
        for share, name in zip(row, line, strict=True)
        if share > _EMPTY
    ]
    return [f"{empty.mean():.0%}", *names] if names else []


def table(found: CameraCalibration, rate: float | None) -> Iterator[str]:
    """Yield rows of what was found; ``rate``: of the images, as it was given."""
    if found.processed:  # before figures that it makes worthless
        yield f"warning: {found.processed}"
    for name, text in (
        ("readout time", f"{1e3 * readout_time(found):.3f} ms"),
        ("standard deviation", f"{1e3 * found.deviation:.3f} ms"),
        ("of it by noise alone", f"{1e3 * found.formal_deviation:.3f} ms"),
        ("scan_direction", str(scan_direction(found))),
        ("interval between images", f"{1e3 * found.stamps.interval:.3f} ms"),
        ("images with a pose", f"{len(found.posed.times)} of {found.images}"),
        ("noise of the keypoints", f"{found.fit.deviation:.3f} px"),
        ("keypoints that fit", f"{np.mean(found.fit.inliers):.1%}"),
        ("spacing of the knots", f"{1e3 * found.fit.state.spline.layout.spacing:.1f} ms"),
    ):
        yield f"{name:26} {text}"
    along = 1e3 * found.sense
    for block in found.blocks:
        yield (
            f"  {block.start:6.1f} to {block.end:5.1f} s {'':5}"
            f"{along * block.readout_time:+.3f} +- {1e3 * block.deviation:.3f} ms"
        )
    yield from remarks(found)
    if rate is not None:
        share = abs(found.readout_time) / found.stamps.interval
        yield (
            f"the readout time is {share:.3f} of the interval: it scales with --rate, "
            f"assumed to be {rate:g} Hz"
        )


def of_lens(found: CameraCalibration) -> Iterator[str]:
    """Yield rows of the lens with its deviations."""
    state = found.fit.state
    deviations = np.sqrt(np.diag(found.fit.border_covariance)[1 : 1 + len(state.lens)])
    names = ["fx", "fy", "cx", "cy", *(f"D[{k}]" for k in range(len(state.lens) - 4))]
    yield f"{'lens':26} {found.fit.camera.distortion_model}"
    for name, value, deviation in zip(names, state.lens, deviations, strict=True):
        yield f"{name:26} {value:.5g} +- {found.inflation * deviation:.2g}"
    errors = found.lens
    if straightness := _straightness(found):
        yield straightness
    yield (
        f"{'what it is off by':26} centre {errors.principal_point:.2g} px, focal length "
        f"{100.0 * errors.focal_length:.2g} %, fy over fx {100.0 * errors.aspect_ratio:.2g} %, "
        f"distortion {errors.distortion:.2g} px at the corners"
    )


def _straightness(found: CameraCalibration) -> str:
    """Say what a lens without distortion means; nothing of all others."""
    camera = found.fit.camera
    width, height = np.array(camera.size) - 1.0
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    off = camera.rays(corners) - replace(camera, D=np.zeros(0)).rays(corners)
    bent = camera.focal_length * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    if not bent < max(_STRAIGHT, _SIGMAS * found.lens.distortion):  # NaN is not
        return ""
    return (
        f"the lens bends nothing ({bent:.1f} px at the corners): is the film rectified? Its rows "
        "are no longer those that were exposed together; film without correction of the lens"
    )


def of_imu(found: CameraCalibration, imu: ImuRecording, stamp_offset: float) -> Iterator[str]:
    """Yield rows of the table, and sentences on oddities."""
    one = found.mount
    if one is None:
        yield f"imu: {found.no_mount}"
        return
    offset, spread = 1e3 * (one.time_offset + stamp_offset), 1e3 * one.time_offset_deviation
    turn = numbers(Rotation.from_matrix(one.mount.camera_from_imu).as_quat(canonical=True), 5)
    error = numbers(np.degrees(one.rotation_deviations), 3)
    bias, errors = (numbers(np.degrees(each), 3) for each in (one.mount.bias, one.bias_deviations))
    for name, text, known in (
        ("imu.time_offset", f"{offset:+.3f} +- {spread:.3f} ms", one.time_offset_determined),
        (
            "rotation camera <- imu", f"{turn} (x y z w) +- {error} deg",
            one.rotation_determined,
        ),
        ("gyroscope bias", f"{bias} +- {errors} deg/s", one.bias_determined),
        ("gyroscope noise", f"{np.degrees(one.noise):.3f} deg/s, {one.samples} samples", True),
    ):  # fmt: skip
        yield f"{name:26} {text if known else f'not observable: {text}'}"
    if one.inflation > 1.0:
        yield (
            f"imu: parts of the recording have different offsets: the deviation is "
            f"{one.inflation:.1f} times that of the noise alone"
        )
    if imu.camera_from_imu is None:
        yield "imu: TF has no transform from it to the camera; its rotation is not checked"
    elif one.rotation_determined:
        off = np.degrees(one.mount.turned_from(imu.camera_from_imu))
        chance = _SIGMAS * float(np.degrees(np.linalg.norm(one.rotation_deviations)))
        if off > max(_MOST_TURN, chance):
            yield f"imu: {_GIVEN} has another rotation, {off:.1f} deg off: is it right?"
        else:
            yield f"imu: {_GIVEN} agrees with the rotation to {off:.2f} deg"
    scales = one.mount.shape[:3]
    if np.any(np.abs(scales) > np.maximum(_LEAST_SCALE, _SIGMAS * one.shape_deviations[:3])):
        percent = " ".join(f"{100.0 * scale:+.1f}" for scale in scales)
        yield f"imu: the gyroscope's scales are {percent} % off (allowed for)"


def numbers(values: Array, digits: int) -> str:
    """Join values (n,) beside each other."""
    return " ".join(f"{value:.{digits}f}" for value in values)
