# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sphinx builds README and the pages as they are: ``make docs``, or rosdoc2 (rosdoc2.yaml)."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

project = "rs_localizer"
author = "rs_localizer maintainers"
extensions = ["myst_parser", "sphinxcontrib.mermaid", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]
highlight_language = "text"  # of indented blocks: shell commands and what they print

rosdoc2_settings: dict[str, Any] = {**globals().get("rosdoc2_settings", {})}
rosdoc2_settings["allow_other_extensions"] = True  # Mermaid, where it is installed
by_rosdoc2 = "confpy_succeeded" in globals()  # which runs this file inside its own
# The pages, in the order of the site's contents; rosdoc2 makes a front page of its own.
PAGES = {
    "Start": "concepts install phone camera common_cameras cameras/index",
    "Use": "node robot reasons wrong_poses detector features imu rigs recordings calibration "
    "mapping map_build maps simulation integrations examples library policy",
    "Understand": "limits solvers estimator benchmarks architecture api",
}
OTHERS = (
    *("CONTRIBUTING", "CODE_OF_CONDUCT", "SECURITY", "benchmarks/README"),
    "examples/README",
    *("QUALITY_DECLARATION", "CHANGELOG", "docs/adr/0001-compiled-kernels"),
)
if not by_rosdoc2:
    root_doc = "README"
    # A page per camera of the table of readout times, and the table as JSON.
    make_cameras = runpy.run_path(str(Path(__file__).with_name("make_cameras.py")))
    make_cameras["write"]()
    html_extra_path = [f"cameras/{make_cameras['JSON']}"]
    include_patterns = [
        "README.md",
        "docs/*.md",
        "docs/cameras/*.md",
        *(f"{name}.*" for name in OTHERS),
    ]
    exclude_patterns = [".*", "out", "build", "install", "log", "rs_localizer", "test"]
    html_theme = "alabaster"
    html_theme_options = {"page_width": "1100px", "fixed_sidebar": True}


def contents(app: Any, page: str, source: list[str]) -> None:
    """Put the contents of the site under README's text."""
    if page == "README":
        parts = {name: [f"docs/{page}" for page in pages.split()] for name, pages in PAGES.items()}
        for name, pages in (parts | {"Work on it": list(OTHERS)}).items():
            names = "\n".join(f"/{page}" for page in pages)
            source[0] += f"\n\n```{{toctree}}\n:hidden:\n:caption: {name}\n\n{names}\n```\n"


def setup(app: Any) -> None:
    """Called by Sphinx."""
    if not by_rosdoc2:
        app.connect("source-read", contents)
