# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels come from a process that compiles them, once; and nobody has to wait."""

import os
import re
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

FIRST = """
import numpy as np
from rs_localizer.core import so3
from rs_localizer.core.simd import compiler
with compiler.told(lambda count, name: print(count, name, flush=True)):
    print(repr(so3.exp_many(np.linspace(0.0, 3.0, 30).reshape(10, 3)).tobytes().hex()))
print("asked a process:", compiler._compiler._child is not None)
"""
AT_ONCE = """
import time
import numpy as np
from rs_localizer.core import so3
from rs_localizer.core.simd.jit import NotCompiled, at_once
turn, refused = np.eye(3), 0
while True:
    try:
        with at_once():
            assert np.all(so3.log(turn) == 0.0)
        break
    except NotCompiled as missing:
        refused += 1
        time.sleep(0.1)
print(refused > 0, so3.log.overloads != {})
"""
LONG = """
import numpy as np
from rs_localizer.core import so3
print("begins", flush=True)
so3.exp_many(np.zeros((1, 3)))
"""
CALLS = """
import time
import numpy as np
from rs_localizer.core import so3
from rs_localizer.core.simd.compiler import Request, order
from rs_localizer.core.simd.jit import NotCompiled, at_once
order(Request("rs_localizer.estimation.observations", "warm_up", (), False))
order(Request("rs_localizer.core.so3", "no_such_function", (), False))
while True:
    try:
        with at_once():
            assert np.all(so3.log(np.eye(3)) == 0.0)
        break
    except NotCompiled:
        time.sleep(0.1)
"""


@pytest.fixture
def start(tmp_path):
    """Starts a program whose cache is empty at first."""

    def start(program: str, cache: str = "cache", **more: str) -> subprocess.Popen[str]:
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / cache)} | more
        environment.pop("NUMBA_CACHE_DIR", None)
        return subprocess.Popen(
            [sys.executable, "-W", "error", "-c", program], env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip

    return start


def said(process: subprocess.Popen[str]) -> list[str]:
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert errors == ""
    return out.splitlines()


def test_who_has_it_compiled_and_who_loads_it_have_the_same_bits(start, tmp_path):
    """Two processes that need it at once, and one that comes later."""
    both = [said(one) for one in [start(FIRST) for _ in range(2)]]
    bits = both[0][-2]
    assert both[1][-2] == bits
    assert ["1 _exp_many", bits, "asked a process: True"] in both
    assert len(list((tmp_path / "cache").rglob("*_exp_many*.nbc"))) == 1
    assert said(start(FIRST)) == [bits, "asked a process: False"]


def test_a_kernel_is_the_same_code_wherever_it_is_compiled(start, tmp_path):
    """Numba goes through sets of names, whose order is another in each process."""
    ended = [start(LONG, cache, PYTHONHASHSEED=cache) for cache in ("1", "3")]
    assert [said(process) for process in ended] == [["begins"]] * 2
    one, other = (kernels(tmp_path / cache) for cache in ("1", "3"))
    assert one == other
    assert "_exp_many" in " ".join(one)


def kernels(cache: Path) -> dict[str, bytes]:
    """Kernels of a cache without what differs from process to process: where functions lie."""
    files = cache.rglob("*.nbc")
    return {file.name: re.sub(rb"0x[0-9a-f]+", b"", file.read_bytes()[4:]) for file in files}


def test_who_must_not_wait_is_told_until_it_is_there(start):
    assert said(start(AT_ONCE)) == ["True True"]


def test_a_function_is_called_where_its_kernels_are_compiled_and_others_go_on(start, tmp_path):
    """Also after one that fails."""
    assert said(start(CALLS)) == []
    kept = {path.name.partition("-")[0] for path in (tmp_path / "cache").rglob("*.nbc")}
    assert {"observations.thin", "so3.log"} <= kept


def test_the_compiler_ends_with_who_asks_it(start):
    process = start(LONG)
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n"
    group = os.getpgid(process.pid)
    deadline = time.monotonic() + 60.0
    while len(members(group)) < 3:  # who asks, who waits, who compiles
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    while members(group):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def members(group: int) -> list[int]:
    """Processes of a group that are no zombies."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = path.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(its_group) == group and state != "Z":
            found.append(int(path.parent.name))
    return found


def test_without_a_compiler_a_kernel_is_compiled_where_it_is_called(start, tmp_path):
    """A cache that cannot be written is a warning, and no reason to fail."""
    (tmp_path / "cache").write_text("a file")
    process = start(
        FIRST.replace(
            "with compiler", "import warnings\nwarnings.simplefilter('default')\nwith compiler"
        )
    )
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert "kernels are compiled again at the next start" in errors
    assert out.splitlines()[0] == "1 _exp_many"


def test_who_must_not_wait_compiles_what_cannot_be_had_elsewhere(start, tmp_path):
    """Or frames would be refused for ever where the cache cannot be written."""
    (tmp_path / "cache").write_text("a file")
    process = start("import warnings\nwarnings.simplefilter('ignore')\n" + AT_ONCE)
    assert said(process) == ["True True"]


def weak_functions(code: bytes) -> list[str]:
    """Names of the weak functions of an ELF file of 64 bits."""
    first, size, count = (
        struct.unpack_from(kind, code, at)[0] for kind, at in (("<Q", 40), ("<H", 58), ("<H", 60))
    )
    headers = [struct.unpack_from("<IIQQQQIIQQ", code, first + size * k) for k in range(count)]
    names = []
    for header in headers:
        if header[1] != 2:  # of symbols
            continue
        text = headers[header[6]][4]
        for place in range(header[4], header[4] + header[5], 24):
            name, info, _, section = struct.unpack_from("<IBBH", code, place)
            if info >> 4 == 2 and info & 15 == 2 and section:
                names.append(code[text + name : code.index(b"\0", text + name)].decode())
    return names


def test_kernels_call_copies_of_their_own(start, tmp_path):
    """The first copy that a process loads would serve all, and digits depend on the order."""
    said(start("import numpy as np; from rs_localizer.core import so3\n"
               "so3.exp_many(np.zeros((1, 3)))"))  # fmt: skip
    objects = [
        content[content.index(b"\x7fELF") :]
        for path in (tmp_path / "cache").rglob("*.nbc")
        if b"\x7fELF" in (content := path.read_bytes())
    ]
    assert len(objects) > 1
    assert [weak_functions(code) for code in objects] == [[]] * len(objects)
