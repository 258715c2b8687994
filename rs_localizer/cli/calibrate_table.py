"""The table that ``calibrate`` prints."""

from __future__ import annotations

import numpy as np

from rs_localizer.trajectory import verdict
from rs_localizer.trajectory.calibration import Calibration


def tell(found: Calibration, rate: float | None) -> None:
    """Values, the parts of the recording, and what is odd."""
    direction = verdict.scan_direction(found)
    rows = [
        ("readout time", f"{1e3 * verdict.readout_time(found):.3f} ms"),
        ("standard deviation", f"{1e3 * found.deviation:.3f} ms"),
        ("of it by noise alone", f"{1e3 * found.formal_deviation:.3f} ms"),
        ("scan direction", str(direction)),
        ("interval between images", f"{1e3 * found.stamps.interval:.3f} ms"),
        ("images with a pose", f"{len(found.posed.times)} of {found.images}"),
        ("noise of the keypoints", f"{found.fit.deviation:.3f} px"),
        ("keypoints that fit", f"{np.mean(found.fit.inliers):.1%}"),
        ("spacing of the knots", f"{1e3 * found.fit.state.spline.layout.spacing:.1f} ms"),
    ]
    for name, text in rows:
        print(f"{name:26} {text}")
    for block in found.blocks:
        print(
            f"  {block.start:6.1f} to {block.end:5.1f} s {'':5}"
            f"{1e3 * block.readout_time:+.3f} +- {1e3 * block.deviation:.3f} ms"
        )
    for remark in verdict.remarks(found):
        print(remark)
    if rate is not None:
        share = abs(found.readout_time) / found.stamps.interval
        print(
            f"the readout time is {share:.3f} of the interval: it scales with --rate, "
            f"assumed to be {rate:g} Hz"
        )


def tell_lens(found: Calibration) -> None:
    """The numbers of the lens."""
    state = found.fit.state
    deviations = np.sqrt(np.diag(found.fit.border_covariance)[1 : 1 + len(state.lens)])
    names = ("fx", "fy", "cx", "cy")
    print(f"{'lens':26} {found.fit.camera.distortion_model}")
    for k, value in enumerate(state.lens):
        name = names[k] if k < len(names) else f"D[{k - len(names)}]"
        print(f"{name:26} {value:.5g} +- {found.inflation * deviations[k]:.2g}")
    errors = found.lens
    print(
        f"{'what it is off by':26} centre {errors.principal_point:.2g} px, focal length "
        f"{100.0 * errors.focal_length:.2g} %, distortion {errors.distortion:.2g} px at the corners"
    )
