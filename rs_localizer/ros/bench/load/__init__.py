"""Load on a live node: ``python -m rs_localizer.ros.bench.load --help``."""
