# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``make release`` checks what a release needs before it says what a person must do."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = (
    ".ci/release", "package.xml", "setup.py", "rs_localizer/__init__.py", "CITATION.cff",
    "packaging/conda/recipe.yaml", "CHANGELOG.rst",
)  # fmt: skip
VERSION = "7.8.9"


def git(folder: Path, *words: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def project(tmp_path) -> Path:
    """A project that can be released, but for what a test spoils."""
    from rs_localizer import __version__

    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
        text = (tmp_path / name).read_text().replace(__version__, VERSION)
        (tmp_path / name).write_text(text)
    change(tmp_path, "package.xml", '.example"', '.org"')
    change(tmp_path, "CHANGELOG.rst", "Forthcoming\n", f"{VERSION} (2026-12-01)\n")
    git(tmp_path, "init", "-q")
    commit(tmp_path)
    return tmp_path


def change(folder: Path, name: str, old: str, new: str) -> None:
    text = (folder / name).read_text()
    (folder / name).write_text(text.replace(old, new, 1))


def commit(folder: Path) -> None:
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "a", "--allow-empty")


def release(folder: Path) -> tuple[int, str]:
    done = subprocess.run(["bash", ".ci/release"], cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def test_says_what_is_left_to_a_person(project):
    code, said = release(project)
    assert code == 0, said
    for line in (f"git tag --annotate {VERSION}", f"git push origin HEAD {VERSION}", "make levels"):
        assert f"\n  {line}" in said


@pytest.mark.parametrize("name", FILES[2:6])
def test_a_version_that_differs_is_named(project, name):
    change(project, name, VERSION, "7.8.8")
    commit(project)
    code, said = release(project)
    assert code == 1
    assert f"{name} does not have the version {VERSION}" in said


def test_what_else_stands_in_the_way_is_named(project):
    change(project, "package.xml", '.org"', '.example"')
    code, said = release(project)
    assert (code, "not committed" in said) == (1, True)
    commit(project)
    code, said = release(project)
    assert (code, "cannot be reached" in said) == (1, True)
    change(project, "CHANGELOG.rst", f"{VERSION} (2026-12-01)\n", "Forthcoming\n")
    commit(project)
    code, said = release(project)
    assert (code, 'rename "Forthcoming"' in said) == (1, True)
    git(project, "tag", VERSION)
    code, said = release(project)
    assert (code, f"the tag {VERSION} is there" in said) == (1, True)
