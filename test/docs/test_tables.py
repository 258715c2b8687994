# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables and pages of README and docs that repeat the code say what the code says."""

import re
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import pages
import pytest

from rs_localizer.cli.commands import COMMANDS
from rs_localizer.config import DetectorConfig, FeatureConfig, NodeConfig
from rs_localizer.core.reasons import ImuReason, Notice, Reason
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.topics import LIVE
from rs_localizer.offline.frame_table import COLUMNS
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.diagnostics import State
from rs_localizer.settings import FIRST, Kind, settings
from rs_localizer.solvers.table import SOLVERS, find_solver

OF_DETECTORS: list[tuple[Kind, str]] = [
    (DetectorConfig, "docs/detector.md"),
    (FeatureConfig, "docs/features.md"),
]
PARAMETER = re.compile(r"^ +(\w+): *[^#\n]*(?:# (.+))?$", re.MULTILINE)


def documented(where: set[str]) -> Iterator[tuple[str, str, str]]:
    """Page, name and default of every parameter in a table."""
    for table in pages.all_tables("parameter", "default"):
        if table.page in where:
            rows = zip(table.column("parameter"), table.column("default"), strict=True)
            for names, defaults in rows:
                given, values = pages.names_in(names), re.split(r", *(?![^[]*\])", defaults)
                assert len(values) in (1, len(given)), (table.page, names)
                values *= len(given) if len(values) == 1 else 1
                yield from ((table.page, *item) for item in zip(given, values, strict=True))


@pytest.mark.parametrize(("kind", "page"), OF_DETECTORS)
def test_every_parameter_of_a_detector_is_in_a_table_with_its_default(kind, page):
    known = settings(kind)
    assert {name for _, name, _ in documented({page})} == set(known)
    for _, name, default in documented({page}):
        assert read(default, known[name].default) == known[name].default, name


def test_tables_of_the_localizers_parameters_have_its_defaults():
    known, rows = settings(), list(documented({*pages.NAMES} - {page for _, page in OF_DETECTORS}))
    assert len(rows) >= 6
    for page, name, default in rows:
        assert read(default, known[name].default) == known[name].default, (page, name)


def test_the_list_of_parameters_explains_each_and_says_which_are_fixed():
    """Defaults and choices: test_settings.py."""
    text = (pages.ROOT / "config" / "rs_localizer.yaml").read_text(encoding="utf-8")
    said = dict(PARAMETER.findall(text.split("ros__parameters:")[1]))
    for name, setting in settings().items():
        comment = said[name.rsplit(".", 1)[-1]]
        assert comment, name
        assert ("[start]" in comment) is setting.read_only, name
        assert ("[fixed]" in comment) is (setting.fixed and not setting.read_only), name


def test_the_node_and_the_help_begin_with_what_everybody_sets():
    first, *_ = [t for t in pages.all_tables("parameter", "default") if t.page == "docs/node.md"]
    assert [name for row in first.rows for name in pages.names_in(row[0])] == list(FIRST)
    assert list(settings())[: len(FIRST)] == list(FIRST)


def read(cell: str, like: Any) -> Any:
    """A default as a table writes it."""
    said = re.sub(r": none$", "", cell).strip("`")
    if isinstance(like, bool):
        return {"true": True, "false": False}[said]
    if like == ("",):
        return tuple(word.strip('" ') for word in said.strip("[]").split(","))
    if isinstance(like, tuple):
        return tuple(map(float, said.strip("[]").split(",")))
    return said.strip('"') if isinstance(like, str) else type(like)(said)


def test_the_table_of_solvers():
    (table,) = [t for t in pages.all_tables("`solver`", "points") if t.page == "docs/solvers.md"]
    said = {pages.names_in(row[0])[0]: (int(row[1]), int(row[2])) for row in table.rows}
    solvers = {name: find_solver(name) for name in SOLVERS}
    assert said == {name: (it.sample_size, it.solutions) for name, it in solvers.items()}


def test_the_columns_of_the_table_of_frames() -> None:
    (table,) = pages.all_tables("column", "type")
    pairs = zip(table.column("column"), table.column("type"), strict=True)
    said = [(name, kind) for names, kind in pairs for name in pages.names_in(names)]
    assert said == list(COLUMNS.items())


def test_the_topics_of_the_localizer():
    (table,) = [t for t in pages.all_tables("topic or service") if t.page == "docs/node.md"]
    said = {pages.names_in(row[1])[0]: (row[0], row[2]) for row in table.rows}
    of_node: Any = LocalizerNode.topics(Mock(), NodeConfig())
    taken = {name: topic.type for name, topic in of_node.items()}
    # Their packages are not installed everywhere; the node then does without.
    optional = {name: item for name, item in INPUTS.items() if len(item.types) > 1}
    assert {name for name, (way, _) in said.items() if way == "in"} == {*taken, *optional}
    for name, item in optional.items():
        assert said[name][1] == item.types[0].replace("/msg/", "/")
    for name, kind in taken.items():
        assert said[name][1] == f"{kind.__module__.split('.')[0]}/{kind.__name__}"
    sent = {
        name.removeprefix("~/"): kind
        for name, (way, kind) in said.items()
        if name[0] == "~" and way != "in"
    }
    assert sent.pop("reset") == "std_srvs/Trigger"
    every = {**TYPES, **LIVE}
    assert sent == {name: kind.replace("/msg/", "/") for name, kind in every.items()}


def test_every_notice_is_explained_and_given_somewhere():
    page = pages.text("docs/reasons.md").split("## Notices")[1].split("\n## ")[0]
    heads = re.findall(r"^\* ([^:]+):", page, re.MULTILINE)
    assert {name for head in heads for name in pages.names_in(head)} == set(Notice)
    code = "".join(path.read_text() for path in (pages.ROOT / "rs_localizer").rglob("*.py"))
    assert set(re.findall(r"\bNotice\.([A-Z_]+)", code)) == {notice.name for notice in Notice}


def test_the_page_of_symptoms_names_what_exists():
    known = {*Notice, *Reason, *ImuReason, *settings(), *INPUTS, "replay"}
    said = pages.names_in(pages.prose("docs/wrong_poses.md"))
    names = {name for name in said if re.fullmatch(r"[a-z_]+(\.[a-z_]+)?", name)}
    assert names <= known
    assert len(names & set(Notice)) > 10


def test_every_state_is_explained():
    page = pages.text("docs/reasons.md").split("## States of the localizer")[1]
    names = re.findall(r"[A-Z:;] (`[^:]+`)[:;,]", page.replace("\n  ", " "))
    said = {name.partition(" for ")[0] for part in names for name in pages.names_in(part)}
    assert said == {state.removesuffix(" for") for state in State}


def test_commands_are_all_told_of():
    told = "\n".join(line for page in pages.NAMES for line in pages.shell(page))
    assert {name for name in COMMANDS if f"rs_localizer {name}" not in told} <= {"demo"}


def test_every_reason_is_explained():
    page = pages.text("docs/reasons.md").split("## No pose?")[0]
    said = re.findall(r"^\* `(\w+)`: ", page, re.MULTILINE)
    assert said == [*Reason, *ImuReason]
