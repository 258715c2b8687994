# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Work that ends processes, or tells of them: a module of its own, which workers can import."""

import os
import signal
import time
from argparse import Namespace
from pathlib import Path

from rs_localizer.offline.fleet.task import Figures


def kill(args: Namespace, recording: Path, out: Path) -> Figures:
    """Kills who stands in the file, once or, for "always", each time; else does its work."""
    out.mkdir()
    (out / "half").write_text("")
    victim, _, often = recording.read_text().partition(" ")
    if victim:
        if often != "always":
            recording.write_text("")
        os.kill(os.getpid() if victim == "me" else int(victim), signal.SIGKILL)
        if victim != "me":  # what a worker without its scheduler does is nobody's business
            time.sleep(2.0)
    (out / "whole").write_text("")
    return {"process": os.getpid()}


def tell(args: Namespace) -> None:
    """Writes its process into the file ``said``; fails where that is a directory."""
    with args.said.open("a") as file:
        file.write(f"compiled by {os.getpid()}\n")
