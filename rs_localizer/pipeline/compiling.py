# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Order of compiling: what a plain frame needs before it, the rest beside the frames.

Whoever calls a kernel that is not in the cache waits for the process that compiles it
(:mod:`rs_localizer.core.simd`); a node's frames do not wait but are refused. So this asks for
kernels by calling them, in the order in which they are likely to be needed.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
from numba.core.registry import cpu_target

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.simd import compiler
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.inertial.gyroscope_noise import InertialSettings
from rs_localizer.inertial.samples import ImuSamples, span_of
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.tracking import Tracker

_LAST = "markers"  # last folder with kernels of frames
_READOUT_TIME, _PERIOD_NS = 0.03, 33_000_000
_POINTS, _FRAMES = 60, 3  # beside fewer than min_inliers
_TURN_RATE = 1.0  # rad/s: faster than rest, and slow enough for all points to be found

# Mappings of LLVM's library: where, what may be done there, and kB that are no longer the file's.
_MAPPING = re.compile(
    r"^([0-9a-f]+-[0-9a-f]+) (\S+) .*libllvmlite\S*\n(?:\w+: .*\n)*?Anonymous: +(\d+) kB",
    re.MULTILINE,
)
_MADV_DONTNEED = 4  # Linux, <bits/mman-linux.h>


def plain_frames(
    localizer: Localizer, inertial: InertialSettings | None = None, patient: bool = True
) -> None:
    """Call what frames of a moving camera before a scene that is no plane need, up to messages.

    Args:
        localizer: of the settings; its camera may be another.
        inertial: of the IMU beside it; None: there is none.
        patient: wait for what joins frames, too; else it is ordered, and frames stand alone.
    """
    camera = next(iter(localizer.rig.cameras.values()))
    rng = np.random.default_rng(0)
    count = max(_POINTS, localizer.config.min_inliers)
    pixels = rng.uniform(0.2, 0.8, (count, 2)) * camera.size
    rays = np.nan_to_num(camera.rays(pixels))
    points = (2.0 + np.arange(count) % 3)[:, None] * np.column_stack([rays, np.ones(count)])
    scores = np.arange(count, dtype=np.float64)
    try:
        tracker = Tracker(Localizer(_timed(camera), localizer.config), inertial)
    except ValueError:  # a global shutter
        _publish(Localizer(camera, localizer.config).localize(points, pixels, scores))
        return
    # Rolls by a frame's period, and by its rows.
    centre, row_times = 0.5 * np.array(camera.size), camera.row_time(pixels) * _READOUT_TIME
    for k in range(_FRAMES):
        time_ns = (k + 1) * _PERIOD_NS
        angle = _TURN_RATE * (1e-9 * time_ns + row_times)
        x, y = (pixels - centre).T
        turned = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
        each = centre + np.column_stack(turned) + rng.normal(0.0, 0.3, pixels.shape)
        times = time_ns + np.arange(-300, 30) * 2_000_000
        rates = np.tile([0.0, 0.0, -_TURN_RATE], (len(times), 1))
        samples = None if inertial is None else ImuSamples(times, rates)
        with contextlib.nullcontext() if patient or k == 0 else at_once():
            try:
                if inertial is not None:  # as they are taken from a buffer
                    span_of(times, time_ns, time_ns + 1)
                _publish(tracker.localize(time_ns, points, each, scores, imu=samples))
            except NotCompiled:
                return


def _publish(result: Estimate | Failure) -> None:
    """Call what messages of a frame need."""
    if result:
        so3.quaternion(pose_at(result, 0.5).rotation.copy())
        twist_at(result, 0.5, 1.0)


def _timed(camera: Camera) -> Camera:
    return camera if camera.readout_time > 0.0 else replace(camera, readout_time=_READOUT_TIME)


def is_whole(solver: str) -> bool:
    """True if a note says that the rest of a solver's kernels has been compiled."""
    return _note(solver).is_file()


def note_whole(solver: str) -> None:
    """Note beside the machine code that all kernels of a solver's frames are there.

    Raises:
        OSError: when that cannot be written.
    """
    note = _note(solver)
    make_folder(note.parent)
    note.touch()


def compile_rest(solver: str) -> bool:
    """Have the rest compiled beside the frames, unless that has been done; whether it was not."""
    if is_whole(solver):
        return False
    compiler.order(compiler.Request(__name__, _all_kernels.__name__, (solver,), False))
    return True


def _all_kernels(solver: str) -> None:
    from rs_localizer.config import NodeConfig
    from rs_localizer.pipeline.frames import FrameLocalizer  # which imports this

    FrameLocalizer(NodeConfig(solver=solver, readout_time=_READOUT_TIME)).warm_up_rest()


def give_back_compiler() -> None:
    """Unmap what was read of LLVM's library, 66 MB, which a running kernel does not need.

    Only pages that are those of the file: they come back from it when anything else is compiled or
    loaded. Does nothing where the system is not Linux.
    """
    try:
        text = Path("/proc/self/smaps").read_text()
    except OSError:
        return
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    for place, rights, anonymous in _MAPPING.findall(text):
        if "w" not in rights and anonymous == "0":
            begin, end = (int(number, 16) for number in place.split("-"))
            madvise(begin, end - begin, _MADV_DONTNEED)


def _note(solver: str) -> Path:
    """A file beside the machine code of these sources; Numba files code by the rest."""
    target = cpu_target.target_context.codegen().magic_tuple()
    about = repr((solver, sys.version, numba.__version__, target))
    name = f"rs_localizer.{solver}-{hashlib.sha256(about.encode()).hexdigest()[:16]}"
    return cache_directory() / digest(_LAST) / name
