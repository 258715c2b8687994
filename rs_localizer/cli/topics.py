"""The options that name the topics of a recording: one for each input of the node."""

from __future__ import annotations

import argparse

from rs_localizer.pipeline.inputs import INPUTS


def add_topics(group: argparse._ArgumentGroup) -> None:
    """An option for each input."""
    for item in INPUTS.values():
        group.add_argument(item.option, metavar="TOPIC", help=item.help)


def given_topics(args: argparse.Namespace) -> dict[str, str | None]:
    """What was given, by input; None: nothing."""
    return {name: getattr(args, name) for name in INPUTS}
