# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of README and docs say what the code says, figures what the benches printed."""

import re
from collections.abc import Iterable, Iterator
from typing import Any
from unittest.mock import Mock

import pages
import PIL.Image
import pytest

from benchmarks.page import PAGE, RESULTS, blocks, filled
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


NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")
ROWS = [
    row
    for table in pages.tables("README.md")
    if "rs_localizer" in table.columns
    for row in table.rows
]
REST = re.findall(
    r"^\* (\[[\w-]+\]\(\.\./benchmarks/results/.+?)(?=\n\*|\n\n)",
    PAGE.read_text(encoding="utf-8"),
    re.MULTILINE | re.DOTALL,
)


def test_every_block_is_what_its_bench_printed():
    page = PAGE.read_text(encoding="utf-8")
    assert filled(page) == page
    others = set(re.findall(r"\.\./benchmarks/results/([\w-]+)\.txt", page))
    assert set(blocks(page)) | others == {file.stem for file in RESULTS.glob("*.txt")}
    assert set(blocks(page)) & others == set()
    widest = max(len(line) for text in blocks(page).values() for line in text.splitlines())
    assert widest <= 100


def unprinted(said: str, printed: Iterable[str]) -> list[str]:
    """Numbers of a text that no bench printed, rounded as they are, also as shares in %."""
    known = [float(number) for text in printed for number in NUMBER.findall(text)]
    near = [x for value in known for x in (value, 100.0 * value)]

    def digits(number: str) -> int:
        return len(number.partition(".")[2])

    return [
        number
        for number in NUMBER.findall(said)
        if float(number) not in {round(x, digits(number)) for x in near}
    ]


@pytest.mark.parametrize("row", ROWS, ids=[row[0][:40] for row in ROWS])
def test_every_figure_of_readme_is_in_the_block_that_it_links_to(row):
    named = re.search(r"\]\[(\w+)\]", row[0])
    target = re.search(
        rf"^\[{named[1]}\]: docs/benchmarks\.md#(\S+)$", pages.text("README.md"), re.M
    )
    assert unprinted(" ".join(row[1:]), blocks(section(target[1])).values()) == []


@pytest.mark.parametrize("item", REST, ids=[item[:20] for item in REST])
def test_every_figure_of_the_rest_is_in_the_file_that_it_links_to(item):
    link, said = re.match(r"\[[\w-]+\]\(\.\./(\S+)\), (.+)", item, re.DOTALL).groups()
    known = set(NUMBER.findall((pages.ROOT / link).read_text(encoding="utf-8")))
    figures = re.sub(r"`[^`]+`|figures .*? of the paper", "", said)
    assert {number for number in NUMBER.findall(figures) if number not in known} == set()


LINKED = [
    (page, " ".join(said.split()))
    for page in pages.NAMES
    if page.startswith("docs/") and page != "docs/benchmarks.md"
    for said in re.split(r"(?<=[.;:])\s+|\n\n|\n\* ", pages.prose(page))
    if "](benchmarks.md#" in said
]


@pytest.mark.parametrize(("page", "said"), LINKED)
def test_figures_of_a_sentence_are_in_the_tables_that_it_links_to(page, said):
    anchor = re.search(r"\]\(benchmarks\.md#([\w-]+)\)", said)[1]
    part = section(anchor)
    printed = [*blocks(part).values()]
    linked = re.findall(r"\]\(\.\./benchmarks/results/([\w-]+)\.txt\)", part)
    printed += [(RESULTS / f"{name}.txt").read_text(encoding="utf-8") for name in linked]
    assert unprinted(re.sub(r"`[^`]*`|\]\([^)]*\)", "", said), printed) == [], page


def test_the_words_below_the_picture_of_errors_are_its_medians():
    alt = re.search(r"!\[(Errors of position[^]]*)\]\(docs/errors\.png\)", pages.text("README.md"))
    millimetres, degrees = map(float, re.search(r"(\S+) mm and (\S+) deg", alt[1]).groups())
    with PIL.Image.open(pages.ROOT / "docs" / "errors.png") as picture:
        drawn = dict(each.rsplit(": ", 1) for each in picture.text["Description"].split("; "))
    assert millimetres == round(1e3 * float(drawn["position (m), r6p_vcwt"]))
    assert degrees == round(float(drawn["orientation (deg), r6p_vcwt"]), 2)
    for kind in ("position (m)", "orientation (deg)"):
        times = float(drawn[f"{kind}, p3p"]) / float(drawn[f"{kind}, r6p_vcwt"])
        assert 15.0 < times < 25.0  # "about twenty times as much"


def section(anchor: str) -> str:
    for part in re.split(r"^(?=##+ )", PAGE.read_text(encoding="utf-8"), flags=re.M):
        heading = re.sub(r"[^\w\- ]", "", part.partition("\n")[0].lstrip("# ").lower())
        if heading.replace(" ", "-") == anchor:
            return part
    raise AssertionError(anchor)


def test_the_table_of_what_is_noticed_is_what_its_bench_printed():
    printed = dict[str, list[tuple[str, str]]]()
    for line in (RESULTS / "kinds.txt").read_text(encoding="utf-8").splitlines()[1:-1]:
        if not line.startswith(" "):
            name, line = re.split(r"  +", line, maxsplit=1)
        found = re.match(r" *(\d+) .* (\d+)  +\S", line)
        assert found, line
        printed.setdefault(name, []).append((found[1], found[2]))
    (table,) = [t for t in pages.all_tables("kind", "said") if t.page == "docs/limits.md"]
    wrong = {kind for kind, runs in printed.items() if any(int(beyond) for _, beyond in runs)}
    assert {row[0] for row in table.rows} == wrong
    for kind, published, beyond, _ in table.rows:
        said = list(zip(published.split(", "), beyond.split(", "), strict=True))
        assert said == printed[kind], kind


def test_the_latency_in_readme_is_what_the_bench_of_the_node_printed():
    said = " ".join(pages.text("README.md").split())
    found = re.search(r"in (\d+) to (\d+) ms \(median; 99 %: (\d+) to (\d+) ms\)", said)
    least, most, least_99, most_99 = map(int, found.groups())
    printed = (RESULTS / "load.txt").read_text(encoding="utf-8")
    median, p99 = map(float, re.search(r"p50 (\S+) ms, p99 (\S+) ms", printed).groups())
    assert least <= round(median) <= most
    assert least_99 <= round(p99) <= most_99
