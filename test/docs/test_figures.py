# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of docs/benchmarks.md are what the benches printed; those of README are among them."""

import re
from collections.abc import Iterable

import pages
import PIL.Image
import pytest

from benchmarks.page import PAGE, RESULTS, blocks, filled

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
    """The part of the page below a heading."""
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
