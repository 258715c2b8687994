# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What comes with the package can be read and is what its attribution says."""

from rs_localizer import data


def test_everything_is_attributed_and_small():
    root = data.path(".")
    files = [file for file in root.rglob("*") if file.is_file() and file.suffix != ".pyc"]
    assert sum(file.stat().st_size for file in files) < 6_000_000
    for folder in (child for child in root.iterdir() if child.is_dir()):
        if folder.name != "__pycache__":
            text = (folder / "ATTRIBUTION.md").read_text()
            licences = ("CC BY 4.0", "CC0", "Apache License, Version 2.0")
            assert any(licence in text for licence in licences)
