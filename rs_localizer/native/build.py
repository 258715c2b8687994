# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the kernels: ``python -m rs_localizer.native.build`` in a checkout, or by ``setup.py``.

Numba compiles all entries (:mod:`rs_localizer.native.bitcode`, some two minutes of one processor
for each level), and a C compiler adds the way from Python. What Numba has compiled is kept in the
checkout, or in ``RS_LOCALIZER_OBJECTS``, by the digest of all that it was made from.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rs_localizer.native import levels, sources

# Numba's versions that make what bitcode.py expects, as in rs_localizer/process/missing.py.
NUMBA = ((0, 63), (0, 69))
OBJECTS = "RS_LOCALIZER_OBJECTS"
_HERE = Path(__file__).resolve().parent
_CPUS = {"v2": "x86-64-v2", "v3": "x86-64-v3", "v4": "x86-64-v4", "generic": "generic"}
_MACHINES = {level: machine for machine, known in levels.LEVELS.items() for level in known}
# glibc of manylinux_2_28, the oldest one that wheels run on.
_GLIBC = "2.28"
_FLAGS = (
    "-O3",
    "-DNDEBUG",
    "-fPIC",
    "-fvisibility=hidden",
    "-ffunction-sections",
    "-fdata-sections",
)
_EXACT = ("-ffp-contract=fast", "-fno-math-errno")


class CannotBuild(RuntimeError):
    """Something that the build needs is missing; the text says what to type."""


class _Compiler:
    """A C and C++ compiler for one machine: the system's, or Zig's for any and an old glibc."""

    def __init__(self, machine: str, is_portable: bool) -> None:
        self.machine = machine
        has_system = all(map(shutil.which, _system()))
        self._is_zig = is_portable or machine != platform.machine() or not has_system
        if self._is_zig and importlib.util.find_spec("ziglang") is None:
            raise CannotBuild(
                "no C compiler was found: apt install g++, or pip install ziglang"
                if not is_portable
                else "wheels for other machines are compiled by Zig: pip install ziglang"
            )

    def run(self, language: str, *arguments: str | Path, cpu: str = "") -> None:
        if self._is_zig:
            target = f"{self.machine}-linux-gnu.{_GLIBC}"
            command = [sys.executable, "-m", "ziglang", language, "-target", target]
            chosen = [f"-mcpu={cpu.replace('-', '_')}"] if cpu and cpu != "generic" else []
        else:
            command = [_system()[language == "c++"]]
            chosen = [f"-march={cpu}"] if cpu and cpu != "generic" else []
        given = [*command, *chosen, *map(str, arguments)]
        done = subprocess.run(given, capture_output=True, text=True)
        if done.returncode != 0:
            raise CannotBuild(f"{' '.join(given)}\n{done.stderr.strip()}")

    def link(self, objects: Sequence[Path], to: Path) -> None:
        """Write a module from objects; at once, for processes that run the old one."""
        part = to.with_suffix(".part")
        self.run("cc", "-shared", "-Wl,--gc-sections", "-s", *objects, "-o", part, "-lm")
        part.replace(to)


def _system() -> tuple[str, str]:
    return os.environ.get("CC", "gcc"), os.environ.get("CXX", "g++")


def eigen() -> Path:
    """Return the folder of Eigen's headers.

    Raises:
        CannotBuild: there is none.
    """
    folders = [Path(each) / "cmeel.prefix/include/eigen3" for each in sys.path if each]
    for folder in (*folders, Path("/usr/include/eigen3"), Path("/usr/local/include/eigen3")):
        if (folder / "Eigen/Dense").is_file():
            return folder
    raise CannotBuild(
        "Eigen's headers were not found: pip install cmeel-eigen, or apt install libeigen3-dev"
    )


def check_numba() -> str:
    """Return the version of Numba.

    Raises:
        CannotBuild: it is missing, or of a version that was not tried.
    """
    low, high = (".".join(map(str, bound)) for bound in NUMBA)
    line = f'pip install "numba>={low},<{high}"'
    try:
        version = importlib.metadata.version("numba")
    except importlib.metadata.PackageNotFoundError:
        raise CannotBuild(f"Numba compiles the kernels and was not found: {line}") from None
    if not NUMBA[0] <= tuple(map(int, version.split(".")[:2])) < NUMBA[1]:
        raise CannotBuild(f"Numba {version} was not tried with this package: {line}")
    return version


def build(
    to: Path, wanted: Sequence[str] = (), is_portable: bool = False, is_checkout: bool = False
) -> None:
    """Build modules into a folder.

    Args:
        wanted: levels; none: this machine's own.
        is_portable: for wheels: by Zig, for old systems.
        is_checkout: record the sources beside the module.

    Raises:
        CannotBuild: something is missing, or a compiler failed.
    """
    to.mkdir(parents=True, exist_ok=True)
    machines = {_MACHINES[level] for level in wanted} or {platform.machine()}
    for machine in machines:
        if "v2" in levels.LEVELS.get(machine, ()):
            _build_probe(_Compiler(machine, is_portable), to)
    for level in wanted or (_own_level(to),):
        _build_level(level, to, is_portable, is_checkout)


def _own_level(folder: Path) -> str:
    if platform.machine() == "aarch64":
        return "generic"
    probe = f"import sys; sys.path.insert(0, {str(folder)!r}); import _cpu; print(_cpu.level())"
    said = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    return said.stdout.strip()


def _build_probe(compiler: _Compiler, to: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch, "cpu.o")
        compiler.run("cc", *_FLAGS, "-c", _HERE / "cpu.c", "-o", made)
        compiler.link([made], to / "_cpu.abi3.so")


def _build_level(level: str, to: Path, is_portable: bool, is_checkout: bool) -> None:
    module, record = to / levels.file_of(level).name, to / levels.record_of(level).name
    key = _key(level)
    glue = hashlib.sha256(key.encode())
    for source in sorted((*_HERE.glob("*.c"), *_HERE.glob("*.h"), *_HERE.glob("*.cpp"))):
        glue.update(source.read_bytes())
    known = json.loads(record.read_text()) if is_checkout and record.is_file() else {}
    if not (module.is_file() and known.get("digest") == glue.hexdigest()):
        _link(level, module, key, _Compiler(_MACHINES[level], is_portable))
    if is_checkout:
        files = {str(path.relative_to(sources.PACKAGE)): path for path in sorted(_all_files())}
        said = {
            "digest": glue.hexdigest(),
            "files": {name: sources.digest_of_file(path) for name, path in files.items()},
            "modules": sources.digests(),
        }
        record.write_text(json.dumps(said, indent=1))


def _link(level: str, module: Path, key: str, compiler: _Compiler) -> None:
    """Link a level's module from compiled kernels, and compile those that are missing."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = _compiled(level, key)
        objects = [folder / "kernels.o"]
        definitions = (f'-DRS_LEVEL="{level}"', f"-DRS_LEVEL_NAME={level}", "-I", str(_HERE))
        for source in (_HERE / "runtime.c", folder / "table.c"):
            objects.append(Path(scratch, f"{source.stem}.o"))
            compiler.run("cc", *_FLAGS, *definitions, "-c", source, "-o", objects[-1])
        objects.append(Path(scratch, "linear_algebra.o"))
        compiler.run(
            "c++", *_FLAGS, *_EXACT, "-std=c++14", "-fno-exceptions", "-fno-rtti",
            "-fno-threadsafe-statics", "-I", eigen(), "-c", _HERE / "linear_algebra.cpp",
            "-o", objects[-1], cpu=_CPUS[level],
        )  # fmt: skip
        compiler.link(objects, module)


def _all_files() -> set[Path]:
    found = {
        sources.path_of(each) for name in sources.kernel_modules() for each in sources.closure(name)
    }
    return {path for path in found if path is not None}


def _environment(level: str, is_host: bool) -> dict[str, str]:
    """Return the environment in which Numba compiles for a level, always in one order."""
    return {
        "NUMBA_CPU_NAME": _CPUS[level] if is_host else "x86-64-v2",
        "NUMBA_CPU_FEATURES": "",
        "PYTHONHASHSEED": "0",
    }


def _key(level: str) -> str:
    """Return the digest of all sources and tools that the kernels of a level are compiled with."""
    sha = hashlib.sha256(json.dumps(sources.digests()).encode())
    for tool in ("bitcode.py", "jit.py", "declared.py"):
        sha.update((_HERE / tool).read_bytes())
    versions = [check_numba(), importlib.metadata.version("llvmlite"), sys.version_info[:2]]
    sha.update(repr((level, _CPUS[level], platform.machine(), *versions)).encode())
    return sha.hexdigest()[:16]


def _compiled(level: str, key: str) -> Path:
    """Return the folder with Numba's output for a level, and compile it if it is missing."""
    kept = Path(os.environ.get(OBJECTS) or sources.PACKAGE.parent / ".kernels" / "objects")
    folder = kept / f"{level}-{key}"
    if (folder / "about.json").is_file():
        return folder
    host = platform.machine() == _MACHINES[level]
    environment = os.environ | {
        "RS_LOCALIZER_KERNELS": "build",
        **_environment(level, host),
        "PYTHONPATH": os.pathsep.join([str(sources.PACKAGE.parent), *filter(None, sys.path)]),
    }
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=kept) as scratch:
        triple = f"{_MACHINES[level]}-unknown-linux-gnu"
        done = subprocess.run(
            [sys.executable, "-m", "rs_localizer.native.bitcode", scratch, _CPUS[level], triple],
            env=environment, cwd=scratch,
        )  # fmt: skip
        if done.returncode != 0:
            raise CannotBuild(f"Numba could not compile the kernels for {level}")
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(scratch, folder)
    return folder


def main() -> int:
    """Build into the checkout; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m rs_localizer.native.build", description=__doc__
    )
    parser.add_argument(
        "--environment",
        action="store_true",
        help="print the environment in which Numba compiles for this machine's level, and end",
    )
    parser.add_argument(
        "levels", nargs="*", help=f"of {', '.join(_MACHINES)}; none: this machine's"
    )
    given = parser.parse_args()
    if unknown := set(given.levels) - set(_MACHINES):
        parser.error(f"unknown level {min(unknown)!r}; choose of {', '.join(_MACHINES)}")
    if given.environment:
        said = _environment(_own_level(_HERE), True)
        print(*(f"{name}={value}" for name, value in said.items()))
        return 0
    try:
        build(_HERE, given.levels, is_checkout=True)
    except CannotBuild as missing:
        print(f"rs_localizer: {missing}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
