# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The gyroscope inside a video (GoPro, Insta360, Sony) as the topic ``imu`` of its recording.

    rs_localizer detect GX010042.MP4 --map wall.yaml --camera camera.yaml --out seen
    python examples/video_imu.py GX010042.MP4 seen seen_imu

Of a stabilized video the images do not fit the gyroscope: switch HyperSmooth off.
"""

import shutil
from pathlib import Path

import numpy as np
from script import run

from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.imu import make_reading
from rs_localizer.io.recording import CAMERA_FRAME

# Optical axes (x right, y down, z forward) from telemetry-parser's. On GoPro's sample of a HERO5
# the gyroscope agrees with the motion of the image so (correlation 0.99), and gravity points down.
CAMERA_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
START_NS = 1_000_000_000  # of a video in recordings, see docs/recordings.md


def main(video: str, seen: str, out: str) -> None:
    """Write what ``detect`` has seen in a video, with the readings of its gyroscope."""
    import telemetry_parser

    found = telemetry_parser.Parser(video).normalized_imu()
    readings = [reading for reading in found if reading["gyro"] is not None]
    with open_bag(seen) as bag, BagWriter(out) as writer:
        for topic, recorded_ns, message in bag.messages(bag.topics):
            writer.write(topic, message, recorded_ns)
        for reading in readings:
            stamp_ns = START_NS + round(1e6 * reading["timestamp_ms"])
            rate = CAMERA_FROM_SENSOR @ np.radians(reading["gyro"])
            force = CAMERA_FROM_SENSOR @ (reading["accl"] or [np.nan] * 3)
            writer.write("/imu", make_reading(stamp_ns, rate, force, CAMERA_FRAME), stamp_ns)
    if (settings := Path(seen) / "parameters.yaml").is_file():
        shutil.copy(settings, out)
    print(f"{out}: {len(readings)} readings")


if __name__ == "__main__":
    run(main, "VIDEO SEEN OUT")
