"""Many frames at once: continuous-time motion, its estimator, calibration and smoothing."""
