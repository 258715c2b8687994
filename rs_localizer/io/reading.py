# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Readers of text, YAML and JSON of people and programs, all with limits.

Files come from others. A file that is larger than anybody writes, or crashes the library that reads
it, is refused in a sentence.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

LENS = "lens"
"""The entry of a params file with the lens of the camera, or of each camera of a rig."""

# A file may name a part of itself again; counted at every place, so that few lines do not stand
# for a thousand million values, or for endlessly many. Programs write more, as JSON.
_MOST_VALUES, _MOST_JSON, _DEEPEST = 100_000, 1_000_000, 50
# libyaml reads 5 MB a second, PyYAML alone a tenth of that.
_MOST_CHARACTERS = 2_000_000
# Characters of a file, of which JSON alone uses this many; /dev/zero and some pipes never end.
_LONGEST = 20_000_000
# Longest text of a number; numbers of base 60 ("1:0:0 ...", YAML 1.1) take time that grows with its
# square.
_LONGEST_NUMBER = 100


class YamlError(ValueError):
    """Text that is no YAML, or more than anybody writes."""


@contextlib.contextmanager
def file_faults(path: Path, fault: type[ValueError], kind: str = "YAML") -> Iterator[None]:
    """Name the file in faults of reading a text file and of its content."""
    try:
        yield
    except OSError as error:
        raise fault(f"{path} cannot be read: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError) as error:
        raise fault(f"{path} is not a {kind} file: {' '.join(str(error).split())}") from error


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Read the text of a file.

    Raises:
        YamlError: for one that is longer than anybody writes, or does not end.
        OSError, UnicodeDecodeError: as any file.
    """
    with path.open(encoding=encoding) as file:
        text = file.read(_LONGEST + 1)
    if len(text) > _LONGEST:
        raise YamlError(f"it has more than {_LONGEST} characters")
    return text


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's, without what takes much more time or memory than its text does."""

    def flatten_mapping(self, node: Any) -> None:
        """Refuse merges (``<<``), which copy mappings, and copies of copies."""
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise YamlError("it merges mappings (<<), which parameters of ROS do not either")

    def construct_scalar(self, node: Any) -> Any:
        is_number = node.tag.rpartition(":")[2] in ("int", "float", "timestamp")
        if is_number and len(str(node.value)) > _LONGEST_NUMBER:
            raise YamlError(f"it holds a number of {len(node.value)} characters")
        return super().construct_scalar(node)


def load_yaml(text: str) -> Any:
    """Return the content of the text, YAML or JSON: mappings, lists, and plain values.

    Raises:
        YamlError: for anything else, saying what was found.
    """
    if text.lstrip()[:1] in ("{", "[") and text.count(",") <= _MOST_JSON:
        try:
            tree = json.loads(text)
        except (ValueError, RecursionError):
            pass  # YAML's flow style, or its message if that fails, too
        else:
            return _checked(tree, _MOST_JSON)
    if len(text) > _MOST_CHARACTERS:
        raise YamlError(f"it has {len(text)} characters, more than {_MOST_CHARACTERS}")
    if text.count(",") + text.count("\n") > 2 * _MOST_VALUES:  # before they are made
        raise YamlError(f"it holds more than {_MOST_VALUES} values")
    try:
        return _checked(yaml.load(text, _Loader), _MOST_VALUES)
    except RecursionError:
        raise YamlError(f"it nests deeper than {_DEEPEST}") from None
    except YamlError:
        raise
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # dates and numbers that are none
        raise YamlError(" ".join(str(error).split())) from error


def dump_yaml(tree: dict[str, Any]) -> str:
    """Return the text of mappings, with lists of numbers in lines."""
    return str(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100))


def parameter_blocks(tree: Any, node: str = "", path: str = "") -> Iterator[tuple[str, Any]]:
    """Name of a node, given as a path or nested, and its ``ros__parameters``; ``""``: of any."""
    for key, value in tree.items() if isinstance(tree, dict) else ():
        if key != "ros__parameters":
            yield from parameter_blocks(value, node, f"{path}/{str(key).strip('/')}")
        elif not node or path.rsplit("/", 1)[-1] in (node, "*", "**"):
            yield path, value


def flat(tree: dict[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names of nested mappings, and their values."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _checked(tree: Any, most: int) -> Any:
    """Return the tree, or raise a YamlError if it is larger or deeper than any written one."""
    waiting, count = [(tree, 0)], 0
    while waiting:
        value, depth = waiting.pop()
        count += 1
        if depth > _DEEPEST:
            raise YamlError(f"it nests deeper than {_DEEPEST}, or holds itself")
        if count > most:
            raise YamlError(f"it holds more than {most} values")
        if isinstance(value, dict):
            waiting += [(item, depth + 1) for item in value.values()]
        elif isinstance(value, list | set | tuple):
            waiting += [(item, depth + 1) for item in value]
    return tree


# -- libraries that are not to be trusted with any file ------------------------------------------

# The script runs by its path in a process of its own. It imports nothing of this package, takes a
# task and leaves arrays, so that its memory, its time and its crash harm nobody else.
_START = (
    "import resource as r, runpy, sys; memory, seconds = map(int, sys.argv[1:3]); "
    "limits = {r.RLIMIT_DATA: memory, r.RLIMIT_CPU: seconds, r.RLIMIT_CORE: 0}; "
    "[r.setrlimit(kind, (most, most)) for kind, most in limits.items()]; "
    "sys.argv = sys.argv[3:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)
# Longest wait (s) for each second of work, on a machine whose cores are busy.
_WAITING = 10
_LONGEST_WORDS = 300


class LimitedError(ValueError):
    """Work that failed, or that took too much; the message says how it ended."""


def run_limited(
    script: Path, task: dict[str, Any], memory: int, seconds: int
) -> dict[str, NDArray[Any]]:
    """Return the arrays that ``python SCRIPT TASK.json OUT.npz`` leaves, by name.

    Args:
        script: run by its path.
        task: content of the script's JSON file.
        memory: bytes that it may allocate.
        seconds: that it may work.

    Raises:
        LimitedError: when it ends otherwise than with exit code 0; with its last line.
    """
    # Without the folder of the script, in which modules may have names of others.
    environment = os.environ | {"PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
    with TemporaryDirectory(prefix="rs_localizer-") as folder:
        given, out = Path(folder) / "task.json", Path(folder) / "out.npz"
        given.write_text(json.dumps(task), encoding="utf-8")
        words = map(str, (memory, seconds, script, given, out))
        try:
            done = subprocess.run(
                [sys.executable, "-c", _START, *words], env=environment, check=False,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                timeout=_WAITING * seconds,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise LimitedError(f"it takes longer than {seconds} s") from None
        if done.returncode == 0 and out.is_file():
            with np.load(out) as arrays:  # never unpickled
                return dict(arrays)
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise LimitedError(f"it takes longer than {seconds} s")
    lines = done.stderr.decode("utf-8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no word")
    last = last[:_LONGEST_WORDS]
    if "MemoryError" in last or "alloc" in last or done.returncode == -signal.SIGABRT:
        raise LimitedError(f"it needs more than {memory / 1e6:.0f} MB, or is damaged: {last}")
    raise LimitedError(last)
