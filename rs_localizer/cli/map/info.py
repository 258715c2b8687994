# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map info``: what a map file holds."""

from __future__ import annotations

import argparse

from rs_localizer.cli.map import either


def add_arguments(parser: argparse.ArgumentParser) -> None:
    either.add_input(parser)


def run(args: argparse.Namespace) -> dict[str, str]:
    any_map, kind = either.read(args)
    return either.describe(args.file, any_map, kind)
