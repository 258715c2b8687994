# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
from benchmarks import size

SOURCE = """
from rs_localizer.core import so3
import rs_localizer.core.arrays
_A, B = 1, 2
_TERMS: tuple = ()
name = 3
def late():
    from rs_localizer.core.so3 import exp
"""


def test_constants_are_names_in_capitals_that_a_module_assigns():
    assert size._constants(SOURCE) == 3


def test_imports_are_modules_of_the_package_late_ones_included():
    modules = {"core.so3", "core.arrays", "core.shutter"}
    assert set(size._imported("own", SOURCE, modules)) == {"core.so3", "core.arrays"}
