# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Beginning of every program: search path, signals, threads, and what is not installed."""

import os
import sys

_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


def limit_threads() -> None:
    """Limit BLAS to one thread, whatever the user has set; call it before NumPy is imported.

    How many there are changes the last bits of results, and they spin while they wait for each
    other. Only programs call this: in a library it is not ours to decide.
    """
    for name in _THREADS:
        os.environ[name] = "1"


def ignore_working_folder() -> None:
    """Search the working folder for no module, here and in all processes that this one starts.

    It holds data that somebody may have sent: a ``selectors.py`` among them would run. Python
    searches it for ``-m`` and ``-c``, and for an empty entry of ``PYTHONPATH``, as
    ``$PYTHONPATH:/opt/x`` has where nothing was set before. It is kept if this package itself lies
    there. Call it before anything is imported that Python has not imported itself.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if "" in entries and "PYTHONPATH" in os.environ:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, entries))
    try:
        working = os.getcwd()
    except OSError:  # it has been removed
        working = ""
    package = os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))
    if os.path.realpath(working) == package:
        return
    if sys.path[0] in ("", working):
        del sys.path[0]
    if "" in entries and working not in entries and working in sys.path:
        sys.path.remove(working)
