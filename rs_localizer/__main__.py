"""``python -m rs_localizer`` and the executable: takes signals in hand, then imports the rest."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager

from rs_localizer import threads
from rs_localizer.stopping import StopSignals


def run() -> int:
    """Run the command of the process's arguments; Ctrl-C and SIGTERM end it with one line."""
    threads.limit()
    with StopSignals() as signals:

        def importing(name: str) -> AbstractContextManager[None]:
            return signals.at_once(1, f"{name}: interrupted\n")

        with importing("rs_localizer"):
            from rs_localizer.cli.main import main
        return main(importing=importing)


if __name__ == "__main__":
    sys.exit(run())
