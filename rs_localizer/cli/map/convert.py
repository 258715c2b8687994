# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map convert``: other files of the same map."""

from __future__ import annotations

from dataclasses import dataclass

from rs_localizer.cli.map import either


@dataclass(frozen=True, kw_only=True)
class Options(either.OtherFileOptions):
    pass


def run(options: Options) -> dict[str, str]:
    either.check_output(options)
    any_map, kind = either.read(options)
    table = either.describe(options.file, any_map, kind)
    either.write(options, any_map)
    return {**table, "written_to": str(options.out)}
