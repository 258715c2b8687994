"""YAML that people write: small, and a tree."""

from __future__ import annotations

from typing import Any

import yaml

# A file may name a part of itself again; counted at every place, so that few lines do not stand
# for a thousand million values, or for endlessly many.
_MOST_VALUES = 100_000
_DEEPEST = 50


class YamlError(ValueError):
    """Text that is no YAML, or more than anybody writes."""


def load_yaml(text: str) -> Any:
    """What the text holds: mappings, lists, and plain values.

    Raises:
        YamlError: for anything else, saying what was found.
    """
    try:
        tree = yaml.safe_load(text)
    except RecursionError:
        raise YamlError(f"it nests deeper than {_DEEPEST}") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # dates and numbers that are none
        raise YamlError(" ".join(str(error).split())) from error
    check_tree(tree)
    return tree


def check_tree(tree: Any) -> None:
    """Refuse, with a YamlError, what is larger or deeper than anything that people write."""
    waiting, count = [(tree, 0)], 0
    while waiting:
        value, depth = waiting.pop()
        count += 1
        if depth > _DEEPEST:
            raise YamlError(f"it nests deeper than {_DEEPEST}, or holds itself")
        if count > _MOST_VALUES:
            raise YamlError(f"it holds more than {_MOST_VALUES} values")
        if isinstance(value, dict):
            waiting += [(item, depth + 1) for item in value.values()]
        elif isinstance(value, list | set | tuple):
            waiting += [(item, depth + 1) for item in value]
