"""Load on a live node: ``python -m benchmarks.load --help``."""
