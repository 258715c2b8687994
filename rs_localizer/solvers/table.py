# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The solvers by name: THE list; settings, commands, tests and experiments read it.

A new solver is a module here with ``SAMPLE_SIZE``, ``SOLUTIONS`` and a batch kernel (see
:mod:`rs_localizer.solvers.batch`), and a row.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple


class Row(NamedTuple):
    """Where a solver is: a module of this folder and its batch kernels.

    It holds names instead of functions, so that listing solvers compiles nothing.
    """

    module: str
    solve: str = "solve_batch"
    as_published: str = ""  # the paper's form where ours differs
    rolling_shutter: bool = True
    bounded: bool = False  # takes a ``bound`` of its solutions


SOLVERS = {
    "p3p": Row("p3p", rolling_shutter=False),
    "r6p": Row("r6p", bounded=True),
    "r6p_vc_wt": Row("r6p_two_step", "solve_vc_wt"),
    "r6p_vct_w": Row("r6p_two_step", "solve_vct_w"),
    "r6p_vct_wt": Row("r6p_two_step", "solve_vct_wt"),
    "r6p_vcwt": Row("r6p_vcwt", as_published="solve_batch_frozen"),
    "r9p": Row("r9p", as_published="solve_batch_as_published"),
    "joint": Row("joint"),
}


_START = "p3p"


@dataclass(frozen=True, slots=True)
class Solver:
    """A minimal solver: its batch kernel (see :mod:`rs_localizer.solvers.batch`) and sizes."""

    solve: Callable[..., None]
    solve_as_published: Callable[..., None]
    sample_size: int
    solutions: int  # at most, per sample
    rolling_shutter: bool


@functools.cache
def find_solver(name: str) -> Solver:
    """Return the solver with that name.

    Raises:
        ValueError: unknown name.
    """
    if name not in SOLVERS:
        raise ValueError(f"unknown solver {name!r}; choose one of {', '.join(SOLVERS)}")
    row = SOLVERS[name]
    module = importlib.import_module(f"rs_localizer.solvers.{row.module}")
    return Solver(
        getattr(module, row.solve),
        getattr(module, row.as_published or row.solve),
        module.SAMPLE_SIZE,
        module.SOLUTIONS,
        row.rolling_shutter,
    )


def start_solver(solver: Solver) -> Solver:
    """Return the global-shutter solver that begins a search; a global-shutter solver: itself."""
    return find_solver(_START) if solver.rolling_shutter else solver
