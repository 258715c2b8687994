"""The experiments by name: the only place that names them all."""

from __future__ import annotations

from collections.abc import Callable

from rs_localizer.lab.experiments import (
    augmented_reality,
    bound,
    convergence,
    features,
    linearisation,
    matching,
    motion,
    noise,
    p3p_initialisation,
    planes,
    readout_time,
    real,
    robustness,
    timings,
    tracking,
    translation,
)
from rs_localizer.lab.experiments.honesty import experiment as honesty
from rs_localizer.lab.experiments.inertial import experiment as inertial
from rs_localizer.lab.experiments.results import Context, Result

EXPERIMENTS: dict[str, Callable[[Context], Result]] = {
    "motion": motion.run,
    "translation": translation.run,
    "noise": noise.run,
    "convergence": convergence.run,
    "linearisation": linearisation.run,
    "p3p-initialisation": p3p_initialisation.run,
    "bound": bound.run,
    "planes": planes.run,
    "honesty": honesty.run,
    "tracking": tracking.run,
    "inertial": inertial.run,
    "robustness": robustness.run,
    "timings": timings.run,
    "matching": matching.run,
    "features": features.run,
    "readout-time": readout_time.run,
    "real": real.run,
    "augmented-reality": augmented_reality.run,
}
