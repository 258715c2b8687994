# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every link of README and docs leads somewhere."""

import re
import runpy

import pages
import pytest


@pytest.mark.parametrize("page", pages.NAMES)
def test_links_lead_to_files_and_headings(page):
    wrong = []
    for link in pages.links(page):
        file, _, anchor = link.partition("#")
        target = (pages.ROOT / page).parent / file if file else pages.ROOT / page
        if link.startswith(("http://", "https://", "mailto:")):
            continue
        there = target.is_file()
        if not there or (anchor and anchor not in pages.anchors(str(target.resolve()))):
            wrong.append(link)
    assert wrong == []


@pytest.mark.parametrize("page", pages.NAMES)
def test_files_and_folders_that_are_named_exist(page):
    """`rs_localizer/.../x.py`, `test/...`, `docs/...`, `config/...`, `launch/...`."""
    known = r"(?:rs_localizer/\w+[./]|test/|docs/|config/|launch/|\.ci/)[\w./-]*"
    named = {name for name in pages.names_in(pages.prose(page)) if re.fullmatch(known, name)}
    missing = {name for name in named if not (pages.ROOT / name).exists() and "NAME" not in name}
    assert missing == set()


def test_every_page_can_be_reached_from_the_readme():
    reached, waiting = set(), ["README.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or not page.endswith(".md"):
            continue
        reached.add(page)
        here = (pages.ROOT / page).parent
        targets = (here / link.partition("#")[0] for link in pages.links(page) if "://" not in link)
        waiting += [str(target.resolve().relative_to(pages.ROOT)) for target in targets]
    assert reached == set(pages.NAMES)


def test_the_site_has_every_page():
    listed = set(re.findall(r"\w+", (pages.ROOT / "docs/conf.py").read_text(encoding="utf-8")))
    assert {path.stem for path in (pages.ROOT / "docs").glob("*.md")} <= listed


def test_modules_that_the_architecture_names_exist():
    modules = {n for n in pages.names_in(pages.prose("docs/architecture.md")) if n.endswith(".py")}
    assert len(modules) > 15
    folders = (pages.ROOT, pages.ROOT / "rs_localizer")
    assert {n for n in modules if not any((folder / n).is_file() for folder in folders)} == set()
    (tree,) = pages.fenced("docs/architecture.md", "text")
    known = {path.name for path in (pages.ROOT / "rs_localizer").rglob("*.py")}
    assert set(re.findall(r"\w+\.py", tree)) <= known
    parts = {path.parent.name for path in (pages.ROOT / "rs_localizer").glob("*/__init__.py")}
    assert {line.split()[0].rstrip("/") for line in tree.splitlines()[1:]} == parts


def test_tests_lie_in_the_folders_of_what_they_test():
    """As CONTRIBUTING says; folders of their own have what is no part of the package."""
    others = {"benchmarks", "docs", "examples", "real_ros"}
    root = pages.ROOT / "test"
    tests = {path.parent.relative_to(root) for path in root.rglob("test_*.py")}
    ours = {folder for folder in tests if folder.parts and folder.parts[0] not in others}
    assert {f for f in ours if not (pages.ROOT / "rs_localizer" / f).is_dir()} == set()


def test_pictures_are_what_their_script_draws():
    drawn = runpy.run_path(str(pages.ROOT / "docs" / "pictures.py"))["PICTURES"]
    for name, draw in drawn.items():
        assert (pages.ROOT / "docs" / name).read_text(encoding="utf-8") == draw(), name


_NODE = r"[\w/]+(?:\[[^]]+\]|\(\[[^]]+\]\))?"
_STATEMENT = (
    rf"{_NODE}(?: & {_NODE})*(?: (?:--|-- [\w ]+ --|-- \"[^\"]+\" --)> {_NODE}(?: & {_NODE})*)*"
)


@pytest.mark.parametrize("page", pages.NAMES)
def test_diagrams_are_flowcharts(page):
    """GitHub and the site draw them in the browser, where nobody would see an error."""
    for diagram in pages.fenced(page, "mermaid"):
        head, *lines = diagram.splitlines()
        assert re.fullmatch("flowchart (LR|BT)", head)
        assert [line for line in lines if not re.fullmatch(_STATEMENT, line.strip())] == []
