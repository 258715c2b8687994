# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The reference of the library is that of the code, and lists all public names."""

import importlib.util
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).parents[1] / "docs"


def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_api", DOCS / "make_api.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_are_up_to_date():
    # `python docs/make_api.py` writes them.
    made = generator()
    assert (DOCS / "api.md").read_text(encoding="utf-8") == made.page()
    assert (DOCS / "reasons.md").read_text(encoding="utf-8") == made.reasons_page()
