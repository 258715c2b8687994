# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled in a process of their own: a node does not keep the compiler's memory."""

import ctypes
import hashlib
import re
import subprocess
import sys
from pathlib import Path

import numba
from numba.core.registry import cpu_target

from rs_localizer.core.simd import shipped
from rs_localizer.core.simd.jit import PARTS, cache_directory, digest

_PACKAGE = Path(__file__).resolve().parents[1]
# Until the end of its input says that the process that waits for it has ended. Collections of
# garbage would look through all that the compiler keeps.
_PROGRAM = """
import gc, os, sys, threading, warnings
threading.Thread(target=lambda: os._exit(sys.stdin.read() == ""), daemon=True).start()
gc.disable()
warnings.filterwarnings("error", "cache of kernels .* at the next start", RuntimeWarning)
from rs_localizer.config import NodeConfig
from rs_localizer.pipeline.compiling import note_compiled
from rs_localizer.pipeline.frames import FrameLocalizer
solver = sys.argv[1]
FrameLocalizer(NodeConfig(solver=solver, readout_time=0.03)).warm_up()
note_compiled(solver)
"""

# Mappings of LLVM's library: where, what may be done there, and kB that are no longer the file's.
_MAPPING = re.compile(
    r"^([0-9a-f]+-[0-9a-f]+) (\S+) .*libllvmlite\S*\n(?:\w+: .*\n)*?Anonymous: +(\d+) kB",
    re.MULTILINE,
)
_MADV_DONTNEED = 4  # Linux, <bits/mman-linux.h>


def is_compiled(solver: str) -> bool:
    """Whether all kernels of a solver's frames are on disk, by the note of who compiled them."""
    return shipped.FOLDER.is_dir() or _note(solver).is_file()


def note_compiled(solver: str) -> None:
    """Note that all kernels of a solver's frames are on disk.

    Raises:
        OSError: when that cannot be written there.
    """
    note = _note(solver)
    if not shipped.FOLDER.is_dir() and note.parent.is_dir():
        note.touch()


def compile_in_child(solver: str) -> None:
    """Compile what frames by a solver need and is not on disk yet.

    What fails there is compiled in this process, which then says why.
    """
    if is_compiled(solver):
        return
    program = [sys.executable, "-c", _PROGRAM, solver]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as child:
        child.wait()


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
    return cache_directory() / digest(PARTS[-1], _PACKAGE) / name
