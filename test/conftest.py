# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages for the tests, written from the definitions of ROS and not by the package's code."""

import functools
import os
import signal
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from rs_localizer import native
from rs_localizer.native import COMPILES

# How long an example takes says nothing on a machine that compiles, or does something else.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")


def pytest_report_header() -> str:
    return f"kernels: {native.LEVEL or 'by Numba'}, {len(native.EDITED)} modules edited since"


def pytest_sessionstart() -> None:
    """CI tests what users get: no kernel that Numba compiles here, unless it was asked for."""
    if COMPILES and os.environ.get("CI") and "RS_LOCALIZER_KERNELS" not in os.environ:
        pytest.exit("kernels are not those of the native module: make kernels", returncode=3)


# The shell of a background job and nohup pass on ignored signals, which our processes respect.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(autouse=True)
def signal_handlers() -> Iterator[None]:
    """Who ends as a process does ignores signals, and so would all that later tests start."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def search_path() -> Iterator[None]:
    """A command that runs in this process leaves no path to its children, nor to later tests."""
    path, safe = list(sys.path), os.environ.get("PYTHONSAFEPATH")
    yield
    sys.path[:] = path
    os.environ.pop("PYTHONSAFEPATH", None)
    if safe is not None:
        os.environ["PYTHONSAFEPATH"] = safe


@pytest.fixture(scope="session")
def as_python() -> Callable[[Any], Callable[..., Any]]:
    """Makes callable what only kernels call; without Numba at work, the test is skipped."""
    if not COMPILES:
        pytest.skip("calls a kernel that is no entry: RS_LOCALIZER_KERNELS=numba runs it")
    from numba.core.registry import CPUDispatcher

    return lambda kernel: functools.partial(CPUDispatcher.__call__, kernel)


# sensor_msgs/PointField: number of a type -> code of struct.
STRUCT_CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
Field = tuple[str, int, int]  # name, offset, number of its type


def _header(stamp: tuple[int, int], frame: str) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]), frame_id=frame)


def pack_cloud(
    rows: Sequence[Sequence[float]],
    fields: Sequence[Field],
    *,
    point_step: int,
    height: int = 1,
    row_padding: int = 0,
    big_endian: bool = False,
    stamp: tuple[int, int] = (5, 7),
    frame: str = "map",
) -> SimpleNamespace:
    """A PointCloud2 with these rows (a value per field); unused bytes are 0xAA."""
    width = len(rows) // height
    row_step = width * point_step + row_padding
    data = bytearray(b"\xaa" * (height * row_step))
    for index, row in enumerate(rows):
        start = index // width * row_step + index % width * point_step
        for value, (_, offset, number) in zip(row, fields, strict=True):
            code = (">" if big_endian else "<") + STRUCT_CODES[number]
            struct.pack_into(code, data, start + offset, value)
    return SimpleNamespace(
        header=_header(stamp, frame),
        height=height,
        width=width,
        fields=[
            SimpleNamespace(name=name, offset=offset, datatype=number, count=1)
            for name, offset, number in fields
        ],
        is_bigendian=big_endian,
        point_step=point_step,
        row_step=row_step,
        data=np.frombuffer(bytes(data), np.uint8),
        is_dense=True,
    )


def camera_info(**changes: Any) -> SimpleNamespace:
    """A CameraInfo of an ideal 640x480 camera, with changes."""
    values = {
        "header": _header((5, 7), "camera"),
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.array([500.0, 0.0, 319.5, 0.0, 510.0, 239.5, 0.0, 0.0, 1.0]),
        "r": np.eye(3).ravel(),
        "p": np.zeros(12),
        "binning_x": 0,
        "binning_y": 0,
        "roi": SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False),
    }
    return SimpleNamespace(**(values | changes))


@pytest.fixture
def make_cloud_message() -> Callable[..., SimpleNamespace]:
    return pack_cloud


@pytest.fixture
def make_camera_info() -> Callable[..., SimpleNamespace]:
    return camera_info
