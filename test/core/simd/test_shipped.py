# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Machine code of the package: used where the CPU can run it, and only there."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from numba.core.registry import cpu_target

from rs_localizer.core.simd import jit, shipped

ROOT = Path(jit.__file__).parents[3]
KERNEL = """
import numpy as np

from rs_localizer.core.simd.jit import kernel

@kernel
def tripled(x):
    result = np.empty(1)  # memory is of Numba's runtime, which has to be there
    result[0] = 3.0 * x
    return result
"""
HOST = cpu_target.target_context.codegen().magic_tuple()[2]
pytestmark = pytest.mark.skipif("+avx2" not in HOST, reason="its code cannot run here")
Load = Callable[[], Any]


CALL = "from tripling import tripled as t; assert t(1.5)[0] == 4.5; print(t.stats)"


def compile_for(cpu: str, folder: Path, cache: Path) -> str:
    """Run the kernel in a process that compiles for a CPU; how often the cache had it."""
    chosen = {"NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": ""}
    return run(CALL, folder, cache, chosen)


def run(code: str, folder: Path, cache: Path, environment: dict[str, str]) -> str:
    """What a new process prints that knows the kernel of a folder."""
    path = os.pathsep.join([str(folder), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": path},
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with the kernel's source and, below compiled, its code for x86-64-v3."""
    folder = tmp_path_factory.mktemp("shipped")
    (folder / "tripling.py").write_text(KERNEL)
    compile_for("x86-64-v3", folder, folder / "compiled")
    return folder


@pytest.fixture
def load(made, tmp_path, monkeypatch) -> Load:
    """Makes the kernel as a new process would, with nothing in the user's cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(jit, "_said", set())
    monkeypatch.setattr(shipped, "FOLDER", made / "compiled")
    monkeypatch.syspath_prepend(made)

    def load() -> Any:
        sys.modules.pop("tripling", None)
        return importlib.import_module("tripling").tripled

    return load


def hits(compiled: Any) -> int:
    return sum(compiled.stats.cache_hits.values())


def test_nothing_is_compiled_where_the_package_has_it(load, tmp_path):
    compiled = load()
    assert compiled(1.5) == 4.5
    assert hits(compiled) == 1
    assert not (tmp_path / "cache").exists()
    assert compiled(2) == 6.0  # another type, which it does not have
    assert list((tmp_path / "cache").rglob("*.nbc"))


def test_it_runs_in_a_process_that_has_compiled_nothing(made, tmp_path):
    use = (
        "from pathlib import Path; from rs_localizer.core.simd import shipped; "
        f"shipped.FOLDER = Path({str(made / 'compiled')!r}); "
    )
    found = run(use + CALL, made, tmp_path / "cache", {})
    assert "cache_misses=Counter()" in found
    assert "cache_hits=Counter({" in found


@pytest.mark.parametrize("lacking", ["avx2", "fma", "movbe", "xsave", "ssse3"])
def test_a_cpu_that_lacks_an_instruction_compiles(load, monkeypatch, lacking):
    found = shipped.keys

    def keys(key: Any) -> list[Any]:
        signature, (triple, cpu, features), bytecode = key
        less = features.replace(f"+{lacking},", f"-{lacking},")
        assert less != features
        return found((signature, (triple, cpu, less), bytecode))

    monkeypatch.setattr(shipped, "keys", keys)
    compiled = load()
    assert compiled(1.5) == 4.5
    assert hits(compiled) == 0


def test_all_users_of_a_machine_run_the_same_code(load, monkeypatch):
    with monkeypatch.context() as without:
        without.setattr(shipped, "keys", lambda key: [])
        load()(1.5)  # now this user has code of their own
    monkeypatch.setattr(jit._Cache, "_load_own", lambda *_: pytest.fail("took the user's"))
    compiled = load()
    assert compiled(1.5) == 4.5
    assert hits(compiled) == 1


def test_damaged_code_of_the_package_is_not_run(load, made, tmp_path):
    (file,) = (made / "compiled").rglob("*.nbc")
    whole = file.read_bytes()
    file.write_bytes(whole[:-100] + bytes(100))
    compiled = load()
    with pytest.warns(RuntimeWarning, match="what came with the package is damaged"):
        assert compiled(1.5) == 4.5
    assert hits(compiled) == 0
    file.write_bytes(whole)


def test_caches_of_two_cpus_share_a_folder_and_not_their_code(made, tmp_path):
    cache = tmp_path / "both"
    assert "cache_hits=Counter()" in compile_for("nehalem", made, cache)
    assert "cache_hits=Counter()" in compile_for("x86-64-v3", made, cache)
    assert "cache_hits=Counter()" not in compile_for("nehalem", made, cache)
    assert len(list(cache.rglob("*.nbc"))) == 2
    assert len(list(cache.rglob("*.nbi"))) == 1
