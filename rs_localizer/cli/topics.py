"""The options that name the topics of a recording: one for each input of the node."""

from __future__ import annotations

import argparse
from collections.abc import Collection

from rs_localizer.pipeline.inputs import INPUTS


def add_topics(group: argparse._ArgumentGroup, but: Collection[str] = ()) -> None:
    """An option for each input, but for some."""
    for name, item in INPUTS.items():
        if name not in but:
            group.add_argument(item.option, metavar="TOPIC", help=item.help)


def given_topics(args: argparse.Namespace, but: Collection[str] = ()) -> dict[str, str | None]:
    """What was given, by input; None: nothing."""
    return {name: getattr(args, name) for name in INPUTS if name not in but}
