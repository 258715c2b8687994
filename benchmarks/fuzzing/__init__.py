"""Wrong input for everything that reads messages, files and settings.

``python -m benchmarks.fuzzing --executions 1000000`` runs for long, the
tests for a moment.
"""
