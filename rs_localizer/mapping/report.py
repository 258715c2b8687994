"""What is to be said of a map that was built."""

from __future__ import annotations

import numpy as np

from rs_localizer.mapping.build import Built
from rs_localizer.mapping.inertial_placing import InertialPlace

PICTURES = ("map.png", "residuals.png")


def rows(built: Built, images: int, views: int) -> list[tuple[str, str]]:
    """The table: what was measured, name and text.

    Args:
        images: of the recording.
        views: of them that were looked at.
    """
    refined, covariances = built.refined, built.landmarks.covariances
    assert covariances is not None
    spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    unit, factor = ("mm", 1e3) if built.placement.scaled else ("units of the map / 1000", 1e3)
    keyframes, blurred = len(built.keyframes.chosen), int(built.keyframes.blurred.sum())
    joined = f"{built.structure.parts[0]} of {keyframes}"
    others = built.structure.parts[1:]
    readout = f"{1e3 * built.camera.readout_time:.2f} ms"
    if np.isfinite(refined.readout_time_deviation):
        readout += f" (estimated, deviation {1e3 * refined.readout_time_deviation:.2f} ms)"
    return [
        ("images", f"{images}, {views} used, {blurred} of them blurred"),
        ("keyframes that hang together", joined + (f"; other parts: {others}" if others else "")),
        ("images with a pose", f"{len(built.posed)} of {views}"),
        ("landmarks", f"{len(built.landmarks)} of {len(built.structure.points)} points"),
        ("deviation of a landmark", f"{factor * np.median(spread):.1f} {unit} (median)"),
        ("noise before the refinement", f"{refined.before:.2f} px"),
        ("noise after it", f"{refined.after:.2f} px"),
        ("readout time", readout),
        ("scale", built.placement.told),
        ("z is up", built.placement.up),
        *_of_imu(built.place),
    ]


def written(built: Built, images: int, views: int) -> str:
    """The same as a page of Markdown, with the pictures."""
    table = "\n".join(f"| {name} | {text} |" for name, text in rows(built, images, views))
    shown = "\n\n".join(f"![{name}]({name})" for name in PICTURES)
    return f"# Map\n\n| | |\n|---|---|\n{table}\n\n{shown}\n"


def _of_imu(place: InertialPlace) -> list[tuple[str, str]]:
    """What an IMU says, beside scale and up where it gives them."""
    metres = place.metres
    if metres is None:
        return []
    mount, found = metres.mount, metres.metric
    rows = []
    if place.checked:
        more = "larger" if place.larger > 0.0 else "smaller"
        share = 100.0 * np.array([abs(place.larger), metres.share])
        tilts = np.degrees([place.tilt, found.gravity_deviation])
        rows = [
            ("scale by the IMU", f"{share[0]:.2f} % {more}, +- {share[1]:.2f} %"),
            ("gravity by the IMU", f"{tilts[0]:.2f} deg from -z, +- {tilts[1]:.2f} deg"),
        ]
    offset = f"{1e3 * mount.mount.delay:+.2f} +- {1e3 * mount.delay_deviation:.2f} ms"
    bias = " ".join(f"{value:.2f}" for value in found.bias)
    return [*rows, ("imu.time_offset", offset), ("bias of the accelerometer", f"{bias} m/s^2")]
