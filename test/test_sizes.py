"""No file is longer than a reader can hold in mind."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "rs_localizer"
MOST = 300


def test_no_file_is_long() -> None:
    lengths = {
        str(path.relative_to(PACKAGE)): len(path.read_text().splitlines())
        for path in PACKAGE.rglob("*.py")
    }
    assert len(lengths) > 300
    assert {name: n for name, n in lengths.items() if n > MOST} == {}
