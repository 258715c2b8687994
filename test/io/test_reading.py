# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""YAML files: those of people are read, those that are traps are refused in time."""

import time

import pytest

from rs_localizer.io.reading import YamlError, load_yaml

# Nine lines for 9^9 values.
LAUGHS = "\n".join(f"k{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 9)}]" for n in range(9))

# Each merges the one before it twice.
MERGES = "k0: &a0 {x: 1}\n" + "".join(
    f"k{n}: &a{n} {{<<: [*a{n - 1}, *a{n - 1}]}}\n" for n in range(1, 40)
)


def test_what_people_write():
    assert load_yaml("a: &x {b: 1}\nc: *x\nd: [1, 2.5, yes, text]\n") == {
        "a": {"b": 1}, "c": {"b": 1}, "d": [1, 2.5, True, "text"],
    }  # fmt: skip
    assert load_yaml("") is None


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: [1", "expected ',' or ']'"),
        ("a: &x {b: *x}", "nests deeper than 50, or holds itself"),
        ("[" * 60 + "]" * 60, "nests deeper than 50"),
        ("[" * 5000, "nests deeper than 50|expected|nesting depth"),
        (LAUGHS, "more than 100000 values"),
        ("2026-99-99", "month must be in 1..12"),
        ("9" * 5000, "a number of 5000 characters"),
        (":".join(["1"] * 200_000), "a number of 399999 characters"),
        (MERGES, "it merges mappings"),
        ("a" * 5_000_000, "5000000 characters"),
        ("a: [" + "1, " * 400_000 + "1]", "more than 100000 values"),
        ("!!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ],
)
def test_traps(text, fault):
    started = time.process_time()
    with pytest.raises(YamlError, match=fault):
        load_yaml(text)
    assert time.process_time() - started < 5.0
