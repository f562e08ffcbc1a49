"""YAML files as nested data, whoever wrote them: nothing in one is run, and none takes for ever.

Stated limits keep small files from growing: a list that holds itself a hundred times over, a
hundred thousand brackets, a number of a million digits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from casadi_ik.errors import DescriptionError

LARGEST_FILE = 4 * 2**20
"""Bytes of a file."""

LONGEST_SCALAR = 10_000
"""Characters of one text or number."""

DEEPEST = 50
"""Lists and mappings inside one another."""

MOST_VALUES = 200_000
"""Values in a file, those counted again that an alias repeats."""

MERGE = "tag:yaml.org,2002:merge"

# libyaml where PyYAML has it: a tenth of the time.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _UniqueKeyLoader(_SafeLoader):
    """YAML's own loader keeps the last of two equal keys without a word; this one objects.

    Merge keys (``<<``) are refused: they are no part of YAML 1.2, and what they override is easily
    overlooked.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == MERGE:
                raise yaml.constructor.ConstructorError(
                    None, None, "merge keys (<<) are not taken", key_node.start_mark
                )
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, (str, int, float)) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} appears twice", key_node.start_mark
                )
            if isinstance(key, (str, int, float)):
                seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(path: Path) -> Any:
    """Parse a YAML file.

    Raises:
        DescriptionError: The file is missing, unreadable, not UTF-8, not YAML, or beyond a limit.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise DescriptionError(f"{path}: cannot be read: {reason}") from error
    if len(data) > LARGEST_FILE:
        raise DescriptionError(f"{path}: cannot be read: is larger than {LARGEST_FILE >> 20} MiB")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{path}: cannot be read: not UTF-8 text") from error
    try:
        _check_events(text)
        found = yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise DescriptionError(f"{path}{where}: not valid YAML: {problem}") from error
    except (ValueError, OverflowError, RecursionError) as error:  # an impossible date
        raise DescriptionError(f"{path}: not valid YAML: {error}") from error
    try:
        _count(found, 0, 0)
    except ValueError as error:
        raise DescriptionError(f"{path}: {error}") from error
    return found


def _check_events(text: str) -> None:
    """Look at a text one event at a time: building nested data from it could end the process.

    Raises:
        yaml.YAMLError: Not YAML, or beyond a limit.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        problem = ""
        if depth > DEEPEST:
            problem = f"nested more than {DEEPEST} deep"
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_SCALAR:
            problem = f"a text of more than {LONGEST_SCALAR} characters"
        elif isinstance(event, yaml.ScalarEvent) and not _readable(event.value):
            problem = "a text with control characters"
        if problem:
            raise yaml.composer.ComposerError(None, None, problem, event.start_mark)


def _readable(text: str) -> bool:
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def _count(value: Any, count: int, depth: int) -> int:
    """How many values there are, aliases followed.

    Raises:
        ValueError: Too many, or too deep.
    """
    count += 1
    if count > MOST_VALUES:
        raise ValueError(f"holds more than {MOST_VALUES} values")
    if depth > DEEPEST:
        raise ValueError("nested too deeply, or holds itself")
    if isinstance(value, dict):
        for item in value.values():
            count = _count(item, count, depth + 1)
    elif isinstance(value, (list, tuple, set)):
        for item in value:
            count = _count(item, count, depth + 1)
    return count
