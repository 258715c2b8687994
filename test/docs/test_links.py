# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Links, files, commands and modules that README and docs name exist."""

import importlib
import importlib.util
import itertools
import re
import runpy
import shlex

import pages
import pytest

from benchmarks.__main__ import EXPERIMENTS
from rs_localizer.cli.commands import COMMANDS, parse
from rs_localizer.config import DetectorConfig, FeatureConfig
from rs_localizer.io.topics import GIVEN_POSES
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.settings import parse_assignment, settings


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


LINES = sorted({(page, line) for page in pages.NAMES for line in pages.shell(page)})
# As in a workspace, after make, or with a variable before.
_BEFORE = r"^(?:\w+=\S+ +)*(?:RUN +.*&& +)?(?:ros2 run rs_localizer +|(?:\.venv/bin/))?"
_OURS = [
    (page, match[1])
    for page, line in LINES
    if (match := re.match(_BEFORE + "rs_localizer (.+)", line))
]
_MODULES = [
    (page, match[1], match[2])
    for page, line in LINES
    if (match := re.match(_BEFORE + r"python -m (\S+) ?(.*)", line))
]
_LAUNCHES = [(page, line) for page, line in LINES if line.startswith("ros2 launch rs_localizer ")]


def test_commands_are_found():
    assert len(_OURS) > 40
    assert len(_MODULES) > 8
    assert len(_LAUNCHES) > 4


@pytest.mark.parametrize("target", ["demo", "test"])
def test_the_readme_has_both_commands_of_make_and_what_they_take(target):
    (told,) = re.findall(rf"^ {{4}}make {target} +# (.+)$", pages.text("README.md"), re.MULTILINE)
    assert re.search(r"minutes|hour", told)
    assert re.search(rf"^{target}: ", pages.text("Makefile"), re.MULTILINE)


@pytest.mark.parametrize(("page", "words"), _OURS)
def test_commands_and_options_exist(page, words):
    if words.startswith("COMMAND"):
        return
    parts = shlex.split(words)
    name = " ".join(parts[:2]) if " ".join(parts[:2]) in COMMANDS else parts[0]
    module = importlib.import_module(COMMANDS[name].module)
    arguments, _ = parse(name, module, parts[len(name.split()) :])
    for assignment in getattr(arguments, "assignments", None) or []:
        parse_assignment(assignment)


@pytest.mark.parametrize("page", pages.NAMES)
def test_files_commands_and_targets_of_make_that_a_page_names_exist(page):
    known, lines = (
        ("rs_localizer/", "examples/", "config/", "packaging/", "benchmarks/"),
        pages.shell(page),
    )
    words = {word for line in lines for word in line.split() if word.startswith(known)}
    assert {w for w in words if not (pages.ROOT / w).exists() and "NAME" not in w} == set()
    said = pages.names_in(pages.prose(page))
    called = {words.split()[1] for words in said if re.match(r"rs_localizer [a-z]", words)}
    assert called <= {name.split()[0] for name in COMMANDS}
    targets = re.findall(r"^(\w+):", pages.text("Makefile"), re.MULTILINE)
    assert {line.split()[1] for line in lines if re.match(r"make \w", line)} <= set(targets)


@pytest.mark.parametrize(("page", "module", "words"), _MODULES)
def test_modules_exist(page, module, words):
    assert importlib.util.find_spec(module) is not None, page
    if module == "pytest":
        for word in shlex.split(words):
            assert not word.startswith("test/") or (pages.ROOT / word).exists(), word
    if module == "benchmarks":
        names = list(itertools.takewhile(lambda word: word[0] not in "-#", words.split()))
        if names[0] == "real":
            assert names[1] == "gyro", words
        else:
            assert set(names) <= set(EXPERIMENTS), words


@pytest.mark.parametrize(("page", "line"), _LAUNCHES)
def test_launch_files_exist(page, line):
    file, *arguments = shlex.split(line)[3:]
    if file == "...":
        return
    code = (pages.ROOT / "launch" / file).read_text()
    code += (pages.ROOT / "rs_localizer" / "ros" / "launching.py").read_text()
    known = {*settings(), *settings(DetectorConfig), *settings(FeatureConfig), *INPUTS}
    known |= {*GIVEN_POSES, *re.findall(r"\"(\w+)\"", code)}
    given = {word.partition(":=")[0] for word in arguments if not word.startswith("--")}
    assert given <= known, page
