# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Experiments, a second simulator to judge by, fuzzing and load; not installed."""

import argparse


def command(name: str, about: str | None) -> argparse.ArgumentParser:
    """A parser of ``python -m benchmarks NAME``, whose help shows a text as it stands."""
    shown = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks{name}", description=about, formatter_class=shown
    )
