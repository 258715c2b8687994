# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One recording of many: what a worker does with it, and what it answers."""

import contextlib
import fcntl
import functools
import hashlib
import io
import json
import pickle
import shutil
import socket
import subprocess
import sys
import threading
import time
import uuid
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numba
from llvmlite import binding

from rs_localizer.core.simd.jit import cache_directory
from rs_localizer.io.atomic_files import write_errors
from rs_localizer.io.remote import Location, fingerprint, is_url


@contextlib.contextmanager
def alone_until_compiled(kernels: str) -> Iterator[bool]:
    """Within ``with``, no other process of this machine is, unless one has been through.

    Args:
        kernels: names what is compiled within.

    Returns:
        whether this is the first one.
    """
    folder = cache_directory() / "fleet"
    done = folder / _name(kernels)
    lock = None if done.exists() else _locked(done)
    try:
        yield lock is not None
        if lock is not None:
            with contextlib.suppress(OSError):
                done.touch()
    finally:
        if lock is not None:
            lock.close()


def _name(kernels: str) -> str:
    config: Any = numba.config
    cpu = config.CPU_NAME or binding.get_host_cpu_name()
    # Numba takes no machine code of another version of itself or of Python.
    compiler = f"{numba.__version__} {sys.implementation.cache_tag}"
    said = f"{program()} {kernels} {compiler} {cpu}"
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def _locked(done: Path) -> IO[str] | None:
    """A lock that goes with the process, however it ends; None: nobody needs to wait (any more)."""
    try:
        done.parent.mkdir(parents=True, exist_ok=True)
        lock = done.with_suffix(".lock").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError:  # nothing can be kept there: each process compiles for itself
        return None
    if done.exists():
        lock.close()
        return None
    return lock


LOG = "log.txt"
"""What the command would have said of the recording."""

PARTIAL = ".partial"
"""Below the directory of all results: those that are not complete."""

Figures = dict[str, float | int | str]
"""What the summary says of a recording, by the name of the column."""

_WARM = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "warm, arguments = pickle.load(sys.stdin.buffer); warm(arguments)"
)

# What is printed can be told apart only while one task of a process prints.
_PRINTING = threading.Lock()


@dataclass(frozen=True, slots=True)
class Kind:
    """What is done with each recording, by functions that a worker can import."""

    command: str
    # Arguments of the command, recording (a path; a URL where the command takes URLs), folder to
    # create: does it, as for one recording alone.
    work: Callable[[Namespace, Any, Path], Figures]
    kernels: str  # names what has to be compiled for it
    # Compiles just that; without it, the first recording on a machine does, and the others wait.
    warm: Callable[[Namespace], None] | None = None


@dataclass(frozen=True, slots=True)
class Task:
    """One recording, and all that its result depends on."""

    kind: Kind
    arguments: Namespace
    recording: Location  # absolute, as are all paths: workers are elsewhere
    out: Path  # directory of all results
    name: str  # of the folder in it
    identity: str
    program: str  # of who asks

    @property
    def folder(self) -> Path:
        """Of the result."""
        return self.out / self.name


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task."""

    name: str
    figures: Figures | None  # None: it failed
    reason: str = ""  # why, in one line
    seconds: float = 0.0


def finished(task: Task) -> Figures | None:
    """The figures of a complete result of just this task; None: there is none."""
    marker = read_marker(task.folder)
    if marker is None or marker["identity"] != task.identity:
        return None
    return dict(marker["figures"])


def perform(task: Task) -> Outcome:
    """Do a task, unless it has been done: its folder is there afterwards, whole, or not at all.

    Whatever goes wrong with the recording is an outcome, not an exception.
    """
    started = time.perf_counter()
    reason, figures = _unfit(task), None
    if not reason:
        figures = finished(task)
        if figures is None:
            figures, reason = _attempt(task)
    return Outcome(task.name, figures, reason, time.perf_counter() - started)


def _unfit(task: Task) -> str:
    """Why this process cannot do it; empty: it can."""
    here = socket.gethostname()
    if program() != task.program:
        return (
            f"worker on {here} has another rs_localizer (sources {program()}, here "
            f"{task.program}): install the same on both"
        )
    if not task.out.is_dir():
        return f"worker on {here} does not see {task.out}: machines have to share its file system"
    return ""


def _attempt(task: Task) -> tuple[Figures | None, str]:
    # A folder of its own: a worker that is taken for lost may still be at it.
    partial = task.out / PARTIAL / uuid.uuid4().hex
    inner = partial / task.name  # under its final name, which some files repeat
    said = io.StringIO()
    try:
        with write_errors(partial):
            partial.mkdir(parents=True)
        with _PRINTING, contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            figures = _work(task, inner)
        with write_errors(inner):
            inner.mkdir(exist_ok=True)
            text = said.getvalue().replace(str(inner), task.name)
            (inner / LOG).write_text(text, encoding="utf-8")
            _complete(task, inner, figures)
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if not isinstance(error, (ValueError, OSError)):
            text = f"{type(error).__name__}: {text}"
        return None, text.replace(str(inner), str(task.folder))
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return figures, ""


def _work(task: Task, folder: Path) -> Figures:
    kind = task.kind
    if kind.warm is not None:
        compiled_elsewhere(kind.kernels, kind.warm, task.arguments)
        return kind.work(task.arguments, task.recording, folder)
    with alone_until_compiled(kind.kernels) as first:
        if first:
            return kind.work(task.arguments, task.recording, folder)
    return kind.work(task.arguments, task.recording, folder)


def compiled_elsewhere(kernels: str, warm: Callable[[Any], None], arguments: Any) -> None:
    """Compile in another process, unless this machine has compiled it before.

    A process that has compiled kernels itself rounds differently than those that load them.

    Args:
        kernels: names what ``warm(arguments)`` compiles.
        warm: a function that another process can import.
        arguments: can be pickled.
    """
    with alone_until_compiled(kernels) as first:
        if not first:
            return
        given = pickle.dumps(sys.path) + pickle.dumps((warm, arguments))
        words = [sys.executable, "-c", _WARM]
        if subprocess.run(words, input=given, capture_output=True, check=False).returncode != 0:
            warm(arguments)  # says why


def _complete(task: Task, inner: Path, figures: Figures) -> None:
    """Mark a finished result as complete, and give it its place, at once."""
    about = {
        "identity": task.identity,
        "program": task.program,
        "command": task.kind.command,
        "recording": str(task.recording),
        "settings": readable(task.arguments),
        "figures": figures,
    }
    text = json.dumps(about, indent=2, default=str)
    (inner / MARKER).write_text(f"{text}\n", encoding="utf-8")
    if finished(task) is None and read_marker(task.folder) is not None:
        task.folder.rename(inner.with_name("replaced"))  # of other settings
    try:
        inner.rename(task.folder)
    except OSError:
        if finished(task) is None:  # else another worker, taken for lost, has done it
            raise


def readable(arguments: Namespace) -> dict[str, object]:
    """The arguments of a command as JSON has them."""
    return {
        name: value if isinstance(value, (bool, int, float, list, type(None))) else str(value)
        for name, value in sorted(vars(arguments).items())
    }


MARKER = "fleet.json"
"""Written last into a result's folder: it is complete, and of what."""

_PACKAGE = Path(__file__).parents[2]


@functools.cache
def program() -> str:
    """A digest of the sources of this package, its version among them."""
    digest = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(_PACKAGE).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def identity(command: str, settings: Mapping[str, Any], inputs: Sequence[Location]) -> str:
    """A digest of all that decides what a result is.

    Args:
        command: what is done with the recording.
        settings: how, as text can say it.
        inputs: the recording and all other files that are read; known by the names, sizes and
            times of what is in them, since reading all of a recording takes long.
    """
    said = json.dumps(
        [program(), command, settings, [_fingerprint(place) for place in inputs]],
        sort_keys=True,
        default=str,
    )
    return hashlib.sha256(said.encode()).hexdigest()


def _fingerprint(place: Location) -> list[tuple[str, int, int]] | str:
    """Name below the path, size and time of change (ns) of each file; of nothing, nothing."""
    if is_url(place):
        return fingerprint(place)
    path = Path(place)
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    entries = []
    for file in files:
        if file.is_file():
            about = file.stat()
            name = file.relative_to(path).as_posix()
            entries.append((name, about.st_size, about.st_mtime_ns))
    return entries


def read_marker(folder: Path) -> dict[str, Any] | None:
    """What is written into a complete result; None: the folder is none."""
    try:
        content = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_ours = isinstance(content, dict) and {"identity", "figures"} <= set(content)
    return content if is_ours else None


def folder_names(recordings: Sequence[Location], reserved: Collection[str] = ()) -> list[str]:
    """A name for each recording: its own, with as many parent folders as tell it from the others.

    Args:
        recordings: different absolute paths, or URLs.
        reserved: names of what else is there.

    Returns:
        as many different names: of ``a/flight`` and ``b/flight``, ``a_flight`` and ``b_flight``.
    """
    paths = [_as_path(place) for place in recordings]
    names: dict[Path, str] = {}
    depth = 1
    while unnamed := [path for path in paths if path not in names]:
        labels = {path: _label(path, depth) for path in unnamed}
        counts = Counter(labels.values())
        taken = {*reserved, *names.values()}
        deepest = depth > max(len(path.parts) for path in unnamed)
        for path, label in labels.items():
            if counts[label] == 1 and label not in taken:
                names[path] = label
            elif deepest:  # "a/b_c" and "a_b/c", say
                names[path] = _numbered(label, {*taken, *names.values()})
        depth += 1
    return [names[path] for path in paths]


def _as_path(place: Location) -> Path:
    """Of a URL: its parts below the scheme."""
    return Path("/", place.replace("://", "/")) if is_url(place) else Path(place)


def _label(path: Path, depth: int) -> str:
    """The last parts of a path; the suffix of a file only where folders alone do not tell."""
    plain = depth == 1 and not path.is_dir()
    name = path.stem if plain else path.name
    parents = [part.strip("/") for part in path.parts[:-1]]
    return "_".join([*filter(None, parents[len(parents) + 1 - depth :] if depth > 1 else []), name])


def _numbered(label: str, taken: set[str]) -> str:
    number = 2
    while f"{label}_{number}" in taken:
        number += 1
    return f"{label}_{number}"
