"""The executables of the nodes: take signals in hand, then import what takes long."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable

from rs_localizer.process import threads
from rs_localizer.process.missing import explain
from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.usage import answer

Run = Callable[[StopRequest, list[str] | None], int]


def main(args: list[str] | None = None) -> int:
    """Run the localizer until Ctrl-C or SIGTERM, which end it with exit code 0 at any time."""

    def load() -> Run:
        from rs_localizer.ros.localizer.node import LocalizerNode
        from rs_localizer.ros.node.run import run
        from rs_localizer.settings import NODE_NAME

        return functools.partial(run, LocalizerNode, NODE_NAME)

    return _guarded("localizer", load, args)


def marker_detector(args: list[str] | None = None) -> int:
    """Run the marker detector likewise."""

    def load() -> Run:
        from rs_localizer.ros.detector.markers import MarkerDetectorNode
        from rs_localizer.ros.node.run import run
        from rs_localizer.settings import DETECTOR_NAME

        return functools.partial(run, MarkerDetectorNode, DETECTOR_NAME)

    return _guarded("marker_detector", load, args)


def feature_detector(args: list[str] | None = None) -> int:
    """Run the feature detector likewise."""

    def load() -> Run:
        from rs_localizer.ros.detector.features import FeatureDetectorNode
        from rs_localizer.ros.node.run import run
        from rs_localizer.settings import FEATURES_NAME

        return functools.partial(run, FeatureDetectorNode, FEATURES_NAME)

    return _guarded("feature_detector", load, args)


def _guarded(name: str, load: Callable[[], Run], args: list[str] | None) -> int:
    threads.limit()
    with StopRequest() as stop:
        try:
            with stop.at_once():
                text = answer(name, sys.argv[1:] if args is None else args)
                if text is not None:
                    sys.stdout.write(text)
                    return 0
                run = load()
        except ImportError as error:
            sys.stderr.write(f"{name}: {explain(error)}\n")
            return 1
        return run(stop, args)
