# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Words and settings of a calibration: the readout time, and the quality of lens and map."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.config import CalibrationErrors, NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.tools.adjust.intrinsics import LensErrors
from rs_localizer.tools.camera_calibration import CameraCalibration
from rs_localizer.tools.rig_mounts import Mounted

# Corners that are bent by less (px, deviations) are those of a rectified film, or of a telephoto
# lens.
_STRAIGHT, _SIGMAS = 1.5, 4.0


def readout_time(result: CameraCalibration) -> float:
    """Return the readout time (s) to be set: 0 for a global shutter."""
    return 0.0 if result.global_shutter else abs(result.readout_time)


def scan_direction(result: CameraCalibration) -> ScanDirection:
    """Return the direction that the sign of the readout time means."""
    given = ScanDirection(result.fit.camera.scan_direction)
    return given if result.global_shutter or result.readout_time > 0.0 else REVERSED[given]


def deviations(
    found: Sequence[CameraCalibration], maps: Sequence[MarkerMap], config: NodeConfig
) -> dict[str, float]:
    """Return the settings of the deviations of lens and map.

    Args:
        found: with lenses that were estimated, of which the worst counts; else those that were
            given hold on.
    """
    errors, known = config.calibration, dict[str, float]()
    if found or errors != CalibrationErrors():
        for name in LensErrors._fields:
            own = [float(getattr(each.lens, name)) for each in found] or [getattr(errors, name)]
            known[f"calibration.{name}"] = float(f"{max(own):.4g}")
    declared = [each.settings.get("map_deviation", 0.0) for each in maps]
    if map_deviation := config.map_deviation or max(declared, default=0.0):
        known["map_deviation"] = float(f"{map_deviation:.3g}")
    return known


def lens_refusal(result: CameraCalibration) -> str:
    """Return one line with the figure if the recording determines no lens; or ''."""
    camera = result.fit.camera
    if np.all((camera.K[:2, 2] > 0.0) & (camera.K[:2, 2] < camera.size)):
        return ""
    return (
        f"no lens: the principal point would be at {camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}, "
        "outside the image; show the map from several sides, in all parts of the image"
    )


def moved(result: CameraCalibration, points: Array) -> Array:
    """Return points (n,3) of the map where they were found; unseen ones stay."""
    given, found = result.posed.observations.landmarks, result.fit.state.landmarks
    places = dict(zip(map(tuple, given), found, strict=True))
    return np.array([places.get(tuple(point), point) for point in points])


def remarks(result: CameraCalibration) -> Iterator[str]:
    """Yield sentences on oddities, and on the worth of the value."""
    if result.global_shutter:
        yield (
            f"global shutter: 0 lies within the error of {1e3 * result.readout_time:+.3f} +- "
            f"{1e3 * result.deviation:.3f} ms"
        )
    if result.other_axis:
        yield (
            "rows are exposed along the other axis than assumed: scan_direction: "
            f"{scan_direction(result)}"
        )
    if result.stamps.irregular:
        yield f"stamps are irregular: {1e3 * result.stamps.jitter:.2f} ms rms about even intervals"
    if result.stamps.missing:
        yield f"{result.stamps.missing} images are missing between the others"
    if result.inflation > 1.0:
        yield (
            f"parts of the recording differ by more than their noise: the deviation is "
            f"{result.inflation:.1f} times that of the noise alone"
        )


def table(found: CameraCalibration, rate: float | None) -> Iterator[str]:
    """Yield rows of what was found; ``rate``: of the images, as it was given."""
    if found.processed:  # before figures that it makes worthless
        yield f"warning: {found.processed}"
    yield from _rows({
        "readout time": f"{1e3 * readout_time(found):.3f} ms",
        "standard deviation": f"{1e3 * found.deviation:.3f} ms",
        "scan_direction": str(scan_direction(found)),
        "images with a pose": f"{len(found.posed.times)} of {found.images}",
        "noise of the keypoints": f"{found.fit.deviation:.3f} px",
    })  # fmt: skip
    along = 1e3 * found.sense
    for block in found.blocks:
        yield (
            f"  {block.start:6.1f} to {block.end:5.1f} s {'':5}"
            f"{along * block.readout_time:+.3f} +- {1e3 * block.deviation:.3f} ms"
        )
    yield from remarks(found)
    if rate is not None:
        yield f"the readout time scales with --rate, assumed to be {rate:g} Hz"


def _rows(values: Mapping[str, str]) -> Iterator[str]:
    return (f"{name:26} {text}" for name, text in values.items())


def of_lens(found: CameraCalibration) -> Iterator[str]:
    """Yield rows of the lens with its deviations."""
    state, errors = found.fit.state, found.lens
    deviations = np.sqrt(np.diag(found.fit.border_covariance)[1 : 1 + len(state.lens)])
    names = ["fx", "fy", "cx", "cy", *(f"D[{k}]" for k in range(len(state.lens) - 4))]
    rows = zip(names, state.lens, found.inflation * deviations, strict=True)
    yield from _rows({"lens": str(found.fit.camera.distortion_model)})
    yield from _rows({name: f"{value:.5g} +- {spread:.2g}" for name, value, spread in rows})
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


def of_imu(found: CameraCalibration, stamp_offset: float) -> Iterator[str]:
    """Yield rows of the table, and sentences on oddities."""
    one = found.mount
    if one is None:
        yield f"imu: {found.no_mount}"
        return
    offset, spread = 1e3 * (one.time_offset + stamp_offset), 1e3 * one.time_offset_deviation
    turn = _numbers(Rotation.from_matrix(one.mount.camera_from_imu).as_quat(canonical=True), 5)
    error = _numbers(np.degrees(one.rotation_deviations), 3)
    bias, errors = (_numbers(np.degrees(each), 3) for each in (one.mount.bias, one.bias_deviations))
    values = {
        "imu.time_offset": f"{offset:+.3f} +- {spread:.3f} ms",
        "rotation camera <- imu": f"{turn} (x y z w) +- {error} deg",
        "gyroscope bias": f"{bias} +- {errors} deg/s",
    }
    for (name, text), known in zip(values.items(), one.determined, strict=True):
        yield f"{name:26} {text if known else f'not observable: {text}'}"
    if one.inflation > 1.0:
        yield (
            f"imu: parts of the recording have different offsets: the deviation is "
            f"{one.inflation:.1f} times that of the noise alone"
        )


def of_mount(name: str, first: str, found: Mounted) -> Iterator[str]:
    """Yield rows of a camera's mount beside the first one of a rig, and of its clock."""
    mounted, spread = found.extrinsics, found.deviations
    turn = Rotation.from_matrix(mounted.axes).as_quat(canonical=True)
    turned, moved = np.degrees(spread[:3]), 1e3 * spread[3:6]
    yield from _rows({
        f"{name} <- {first}": f"{_numbers(turn, 5)} (x y z w) +- {_numbers(turned, 3)} deg",
        f"place in {first}": f"{_numbers(1e3 * mounted.centre, 2)} +- {_numbers(moved, 2)} mm",
        "offset of its stamps": f"{1e3 * mounted.offset:+.3f} +- {1e3 * spread[6]:.3f} ms",
    })  # fmt: skip


def _numbers(values: Array, digits: int) -> str:
    """Join values (n,) beside each other."""
    return " ".join(f"{value:.{digits}f}" for value in values)
