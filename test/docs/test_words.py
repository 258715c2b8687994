# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Docstrings, comments and pages are plain British English in short sentences.

A function's docstring begins with a verb and can be read without its neighbours; a sentence has at
most 30 words; words are spelled as Oxford spells them (codespell's list).
"""

import ast
import importlib.util
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pages
import pytest

PACKAGE = pages.ROOT / "rs_localizer"
MOST_WORDS = 30
# Rooms of the package whose docstrings still have to be rewritten: the list may only shrink.
EXEMPT: tuple[str, ...] = ()
# Pages that still have to be rewritten.
EXEMPT_PAGES: tuple[str, ...] = ()
# What a function does, as its docstring says it first. A new verb is a word more here.
VERBS = frozenset(
    """
    Accept Add Answer Append Apply Ask Average Begin Build Calibrate Call Change Check Choose
    Collect Compare Compress Compute Configure Convert Copy Correct Count Create Decide Declare
    Decode Delay Describe Detect Divide Do Draw Drop Encode End Estimate Expand Explain Extract
    Fill Filter Find Finish Fit Forget Format Give Group Import Integrate Interpolate Interpret
    Join Judge Keep Lay Learn Let Limit Linearize Link Listen Load Localize Lock Log Look Lower Make
    Map Match Measure Minimize Mix Move Multiply Name Note Number Open Optimize Order Pack Parse
    Place Predict Prepare Print Project Publish Put Queue Raise Read Reconstruct Reduce Refine
    Reflect Refuse Remember Remove Repeat Replay Return Round Run Sample Say Search Select Send
    Set Show Smooth Solve Sort Split Start State Step Stop Sum Survey Take Tell Thin Trace
    Transform Triangularize Turn Undo Use Validate Wait Widen Write Yield
    """.split()
)
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
# Between paragraphs; before items of a list, headings, rows of tables, arguments.
BLOCKS = re.compile(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) )|\n(?=[#|])|\n(?=\s*[\w, *`]+: )")
# Words that stand for a noun of some other docstring.
VAGUE = re.compile(r"(The same|That|Those|These|This|What|With|Such|Likewise|As)\b")


def modules() -> list[str]:
    """Files of the package that are checked, relative to it."""
    files = (str(path.relative_to(PACKAGE)) for path in sorted(PACKAGE.rglob("*.py")))
    return [name for name in files if not name.startswith(EXEMPT)]


def documented(module: str) -> Iterator[tuple[ast.AST, str, str]]:
    """Node, name and docstring of everything in a module that has one."""
    tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and (said := ast.get_docstring(node)):
            yield node, getattr(node, "name", "module"), said


def is_action(node: ast.AST) -> bool:
    """True of functions; a property is named by a noun, as a class is."""
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return False
    return not any("property" in ast.unparse(each) for each in node.decorator_list)


def sentences(text: str) -> Iterator[str]:
    """Sentences of a page or a docstring, without code, tables, headings and addresses."""
    text = re.sub(r"^```.*?^```", "\n\n", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    for block in BLOCKS.split(text):
        if not block.strip() or re.match(r"( {4}|\t|\s*[|#]|>>>)", block.lstrip("\n")):
            continue
        line = re.sub(r"!\[[^]]*\]\([^)]*\)", "", " ".join(block.split()))
        line = re.sub(r"\]\([^)]*\)", "]", line)
        yield from re.split(r"(?<=[.!?:;])[\"*)\]]*\s+(?=[\"A-Za-z0-9`*(\[])", line)


def too_long(text: str) -> list[str]:
    return [said for said in sentences(text) if len(said.split()) > MOST_WORDS]


@pytest.mark.parametrize("page", [name for name in pages.NAMES if name not in EXEMPT_PAGES])
def test_sentences_of_pages_are_short(page):
    assert too_long(pages.text(page)) == []


@pytest.mark.parametrize("module", modules())
def test_docstrings_say_what_is_done(module):
    wrong = [
        f"{name}: {said.splitlines()[0]}"
        for node, name, said in documented(module)
        if is_action(node) and said.split()[0].rstrip(",.:") not in VERBS
    ]
    assert wrong == []


@pytest.mark.parametrize("module", modules())
def test_docstrings_can_be_read_alone(module):
    said = [(name, text) for _, name, text in documented(module)]
    wrong = [f"{name}: {text.splitlines()[0]}" for name, text in said if VAGUE.match(text)]
    long = [f"{name}: {each}" for name, text in said for each in too_long(text)]
    assert wrong + long == []


def american() -> dict[str, str]:
    """Spellings that Oxford has not, by codespell's list."""
    package = importlib.util.find_spec("codespell_lib")
    assert package is not None
    assert package.submodule_search_locations
    folder = Path(package.submodule_search_locations[0], "data")
    lines = (folder / "dictionary_en_to_en-OX_AUTOGENERATED.txt").read_text().split()
    return dict(line.rstrip(",").split("->") for line in lines)


def comments(path: Path) -> str:
    with path.open("rb") as file:
        found = list(tokenize.tokenize(file.readline))
    return "\n".join(token.string for token in found if token.type == tokenize.COMMENT)


# Names in code, which texts quote: NumPy's module, OpenCV's terms.
NAMES_IN_CODE = {"math", "color", "colors", "gray", "signaling", "center", "maneuvering"}


@pytest.mark.parametrize("page", [*pages.NAMES, "rs_localizer", "benchmarks"])
def test_spelling_is_oxfords(page):
    known = american()
    assert len(known) > 400
    if page.endswith(".md"):
        said = pages.prose(page)
    else:
        checked = [PACKAGE / module for module in modules()]
        files = checked if page == PACKAGE.name else sorted((pages.ROOT / page).rglob("*.py"))
        trees = (ast.walk(ast.parse(file.read_text(encoding="utf-8"))) for file in files)
        texts = (ast.get_docstring(n) for tree in trees for n in tree if isinstance(n, DOCUMENTED))
        said = "\n".join([*filter(None, texts), *map(comments, files)])
    words = set(re.findall(r"[a-z]+", re.sub(r"`[^`]*`", "", said).lower()))
    assert {f"{w}: {known[w]}" for w in words & set(known) - NAMES_IN_CODE} == set()


def test_equations_are_those_of_a_named_paper():
    """A docstring or comment that counts equations says in its file whose they are."""
    counted = re.compile(r"\b(?:eq\.|equations?) \(?\d")
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert not counted.search(text) or re.search(r"\b(?:19|20)\d\d\b", text.split("\n", 2)[2])


def test_files_that_sentences_name_exist():
    """Scripts that a page names, and paths of the repository in docstrings and comments."""
    files = {path.name for path in pages.ROOT.glob("*/**/*.py") if ".venv" not in path.parts}
    files |= {path.name for path in pages.ROOT.glob("*.py")}
    for page in pages.NAMES:
        lines = [line for line in pages.text(page).splitlines() if "realsense2_camera" not in line]
        named = set(re.findall(r"\b[\w.]*\w\.py\b", "\n".join(lines)))
        assert {name for name in named if name not in files and "NAME" not in name} == set(), page
    path_of = re.compile(r"\b(?:rs_localizer|docs|test|benchmarks|config|examples)/[\w/-]+\.\w+\b")
    for path in sorted(PACKAGE.rglob("*.py")):
        named = set(path_of.findall(path.read_text(encoding="utf-8")))
        gone = {name for name in named if not (pages.ROOT / name).exists() and "NAME" not in name}
        assert gone == set(), path
