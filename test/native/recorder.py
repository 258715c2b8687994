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
_kept = {}


def pytest_configure(config):
    from rs_localizer.native import jit

    call = jit._Entry.__call__

    def recorded(self, *arguments):
        name = f"{self.__module__}.{self.__qualname__}"
        if len(_kept.setdefault(name, [])) >= CALLS:
            return call(self, *arguments)
        before = copy.deepcopy(arguments)
        try:
            result, error = call(self, *arguments), None
        except TypeError:  # of the declaration: each entry is tried with each fault elsewhere
            raise
        except Exception as fault:
            result, error = None, (type(fault), str(fault))
            raise
        finally:
            if "error" in locals():
                _kept[name].append((before, copy.deepcopy(arguments), copy.deepcopy(result), error))
        return result

    jit._Entry.__call__ = recorded


def pytest_unconfigure(config):
    with open(os.environ["RS_LOCALIZER_CALLS"], "wb") as file:
        pickle.dump({name: calls for name, calls in _kept.items() if calls}, file)
