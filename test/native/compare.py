# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Hold the native module against calls that Numba's kernels answered, in a process without Numba.

    python test/native/compare.py CALLS.pkl

At Numba's level, kernels without linear algebra give the same bits. The others call Eigen where
Numba calls SciPy's BLAS and LAPACK, and levels round differently: they agree to 1e-12 of the size
of what they give, or as far as it is determined: one rounding of the arguments moves it further.
"""

import copy
import importlib
import pickle
import runpy
import sys
from pathlib import Path

import numpy as np

CLOSE = 1e-12
# Roundings of all arguments that are tried: of 1.2e-12, twenty reach .8 and 300 reach 1.4.
NUDGES = 300
# What of a result is determined, where not all of it is.
DETERMINED = {
    # Eigenvectors have either sign; what they span has none.
    "rs_localizer.estimation.linear_fit.smooth_error": lambda smooth: (
        smooth.rows @ smooth.rows.swapaxes(1, 2), *smooth[1:]
    ),
    "rs_localizer.estimation.points.plane_of": lambda plane: (
        *plane[:2], np.outer(plane[2], plane[2])
    ),
}  # fmt: skip


def leaves(value):
    if isinstance(value, tuple):
        return [leaf for part in value for leaf in leaves(part)]
    return [] if value is None else [np.asarray(value)]


def apart(ours, theirs):
    """The largest difference by the size of what should be there; infinite: of another kind."""
    ours, theirs = leaves(ours), leaves(theirs)
    if [(x.shape, x.dtype) for x in ours] != [(x.shape, x.dtype) for x in theirs]:
        return np.inf
    most = 0.0
    for x, y in zip(ours, theirs, strict=True):
        if x.dtype.kind != "f" or not np.array_equal(known := np.isfinite(y), np.isfinite(x)):
            most = max(most, 0.0 if np.array_equal(x, y) else np.inf)
            continue
        size = np.abs(y[known]).max(initial=1e-300)
        most = max(most, np.abs(x - y)[known].max(initial=0.0) / size)
    return most


def nudged(value, rng):
    """A value whose numbers are rounded differently, each up, down or not at all."""
    if isinstance(value, tuple):
        parts = [nudged(part, rng) for part in value]
        return value._make(parts) if hasattr(value, "_make") else tuple(parts)
    if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype == np.float64):
        steps = rng.integers(-1, 2, np.shape(value))
        return value * (1.0 + np.finfo(float).eps * (steps if np.ndim(value) else int(steps)))
    return copy.deepcopy(value)


def answer(entry, arguments, determined):
    """What of a result is determined, the arguments after the call, and the error."""
    try:
        return (determined(entry(*arguments)), arguments), None
    except Exception as fault:
        return (None, arguments), (type(fault), str(fault))


def compare(calls):
    """Yield each entry's name, the largest difference of its calls, and whether it is too large."""
    rng = np.random.default_rng(0)
    for name, answered in sorted(calls.items()):
        module, _, function = name.rpartition(".")
        entry = getattr(importlib.import_module(module), function)
        determined = DETERMINED.get(name, lambda whole: whole)
        most, is_far = 0.0, False
        for before, after, result, error in answered:
            ours, said = answer(entry, copy.deepcopy(before), determined)
            theirs = None if error else determined(result), after
            off = apart(ours, theirs) if said == error else np.inf
            most = max(most, off)
            if off > CLOSE:
                moved = (answer(entry, nudged(before, rng), determined) for _ in range(NUDGES))
                is_far |= not any(
                    off < apart(other, ours) for other, fault in moved if fault == said
                )
        yield name, most, is_far


def main():
    with open(sys.argv[1], "rb") as file:
        calls = pickle.load(file)
    from rs_localizer import native
    from rs_localizer.native import declared

    # By the checkout's list: a wheel, too, may be what Python finds.
    listing = runpy.run_path(str(Path(__file__).parents[2] / "rs_localizer/native/sources.py"))
    for module in listing["kernel_modules"]():
        importlib.import_module(module)
    assert "numba" not in sys.modules
    compared = list(compare({name: calls[name] for name in calls.keys() & declared.FUNCTIONS}))
    exact = sum(most == 0.0 for _, most, _ in compared)
    off = [(name, most, is_far) for name, most, is_far in compared if most > CLOSE]
    loose = [f"{name}: {most:.1e}" for name, most, is_far in off if not is_far]
    far = [f"too far: {name}: {most:.1e}" for name, most, is_far in off if is_far]
    worst = max((most for _, most, _ in compared if most <= CLOSE), default=0.0)
    print(
        f"{len(compared)} of {len(declared.FUNCTIONS)} kernels checked at {native.LEVEL}: {exact} "
        f"the same to the bit, {len(compared) - exact - len(loose) - len(far)} to {worst:.1e}"
        f"{', others as far as a rounding moves them:' if loose else ''}"
    )
    for line in loose + far:
        print(f"  {line}")
    unchecked = sorted(declared.FUNCTIONS.keys() - calls.keys())
    if unchecked:
        print(f"not checked: {', '.join(unchecked)}")
    return 1 if far else 0


if __name__ == "__main__":
    sys.exit(main())
