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
    for text in ("a", "b"):
        replaced = (lambda old: (old / "a").unlink()) if text == "b" else None
        with atomic_directory(out, replaced) as built:
            built.mkdir()
            (built / "a").write_text(text)
            assert (out / "a").exists() == (text == "b")
        assert [path.read_text() for path in out.iterdir()] == [text]
    assert out.stat().st_ino == number
