"""What a calibration means, in words."""

from __future__ import annotations

from rs_localizer.core.scanning import ScanDirection
from rs_localizer.trajectory.calibration import Calibration
from rs_localizer.trajectory.online import REVERSED

# Of the images' own times, beyond which stamps are worth a word (s).
_MOST_JITTER = 5e-4
# Readouts cannot take longer than this part of the interval between images.
_LONGEST = 1.05


def readout_time(found: Calibration) -> float:
    """The readout time (s) to be set: 0 for a global shutter."""
    return 0.0 if found.global_shutter else abs(found.readout_time)


def scan_direction(found: Calibration) -> ScanDirection:
    """The direction that the sign of the readout time says."""
    given = ScanDirection(found.fit.camera.scan_direction)
    return given if found.global_shutter or found.readout_time > 0.0 else REVERSED[given]


def refusal(found: Calibration) -> str:
    """One line with the figure when the recording does not determine the readout time; or ''."""
    if found.determined:
        return ""
    value, deviation = 1e3 * found.readout_time, 1e3 * found.deviation
    if found.stabilised:
        return (
            f"not observable: parts of the recording disagree ({_blocks(found)} ms); is image "
            "stabilisation on?"
        )
    if found.jitter > _MOST_JITTER and found.deviation > 2.0 * found.formal_deviation:
        return (
            f"not observable: {value:.1f} +- {deviation:.1f} ms; images were exposed "
            f"{1e3 * found.jitter:.1f} ms rms beside their stamps: record with the camera's own "
            "time stamps, without losing images"
        )
    return (
        f"not observable: {value:.1f} +- {deviation:.1f} ms; move the camera faster, turn it to "
        "and fro about all axes, and for longer"
    )


def remarks(found: Calibration) -> list[str]:
    """Sentences on what is odd, and on what the value is worth."""
    said = []
    if found.global_shutter:
        said.append(
            f"global shutter: 0 lies within the error of {1e3 * found.readout_time:+.3f} +- "
            f"{1e3 * found.deviation:.3f} ms"
        )
    else:
        said.append(f"direction: the reversed one is 10^{found.odds:.0f} times less likely")
    if found.stamps.irregular:
        said.append(
            f"stamps are irregular: {1e3 * found.stamps.jitter:.2f} ms rms about even intervals"
        )
    if found.jitter > _MOST_JITTER:
        said.append(
            f"images were exposed {1e3 * found.jitter:.1f} ms rms beside their stamps, each at a "
            "time of its own, which was estimated: the value leans on the mean interval"
        )
    if found.stamps.missing:
        said.append(f"{found.stamps.missing} images are missing between the others")
    if found.stabilised:
        said.append(f"windows disagree ({_blocks(found)} ms): is image stabilisation on?")
    elif found.inflation > 1.0:
        said.append(
            f"parts of the recording differ ({_blocks(found)} ms) by more than their noise: the "
            f"deviation is {found.inflation:.1f} times that of the noise alone"
        )
    if found.held:
        said.append(
            f"the map's {found.held} points are taken as they are given: more than are estimated "
            "along; where they may be off by a thousandth of its size, show a smaller board"
        )
    if abs(found.readout_time) > _LONGEST * found.stamps.interval:
        said.append(
            f"longer than the interval between images, {1e3 * found.stamps.interval:.1f} ms: are "
            "the stamps, or the frame rate, right?"
        )
    return said


def _blocks(found: Calibration) -> str:
    return ", ".join(f"{1e3 * block.readout_time:.2f}" for block in found.blocks)
