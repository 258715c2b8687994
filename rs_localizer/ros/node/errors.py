"""Errors that nobody foresaw."""

from __future__ import annotations

import traceback


def describe(error: Exception) -> str:
    """An error in one line: what, and where."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
