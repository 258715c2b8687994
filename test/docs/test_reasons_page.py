# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of the reasons is that of the code, and the reference names the whole package."""

import runpy

import pages


def test_the_page_of_the_reasons_is_up_to_date():
    # `python docs/make_reasons.py` writes it.
    made = runpy.run_path(str(pages.ROOT / "docs/make_reasons.py"))
    assert pages.text("docs/reasons.md") == made["reasons_page"]()


def test_the_reference_shows_all_public_names():
    assert ".. automodule:: rs_localizer\n   :members:\n" in pages.text("docs/api.md")
