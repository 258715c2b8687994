# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Each kind of command, killed at each change of a name: the old or the new result is whole."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from recorded import SHUTTER

from rs_localizer.cli.commands import main
from rs_localizer.io.atomic_files import resume_results
from rs_localizer.io.recording import MARKER_MAP


def simulate(place: Path, seed: int) -> list[str]:
    return ["simulate", str(place / "out"), "--duration", "0.1", "--seed", str(seed)]


def replay(place: Path, seed: int) -> list[str]:
    words = ["--out", str(place / "out"), "-p", f"seed:={seed}"]
    return ["replay", str(place / "seen"), *SHUTTER, *words]


def detect(place: Path, seed: int) -> list[str]:
    words = ["--out", str(place / "out"), "--map", str(place / "film" / MARKER_MAP)]
    return ["detect", str(place / "film"), *words, *(["--images"] if seed else [])]


def make_markers(place: Path, seed: int) -> list[str]:
    return ["markers", "make", str(place / "out" / "wall.png"), "--first-id", str(seed)]


def tree(folder: Path) -> dict[str, bytes]:
    """All files but those of workplaces."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = {str(path.relative_to(folder)): path for path in files}
    return {name: path.read_bytes() for name, path in names.items() if ".unfinished-" not in name}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("inputs")
    assert main(["simulate", str(place / "seen"), "--duration", "0.1"]) == 0
    assert main(["simulate", str(place / "film"), "--duration", "0.1", "--images"]) == 0
    return place


@pytest.fixture
def copies() -> Iterator[Path]:
    """Not where the command is watched that these are made in."""
    with TemporaryDirectory() as place:
        yield Path(place)


@pytest.mark.parametrize("command", [simulate, replay, detect, make_markers])
def test_whenever_a_command_is_killed_the_old_or_the_new_result_is_whole(
    command: Callable[[Path, int], list[str]], inputs, tmp_path, copies, monkeypatch
):
    """A copy of all files at a moment is what a process leaves that is killed then."""
    place = tmp_path / "place"
    shutil.copytree(inputs, place)
    (place / "out").mkdir()  # as a mount point, which keeps its name
    assert main(command(place, 0)) == 0
    old = tree(place / "out")

    def copied(function: Callable[..., Any]) -> Callable[..., Any]:
        def called(*given: Any, **named: Any) -> Any:
            result = function(*given, **named)
            shutil.copytree(place / "out", copies / f"{len(list(copies.iterdir())):03}" / "out")
            return result

        return called

    with monkeypatch.context() as patched:
        for name in ("rename", "unlink", "fsync"):
            patched.setattr(os, name, copied(getattr(os, name)))
        assert main([*command(place, 1), "--overwrite"]) == 0
    new = tree(place / "out")
    assert old != new
    found = []
    for copy in sorted(copies.iterdir()):
        resume_results([copy / "out" / "wall.png"])
        found.append(tree(copy / "out"))
        assert found[-1] in (old, new)
    assert found[0] == old
    assert found[-1] == new
    # And the command itself goes on, from the moment at which the last name changed.
    last = copies / f"{found.index(new):03}"
    for name in ("seen", "film"):
        shutil.copytree(inputs / name, last / name)
    assert main([*command(last, 1), "--overwrite"]) == 0
    assert sorted(tree(last / "out")) == sorted(new)
    assert not list(last.rglob(".unfinished-*"))
