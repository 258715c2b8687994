# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m rs_localizer`` and the executable: takes signals in hand, then imports the rest.

Imports nothing at first but what Python has imported before: it may come from the working folder.
"""

import os
import sys

from rs_localizer.process import ignore_working_folder, limit_threads

TYPE_CHECKING = False  # type checkers take it for typing's
if TYPE_CHECKING:
    from contextlib import AbstractContextManager

_PROGRAM = "rs_localizer"


def run() -> int:
    """Run the command of the process's arguments; Ctrl-C and SIGTERM end it with one line.

    Returns:
        the exit code: 130 after Ctrl-C and 143 after SIGTERM, as of any other program.
    """
    ignore_working_folder()
    limit_threads()
    from rs_localizer.process.stopping import StopSignals

    with StopSignals() as signals:

        def importing(name: str) -> "AbstractContextManager[None]":
            return signals.at_once(None, f"{name}: interrupted\n")

        code = 0
        try:
            with importing(_PROGRAM):
                from rs_localizer.cli.commands import main

            code = main(importing=importing)
        except KeyboardInterrupt:  # before a command runs
            sys.stderr.write(f"{_PROGRAM}: interrupted\n")
    if signals.code:
        # Python remembers a KeyboardInterrupt that went through an exec() and ends itself by SIGINT
        # later, whatever the exit code, and after SIGTERM too. Nothing is left to be done.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(signals.code)
    return code


if __name__ == "__main__":
    sys.exit(run())
