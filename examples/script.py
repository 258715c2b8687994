# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong arguments, missing packages and unusable files end an example with one line."""

import contextlib
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# What brings a package, where it is not ``pip install`` and its name.
INSTALL = {
    "px4_msgs": "build px4_msgs of PX4's release in a ROS 2 workspace and source that",
    "rclpy": "source a ROS 2 workspace, or: pip install 'rs_localizer[ros]'",
    "rerun": "pip install rerun-sdk",
}


@contextlib.contextmanager
def one_line() -> Iterator[None]:
    """End the program with a sentence instead of a traceback, and without one after Ctrl-C."""
    name = Path(sys.argv[0]).name
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        how = INSTALL.get(package, f"pip install {package}")
        sys.exit(f"{name}: the package {package} is not installed: {how}")
    except FileNotFoundError as error:
        sys.exit(f"{name}: there is no file {error.filename or error}")
    except (ImportError, OSError, ValueError) as error:
        sys.exit(f"{name}: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit()


def run(main: Callable[..., None], wants: str, *default: str) -> None:
    """Call ``main`` with the arguments of the program, or say which ones it wants.

    Args:
        main: takes the arguments as text.
        wants: the arguments, for the sentence.
        default: what takes their place where there are none.
    """
    words = sys.argv[1:] or default
    try:
        inspect.signature(main).bind(*words)
    except TypeError:
        sys.exit(f"usage: python {sys.argv[0]} {wants}")
    with one_line():
        main(*words)
