# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The recipes for other package systems name what setup.py and package.xml name."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import setuptools
import yaml
from catkin_pkg.package import parse_package

ROOT = Path(__file__).parents[1]
DOCKERFILE = ROOT / "packaging" / "docker" / "Dockerfile"
# conda's names, where they differ from pip's.
CONDA = {
    "opencv-python-headless": "py-opencv",
    "PyYAML": "pyyaml",
}


@pytest.fixture
def declared(monkeypatch) -> dict[str, Any]:
    """What setup.py says."""
    said: dict[str, Any] = {}
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(setuptools, "setup", lambda **options: said.update(options))
    exec(compile((ROOT / "setup.py").read_text(), "setup.py", "exec"), {"__name__": "__main__"})
    return said


@pytest.fixture
def recipe() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text())
    return found


def test_conda_brings_what_pip_brings(declared, recipe):
    wanted = {}
    for line in declared["install_requires"]:
        name, bound = re.fullmatch(r"([\w-]+)(.*)", line).groups()
        # With machine code in the tree setup.py pins Numba, which conda compiles itself.
        wanted[CONDA.get(name, name)] = "" if name == "numba" else bound
    found = dict((*line.split(), "")[:2] for line in recipe["requirements"]["run"])
    assert found.pop("python") == declared["python_requires"]
    assert found == wanted


def instructions() -> list[tuple[str, list[str]]]:
    """Those of the Dockerfile, and their words."""
    text = re.sub(r"^#.*\n", "", DOCKERFILE.read_text(), flags=re.MULTILINE)
    lines = [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]
    return [(line.split()[0], shlex.split(line)[1:]) for line in lines]


def test_the_container_is_built_of_files_that_exist():
    stages: set[str] = set()
    copied: set[str] = set()
    for word, rest in instructions():
        if word == "FROM":
            stages |= {rest[-1]} if "AS" in rest else set()
        elif word == "COPY" and rest[0].startswith("--from="):
            assert rest[0].removeprefix("--from=") in stages
        elif word == "COPY":
            for name in rest[:-1]:
                assert (ROOT / name).exists(), name
            copied |= set(rest[:-1])
    # All that setup.py reads, and what the commands run.
    assert {"setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md"} <= copied
    assert {"rs_localizer", "config", "launch", "resource"} <= copied
    named = set(re.findall(r"packaging/\S+\.py", DOCKERFILE.read_text()))
    assert named <= copied


def test_machine_code_makes_a_wheel_of_this_python_and_this_numba(tmp_path, monkeypatch):
    (tmp_path / "rs_localizer" / "compiled").mkdir(parents=True)
    about = tmp_path / "rs_localizer" / "compiled" / "about.json"
    monkeypatch.chdir(tmp_path)
    said: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", lambda **options: said.update(options))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    code = compile((ROOT / "setup.py").read_text(), "setup.py", "exec")
    exec(code, {"__name__": "__main__"})
    assert said["distclass"] is setuptools.Distribution
    assert "numba" in said["install_requires"]
    version = "{}.{}".format(*sys.version_info)
    about.write_text(json.dumps({"python": version, "numba": "0.99.1", "cpus": ["x86-64-v3"]}))
    exec(code, {"__name__": "__main__"})
    assert said["distclass"]().has_ext_modules()
    assert "numba==0.99.1" in said["install_requires"]
    about.write_text(json.dumps({"python": "3.9", "numba": "0.99.1", "cpus": []}))
    with pytest.raises(SystemExit, match=r"is for Python 3\.9: compile again"):
        exec(code, {"__name__": "__main__"})
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")  # rosdep brings all there
    exec(code, {"__name__": "__main__"})
    assert said["install_requires"] == ["setuptools"]


def test_rosdep_knows_every_key():
    keys = yaml.safe_load((ROOT / "test" / "rosdep_keys.yaml").read_text())
    package = parse_package(ROOT / "package.xml")
    named = {item.name for kind in ("exec", "test", "build", "buildtool")
             for item in getattr(package, f"{kind}_depends")}  # fmt: skip
    assert named == keys["apt"].keys() | keys["after jazzy"].keys() | keys["ros"].keys()
    for names in (keys["apt"], keys["after jazzy"]):
        assert all(name.startswith("python3-") for name in names.values())  # and none by pip


@pytest.mark.parametrize(("distribution", "numba"), [("jazzy", False), ("lyrical", True)])
def test_numba_is_asked_for_where_ubuntu_has_it(distribution, numba):
    package = parse_package(ROOT / "package.xml")
    package.evaluate_conditions({"ROS_DISTRO": distribution})
    chosen = {item.name for item in package.exec_depends if item.evaluated_condition}
    assert ("python3-numba" in chosen) is numba
    assert "python3-numpy" in chosen
