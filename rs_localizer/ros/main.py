"""The executable ``localizer``: takes signals in hand, then imports what takes long."""

from __future__ import annotations

import sys

from rs_localizer.stopping import StopRequest


def main(args: list[str] | None = None) -> int:
    """Run the node until Ctrl-C or SIGTERM, which end it with exit code 0 at any time."""
    with StopRequest() as stop:
        try:
            with stop.at_once():
                from rs_localizer.ros.run import run
        except ImportError as error:
            sys.stderr.write(
                f"localizer: {' '.join(str(error).split())}: it needs ROS 2 and the Python "
                "packages of README.md; source a ROS 2 workspace, or install them with pip\n"
            )
            return 1
        return run(stop, args)
