"""Experiments, a second simulator to judge by, fuzzing, profiling and load; not installed."""
