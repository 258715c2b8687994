# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results appear whole or not at all; a disk that takes no more is named."""

import errno
import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rs_localizer.io.atomic_files import (
    OutputError,
    atomic_directory,
    atomic_files,
    content,
    resume,
    resume_results,
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


# -- deaths -----------------------------------------------------------------------------------


@pytest.fixture
def quick_disk(monkeypatch):
    """Nobody waits for the disk: that matters where power fails, not where a process dies."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


OLD = {"same": "old", "gone": "old", "folder/same": "old", "folder/gone": "old"}
NEW = {"same": "new", "more": "new", "folder/same": "new", "folder/more": "new"}
# All that changes a name or waits for the disk.
STEPS = ("mkdir", "rename", "replace", "unlink", "rmdir", "fsync")


def make(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def tree(folder: Path) -> dict[str, str]:
    """All files, those of workplaces included."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def write_directory(place: Path) -> None:
    out = place / "out"
    resume_results([out])
    with atomic_directory(out, content(out)) as built:
        make(built, NEW)


def write_files(place: Path) -> None:
    make(place, {})
    with atomic_files(*(place / "out" / name for name in ("same", "more"))) as parts:
        for part in parts:
            part.write_text("new")


def dies(work: Callable[[], None], step: int) -> bool:
    """Do it in a process that dies right after so many steps, as by kill -9; False: it did not."""
    if (child := os.fork()) == 0:
        left = itertools.count(step, -1)

        def deadly(function: Callable[..., Any]) -> Callable[..., Any]:
            def called(*given: Any, **named: Any) -> Any:
                result = function(*given, **named)
                if next(left) == 0:
                    os._exit(9)
                return result

            return called

        try:
            for name in STEPS:
                setattr(os, name, deadly(getattr(os, name)))
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 9)
    return code == 9


def deaths(tmp_path: Path, old: dict[str, str] | None, write: Callable[[Path], None]) -> Any:
    """A place for each step of writing, at which death came right after it."""
    for step in itertools.count():
        place = tmp_path / str(step)
        place.mkdir()
        if old is not None:
            (place / "out").mkdir()
            make(place / "out", old)
        died = dies(functools.partial(write, place), step)
        yield place
        if not died:
            break
    assert step > 10  # steps have been counted at all


@pytest.mark.parametrize("old", [None, {}, OLD])
@pytest.mark.usefixtures("quick_disk")
def test_whenever_a_process_dies_the_next_finds_the_old_or_the_new_result(tmp_path, old):
    found = []
    for place in deaths(tmp_path, old, write_directory):
        out = place / "out"
        resume_results([out / "same"])  # a command that reads a file of it
        there = {name: text for name, text in tree(out).items() if not name.startswith(".")}
        assert there in (old or {}, NEW)
        assert out.exists() or old is None
        found.append(there == NEW)
        write_directory(place)  # the next command
        assert tree(place) == {f"out/{name}": text for name, text in NEW.items()}
        assert os.listdir(place) == ["out"]
        assert sorted(os.listdir(out)) == ["folder", "more", "same"]
    assert found == sorted(found)  # it does not come back
    assert not found[0]
    assert found[-1]


@pytest.mark.usefixtures("quick_disk")
def test_whenever_a_process_dies_files_that_belong_together_change_together(tmp_path):
    found = []
    for place in deaths(tmp_path, {"same": "old", "other": "mine"}, write_files):
        out = place / "out"
        resume_results([out / "same"])
        there = {name: text for name, text in tree(out).items() if not name.startswith(".")}
        found.append(there == {"same": "new", "more": "new", "other": "mine"})
        assert found[-1] or there == {"same": "old", "other": "mine"}
        write_files(place)
        assert tree(out) == {"same": "new", "more": "new", "other": "mine"}
        assert sorted(os.listdir(out)) == ["more", "other", "same"]
    assert found == sorted(found)
    assert set(found) == {False, True}


@pytest.mark.usefixtures("quick_disk")
def test_whenever_one_dies_that_resumes_the_next_goes_on(tmp_path):
    for place in deaths(tmp_path, OLD, write_directory):
        # Every other one: they are many.
        if int(place.name) % 2 or not list(place.glob("out/.unfinished-*/.journal")):
            continue
        saved = tmp_path / "saved"
        shutil.copytree(place, saved)
        for step in itertools.count():
            died = dies(functools.partial(resume_results, [place / "out"]), step)
            resume_results([place / "out"])
            there = tree(place / "out")
            assert {k: v for k, v in there.items() if not k.startswith(".")} in (OLD, NEW)
            if not died:
                break
            shutil.rmtree(place)
            shutil.copytree(saved, place)
        shutil.rmtree(saved)


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
            work = Path(target).parents[1]
            made, journal = work / "out", work / ".journal"
            needed = [*made.rglob("*"), made, journal, work, work.parent]
            assert all(path.stat().st_ino in synced for path in needed)
        rename(source, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "rename", move)
    write_directory(tmp_path)
    assert sorted(gone) == ["folder", "gone", "same"]


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


def test_who_works_is_not_disturbed(tmp_path):
    """Each process has a workplace of its own, which is locked while it lives."""
    (tmp_path / "out").mkdir()
    with atomic_directory(tmp_path / "out") as built:
        make(built, NEW)
        assert resume(tmp_path / "out")
        assert tree(built) == NEW
        write_directory(tmp_path / "other")
    assert tree(tmp_path / "out") == NEW
    assert not resume(tmp_path / "out")


def test_workplaces_of_earlier_versions_and_journals_of_strangers(tmp_path):
    """The first have no lock; the second, as in an archive, reach no further than their folder."""
    make(tmp_path, {"secret": "s", "out/.unfinished-0123456789abcdef/out/same": "new"})
    for number, journal in enumerate(
        (
            {"folder": "", "names": ["../../secret"], "earlier": []},
            {"folder": "../..", "names": ["secret"], "earlier": []},
            {"folder": "away", "names": ["secret"], "earlier": []},
            {"folder": "", "names": [], "earlier": ["../secret"]},
            {"folder": "", "names": [".."], "earlier": []},
            {"folder": "..", "names": [], "earlier": []},
            {"folder": "", "names": [], "earlier": [""]},
            ["no", "journal"],
        )
    ):
        work = tmp_path / "out" / f".unfinished-{number}"
        make(work, {".journal": json.dumps(journal), ".old/a": ""})
        (work / "away").symlink_to(tmp_path)
    assert not resume(tmp_path / "out")
    assert tree(tmp_path) == {"secret": "s"}
    assert content(tmp_path / "out") == os.listdir(tmp_path / "out") == []
