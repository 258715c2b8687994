# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results appear whole or not at all; a disk that takes no more is named."""

import subprocess
import sys
from pathlib import Path

import pytest

from rs_localizer.io.atomic_files import OutputError, atomic_directory, atomic_files


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
    def half() -> None:
        with atomic_directory(tmp_path / "out") as out:
            out.mkdir()
            (out / "a").write_text("a")
            raise error

    with pytest.raises(type(error)):
        half()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named_and_nothing_half_written(tmp_path):
    """A limit for the size of files fails at the same place as a full disk."""
    code = (
        "import resource, sys; from rs_localizer.cli.main import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "sys.exit(main(['simulate', 'bag', '--duration', '3']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("rs_localizer simulate: bag cannot be written: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "bag").exists()


def test_files_are_whole_or_not_there(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"

    def half() -> None:
        with atomic_files(first, second) as (part, _):
            part.write_text("a")
            assert not first.exists()
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="a cannot be written: No space left on device"):
        half()
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
    for text in ("a", "b"):
        replaced = (lambda old: (old / "a").unlink()) if text == "b" else None
        with atomic_directory(out, replaced) as built:
            built.mkdir()
            (built / "a").write_text(text)
            assert (out / "a").exists() == (text == "b")
        assert [path.read_text() for path in out.iterdir()] == [text]
    assert out.stat().st_ino == number
