# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Hold the native module against calls that Numba's kernels answered, in a process without Numba.

    python test/native/compare.py CALLS.pkl

Kernels without linear algebra give the same bits. The others call Eigen where Numba calls SciPy's
BLAS and LAPACK, so they agree to 1e-12 of the size of what they give, in so far as that is
determined.
"""

import copy
import importlib
import pickle
import sys

import numpy as np

CLOSE = 1e-12
# What of a result is determined, where not all of it is.
DETERMINED = {
    # Eigenvectors have either sign; what they span has none.
    "rs_localizer.estimation.correlated.smooth_error": lambda smooth: (
        smooth.rows @ smooth.rows.T, *smooth[1:]
    ),
}  # fmt: skip


def leaves(value):
    """All arrays and numbers in a result, in order."""
    if isinstance(value, tuple):
        for part in value:
            yield from leaves(part)
    elif value is not None:
        yield np.asarray(value)


def difference(ours, theirs):
    """The largest difference by the size of what should be there; infinite: of another kind."""
    ours, theirs = list(leaves(ours)), list(leaves(theirs))
    if [(x.shape, x.dtype) for x in ours] != [(x.shape, x.dtype) for x in theirs]:
        return np.inf
    most = 0.0
    for x, y in zip(ours, theirs, strict=True):
        if np.array_equal(x, y, equal_nan=x.dtype.kind == "f"):
            continue
        if x.dtype.kind != "f" or not np.array_equal(np.isfinite(x), np.isfinite(y)):
            return np.inf
        size = np.abs(y[np.isfinite(y)]).max(initial=0.0)
        most = max(most, np.abs(x - y)[np.isfinite(y)].max(initial=0.0) / max(size, 1e-300))
    return most


def compare(calls):
    """Yield each entry's name and the largest difference of its calls."""
    for name, answered in sorted(calls.items()):
        module, _, function = name.rpartition(".")
        entry = getattr(importlib.import_module(module), function)
        most = 0.0
        for before, after, result, error in answered:
            given = copy.deepcopy(before)
            try:
                made, raised = entry(*given), None
            except Exception as fault:
                made, raised = None, (type(fault), str(fault))
            if raised != error:
                most = np.inf
            determined = DETERMINED.get(name, lambda whole: whole)
            if made is not None and result is not None:
                made, result = determined(made), determined(result)
            most = max(most, difference(made, result), difference(given, after))
        yield name, most


def main():
    with open(sys.argv[1], "rb") as file:
        calls = pickle.load(file)
    worst, exact, far = 0.0, 0, []
    for name, most in compare(calls):
        exact += most == 0.0
        if most > CLOSE:
            far.append(f"{name}: {most:.1e}")
        worst = max(worst, most)
    from rs_localizer import native
    from rs_localizer.native import declared, sources

    for module in sources.kernel_modules():
        importlib.import_module(module)
    assert "numba" not in sys.modules
    print(
        f"{len(calls)} of {len(declared.FUNCTIONS)} kernels checked at {native.LEVEL}: {exact} the "
        f"same to the bit, the others to {worst:.1e}"
    )
    print("\n".join(far))
    return 1 if far else 0


if __name__ == "__main__":
    sys.exit(main())
