"""Text of calibration files as a tree: YAML, JSON, and OpenCV's dialects of YAML and XML."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, TypeVar
from xml.etree import ElementTree

from rs_localizer.io.yaml_text import YamlError, check_tree, load_yaml

# OpenCV writes "%YAML:1.0" where YAML has "%YAML 1.0", and a tag of its own before matrices, which
# are plain mappings of rows, cols, dt and data.
_DIRECTIVE = re.compile(r"\A\ufeff?%YAML[: ][0-9.]+\s*\n")
_TAG = re.compile(r"!!opencv[-_a-z]*")
# XML may define names that stand for ever longer text; OpenCV defines none.
_FORBIDDEN = "<!ENTITY"


def load_tree(text: str) -> Any:
    """Mappings, lists and plain values of a file's text.

    Raises:
        YamlError: for text that is none of these, saying what was found.
    """
    start = text.lstrip()[:1]
    if start == "<":
        return _load_xml(text)
    if start == "{":
        try:
            tree = json.loads(text)
        except (ValueError, RecursionError):
            return load_yaml(text)  # flow style, and its message if that fails, too
        check_tree(tree)
        return tree
    return load_yaml(_TAG.sub("", _DIRECTIVE.sub("", text)))


T = TypeVar("T")


def choose(cameras: Mapping[str, T], name: str | None) -> T:
    """The only camera of a file, or the one that is named.

    Raises:
        ValueError: when there are several, or none of that name.
    """
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if not cameras:
        raise ValueError("it has no camera")
    if name is None or name not in cameras:
        known = ", ".join(cameras)
        raise ValueError(
            f"it has the cameras {known}: choose one with #{next(iter(cameras))} behind the file"
        )
    return cameras[name]


def _load_xml(text: str) -> Any:
    if _FORBIDDEN in text:
        raise YamlError("the XML defines entities")
    try:
        root = ElementTree.fromstring(text)
        return {item.tag: _value(item) for item in root}
    except RecursionError:
        raise YamlError("the XML nests too deep") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise YamlError(f"the XML cannot be read: {error}") from error


def _value(item: ElementTree.Element) -> Any:
    if len(item):
        return {part.tag: _value(part) for part in item}
    words = (item.text or "").split()
    values = [_number(word) for word in words]
    return values[0] if len(values) == 1 and item.tag != "data" else values


def _number(word: str) -> Any:
    try:
        return int(word)
    except ValueError:
        pass
    try:
        return float(word)
    except ValueError:
        return word
