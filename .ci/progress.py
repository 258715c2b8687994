# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs a command, and says what it does at least every 20 s, whether it says something or not.

progress.py NAME COMMAND...          shows all that it prints
progress.py --quiet NAME COMMAND...  shows its last line now and then; the last ones if it fails

The exit code is that of the command.
"""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
import time
from collections import deque
from typing import IO

_PERIOD = 20.0  # s between two lines; half a minute of silence looks like a hang
_WIDTH, _TAIL = 100, 30  # characters of a line, and lines of a failure


def main() -> int:
    quiet = sys.argv[1] == "--quiet"
    name, *command = sys.argv[1 + quiet :]
    lines: queue.Queue[str | None] = queue.Queue()

    def read(output: IO[str]) -> None:
        for line in output:
            lines.put(line)
        lines.put(None)

    last: deque[str] = deque(maxlen=_TAIL)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        threading.Thread(target=read, args=(process.stdout,), daemon=True).start()
        _tell(name, quiet, lines, last)
    code = process.returncode
    if code and quiet:
        print("".join(last), end="", file=sys.stderr, flush=True)
    return code if code >= 0 else 128 - code


def _tell(name: str, quiet: bool, lines: queue.Queue[str | None], last: deque[str]) -> None:
    """Say what the command says, until it ends; its last lines are kept."""
    began = shown = time.monotonic()
    while True:
        try:
            line = lines.get(timeout=max(0.0, shown + _PERIOD - time.monotonic()))
        except queue.Empty:
            line = ""
        if line is None:
            return
        if line.strip():
            last.append(line)
        now = time.monotonic()
        if line and not quiet:
            print(line, end="", flush=True)
            shown = now
        elif now >= shown + _PERIOD:
            doing = f", {' '.join(last[-1].split())}" if last else ""
            print(f"{name}: {now - began:.0f} s{doing}"[:_WIDTH], flush=True)
            shown = now


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:  # the command has it from the terminal, too
        sys.exit(130)
