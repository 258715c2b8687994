# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map convert``: other files of the same map."""

from __future__ import annotations

import argparse

from rs_localizer.cli.map import either


def add_arguments(parser: argparse.ArgumentParser) -> None:
    either.add_input(parser)
    either.add_output(parser)


def run(args: argparse.Namespace) -> dict[str, str]:
    either.check_output(args)
    any_map, kind = either.read(args)
    table = either.describe(args.file, any_map, kind)
    either.write(args, any_map)
    return {**table, "written to": str(args.out)}
