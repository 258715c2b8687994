# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Looks into a wheel: what has to be in it, what must not be, and nothing of anybody else's.

check_wheel.py path/to/rs_localizer-*.whl
"""

from __future__ import annotations

import re
import sys
import zipfile

# Patterns of which each has to match a file.
WANTED = (
    r"rs_localizer/py\.typed",
    r"rs_localizer/native/_cpu\.abi3\.so",
    r"rs_localizer/native/_kernels_(v2|v3|v4|generic)\.abi3\.so",
    r"rs_localizer/data/webcam_chessboard/recording/rec\.mcap",
    r"rs_localizer/data/webcam_chessboard/ATTRIBUTION\.md",
    r".*\.dist-info/(licenses/)?LICENSE",
    r".*\.data/data/share/rs_localizer/package\.xml",
    r".*\.data/data/share/rs_localizer/config/rs_localizer\.yaml",
    r".*\.data/data/share/rs_localizer/launch/localizer\.launch\.py",
    r".*\.data/data/share/ament_index/resource_index/packages/rs_localizer",
)
# Where all files are.
PLACES = r"(rs_localizer/|rs_localizer-[^/]+\.(dist-info|data/data/share)/).*"
# Beside the recording that the demo plays, in bytes of the wheel; and of each level's kernels.
MOST_BYTES, MOST_OF_KERNELS = 3_000_000, 1_400_000
KERNELS = r"rs_localizer/native/_(cpu|kernels_\w+)\.abi3\.so"
# What only the build needs stays in the sdist.
TOOLS = (
    r"rs_localizer/native/(bitcode|build|jit|sources)\.py|rs_localizer/native/.*\.(c|cpp|h|json)"
)
UNWANTED = rf"(?!{KERNELS}).*(__pycache__|\.pyc$|(^|/)tests?/|\.so$|\.orig$|~$)|{TOOLS}"


def main() -> None:
    entries = zipfile.ZipFile(sys.argv[1]).infolist()
    names = [entry.filename for entry in entries]
    sizes = {entry.filename: entry.compress_size for entry in entries}
    kernels = {name: sizes.pop(name) for name in names if re.fullmatch(KERNELS, name)}
    assert max(kernels.values()) <= MOST_OF_KERNELS, kernels
    size = sum(size for name, size in sizes.items() if "/webcam_chessboard/" not in name)
    assert size <= MOST_BYTES, f"{size} bytes beside the demo's recording"
    for pattern in WANTED:
        assert any(re.fullmatch(pattern, name) for name in names), f"nothing like {pattern}"
    for name in names:
        assert re.fullmatch(PLACES, name), f"{name} is out of place"
        assert not re.match(UNWANTED, name), f"{name} does not belong there"
    attributed = {name.split("/")[2] for name in names if name.endswith("/ATTRIBUTION.md")}
    data = {
        parts[2]
        for parts in (name.split("/") for name in names)
        if parts[:2] == ["rs_localizer", "data"] and len(parts) > 3
    }
    assert data == attributed, f"data without its authors: {data - attributed}"
    print(f"  {len(names)} files, {size} bytes beside the demo's recording and {kernels}")


if __name__ == "__main__":
    main()
