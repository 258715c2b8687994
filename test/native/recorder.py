# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pytest's plugin that keeps calls of entries, with what Numba's kernels made of them.

    RS_LOCALIZER_KERNELS=numba PYTHONPATH=test/native python -m pytest -p recorder test/core ...

The file named by ``RS_LOCALIZER_CALLS`` gets the first calls of each entry: arguments before,
arguments after, and the result or the error. `compare.py` beside it holds the native module
against it, in a process without Numba.
"""

import copy
import os
import pickle

CALLS = 3  # of an entry; the first may be of an empty array
MOST = 1_000_000  # bytes of the arguments of a call
_kept = {}


def size(value):
    if isinstance(value, tuple):
        return sum(map(size, value))
    return getattr(value, "nbytes", 0)


def pytest_configure(config):
    from rs_localizer.native import jit

    call = jit._CompiledEntry.__call__

    def recorded(self, *arguments):
        name = f"{self.__module__}.{self.__qualname__}"
        if len(_kept.setdefault(name, [])) >= CALLS or size(arguments) > MOST:
            return call(self, *arguments)
        before, result, error = copy.deepcopy(arguments), None, None
        try:
            result = call(self, *arguments)
        except Exception as fault:
            error = fault
        if not isinstance(error, TypeError):  # of the declaration: test_entries.py tries them
            said = error and (type(error), str(error))
            _kept[name].append((before, copy.deepcopy(arguments), copy.deepcopy(result), said))
        if error is not None:
            raise error
        return result

    jit._CompiledEntry.__call__ = recorded


def pytest_unconfigure(config):
    with open(os.environ["RS_LOCALIZER_CALLS"], "wb") as file:
        pickle.dump({name: calls for name, calls in _kept.items() if calls}, file)
