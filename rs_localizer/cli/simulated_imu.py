"""The IMU of ``rs_localizer simulate``: its options, and the recording that holds it."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rs_localizer.cli import UsageError
from rs_localizer.cli.simulated_camera import option
from rs_localizer.io.bags import BagWriter
from rs_localizer.process.arguments import number
from rs_localizer.simulation.imu import ImuBagWriter, ImuSettings, Lever, simulate_imu
from rs_localizer.simulation.true_motion import TrueMotion

# Its random numbers are its own: the frames are the same with and without it.
_STREAM = 14
_OPTIONS = (
    "imu_rate",
    "gyroscope_noise",
    "gyroscope_bias",
    "gyroscope_bias_walk",
    "accelerometer_noise",
    "accelerometer_bias",
    "imu_offset",
)


def add_imu_arguments(group: argparse._ArgumentGroup) -> None:
    """Options that :func:`bag_of` reads."""
    imu = ImuSettings()
    group.add_argument(
        "--imu", action="store_true", help="write an IMU, too, and its mounting on /tf_static"
    )
    option(group, "--imu-rate", number(0.0, above=True), imu.rate, "HZ")
    option(group, "--gyroscope-noise", number(0.0), imu.gyroscope_noise, "N", "rad/s/sqrt(Hz)")
    option(group, "--gyroscope-bias", number(0.0), imu.gyroscope_bias, "B", "rad/s, any direction")
    option(
        group, "--gyroscope-bias-walk", number(0.0), imu.gyroscope_bias_walk, "N",
        "rad/s^2/sqrt(Hz)",
    )  # fmt: skip
    option(
        group, "--accelerometer-noise", number(0.0), imu.accelerometer_noise, "N",
        "m/s^2/sqrt(Hz)",
    )  # fmt: skip
    option(group, "--accelerometer-bias", number(0.0), imu.accelerometer_bias, "B", "m/s^2")
    option(
        group, "--imu-offset", number(), imu.time_offset, "S",
        "to add to its stamps to get the camera's time",
    )  # fmt: skip


def bag_of(args: argparse.Namespace, out: Path, motion: TrueMotion) -> BagWriter:
    """The recording that is written; with ``--imu`` one that holds its readings besides."""
    defaults = ImuSettings()
    settings = ImuSettings(*(getattr(args, name) for name in _OPTIONS))
    if not args.imu:
        if settings != defaults:
            raise UsageError("options of the IMU need --imu")
        return BagWriter(out, args.storage)
    lever = Lever()
    track = simulate_imu(motion, settings, lever, np.random.default_rng([args.seed, _STREAM]))
    return ImuBagWriter(out, args.storage, args.readout_time, track, settings, lever)
