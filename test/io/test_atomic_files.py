# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results appear whole or not at all; a disk that takes no more is named."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rs_localizer.io.atomic_files import (
    OutputError,
    atomic_directory,
    atomic_files,
    content,
)


def test_what_was_finished_stays(tmp_path):
    with atomic_directory(tmp_path / "out") as out:
        out.mkdir()
        (out / "a").write_text("a")
    assert (tmp_path / "out" / "a").read_text() == "a"
    with pytest.raises(OutputError, match="out exists already; it is not overwritten"):
        atomic_directory(tmp_path / "out").__enter__()
    assert (tmp_path / "out" / "a").read_text() == "a"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no"), SystemExit(1)])
def test_what_was_not_finished_is_gone(tmp_path, error):
    making = atomic_directory(tmp_path / "out")
    out = making.__enter__()
    out.mkdir()
    (out / "a").write_text("a")
    assert not making.__exit__(type(error), error, None)  # the error goes on
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_nothing_half_written(tmp_path):
    """A limit for the size of files fails at the same place as a full disk."""
    code = (
        "import resource; from pathlib import Path\n"
        "from rs_localizer.io.atomic_files import atomic_directory\n"
        "from rs_localizer.io.bags import BagError, BagWriter, make_message\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    with atomic_directory(Path('bag')) as out, BagWriter(out) as bag:\n"
        "        message = make_message('std_msgs/msg/String', data='a' * 10_000)\n"
        "        for k in range(1000): bag.write('/a', message, k)\n"
        "except BagError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "bag cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_files_are_whole_or_not_there(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"

    making, error = atomic_files(first, second), OSError(28, "No space left on device")
    part, _ = making.__enter__()
    part.write_text("a")
    assert not first.exists()
    with pytest.raises(OutputError, match="a cannot be written: No space left on device"):
        making.__exit__(OSError, error, None)
    assert list(tmp_path.iterdir()) == []
    with atomic_files(first, second) as (part, _):
        part.write_text("a")
    assert list(tmp_path.iterdir()) == [first]
    with atomic_files(Path("/dev/null")) as (part,):
        part.write_text("a")
    assert Path("/dev/null").is_char_device()


def test_an_empty_directory_is_filled_and_an_earlier_result_replaced(tmp_path):
    out = tmp_path / "out"
    out.mkdir()  # a mount point, say: it stays the same
    number = out.stat().st_ino
    (out / "lost+found").mkdir()  # of a disk
    for text, earlier in (("a", ()), ("b", ("a", "b"))):
        with atomic_directory(out, earlier) as built:
            built.mkdir()
            (built / text).write_text(text)
            assert content(out) == list(earlier[:1])
        assert content(out) == [text]
        assert (out / text).read_text() == text
    assert out.stat().st_ino == number
    assert (out / "lost+found").is_dir()


OLD = {"same": "old", "gone": "old", "folder/same": "old", "folder/gone": "old"}
NEW = {"same": "new", "more": "new", "folder/same": "new", "folder/more": "new"}


def make(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def tree(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def write_directory(place: Path) -> None:
    out = place / "out"
    with atomic_directory(out, content(out)) as built:
        make(built, NEW)


def test_all_is_on_the_disk_before_what_was_goes(tmp_path, monkeypatch):
    """As far as a test can tell without cutting the power."""
    make(tmp_path / "out", OLD)
    synced, gone, rename, fsync = set(), [], os.rename, os.fsync

    def sync(descriptor: int) -> None:
        synced.add(os.stat(descriptor).st_ino)
        fsync(descriptor)

    def move(source: Path, target: Path) -> None:
        if Path(source).parent == tmp_path / "out":
            gone.append(Path(source).name)
            made = [path for path in (Path(target).parents[1] / "out").rglob("*") if path.is_file()]
            assert len(made) == len(NEW)
            assert all(path.stat().st_ino in synced for path in made)
        rename(source, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "rename", move)
    write_directory(tmp_path)
    assert sorted(gone) == ["folder", "gone", "same"]
    assert tree(tmp_path / "out") == NEW


def test_what_cannot_be_replaced_stays_and_does_not_block(tmp_path, monkeypatch):
    """As a name within the result that is a mount point."""
    make(tmp_path / "out", OLD)
    rename = os.rename

    def move(source: Path, target: Path) -> None:
        if source == tmp_path / "out" / "same":
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(source))
        rename(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", move)
        with pytest.raises(OutputError, match="busy"):
            write_directory(tmp_path)
    assert tree(tmp_path / "out") == OLD
    write_directory(tmp_path)
    assert tree(tmp_path / "out") == NEW


@pytest.mark.parametrize("old", [{}, OLD])
def test_who_was_killed_blocks_nothing(tmp_path, old):
    make(tmp_path / "out", old)
    code = (
        "import os; from pathlib import Path\n"
        "from rs_localizer.io.atomic_files import atomic_directory, content\n"
        "with atomic_directory(Path('out'), content(Path('out'))) as built:\n"
        "    built.mkdir(); (built / 'same').write_text('half'); os._exit(9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 9
    place = tmp_path / "out"
    left = list(tmp_path.rglob(".unfinished-*"))
    assert len(left) == 1
    assert content(place) == sorted({name.split("/")[0] for name in old})
    write_directory(tmp_path)
    assert content(place) == ["folder", "more", "same"]
    assert {name: (place / name).read_text() for name in NEW} == NEW
