"""Minimal solvers for the absolute pose of a rolling-shutter camera."""

from rs_localizer.solvers.table import SOLVERS, Solver, find_solver, solve_minimal

__all__ = ["SOLVERS", "Solver", "find_solver", "solve_minimal"]
