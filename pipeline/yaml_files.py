"""YAML as users write it: read with nothing that is written in it lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import InputError

MOST_NODES = 100_000
"""Keys and values in a file; aliases of aliases grow a few lines beyond all memory."""

NO_VALUE = (ValueError, KeyError, IndexError, AttributeError, TypeError)
"""What the library raises of values that are none, such as 2024-13-01 or !!bool maybe."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML would keep the last and say nothing."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The keys and values of one section."""
        lines: dict[str, int] = {}
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            name, line = str(key.value), key.start_mark.line + 1
            if name in lines:
                raise InputError(
                    f"{self.name}: line {line}: {name} is given a second time, after line "
                    f"{lines[name]}; keep one of them"
                )
            lines[name] = line
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """A whole number; not one that a person writes to mean another than YAML 1.1 reads."""
        text = str(node.value).lstrip("+-").replace("_", "")
        if ":" in text or (text[:1] == "0" and text[1:2].isdigit()):
            raise InputError(
                f"{self.name}: line {node.start_mark.line + 1}: {node.value} would be read as "
                f"{super().construct_yaml_int(node)}; write it without the leading zero or colon, "
                "or in quotes where it is text"
            )
        return super().construct_yaml_int(node)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """A number; not minutes and seconds."""
        if ":" in str(node.value):
            raise InputError(
                f"{self.name}: line {node.start_mark.line + 1}: {node.value} would be read as "
                f"{super().construct_yaml_float(node):g}; write it without the colon, or in quotes "
                "where it is text"
            )
        return super().construct_yaml_float(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


def read_yaml(path: Path) -> Any:
    """What a YAML file holds; None where it is empty.

    Raises
    ------
    InputError
        When it cannot be read, a section gives a key twice, or aliases make it too large.
    """
    try:
        with path.open("rb") as stream:
            return _content(_Loader(stream), path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except RecursionError as error:
        raise InputError(
            f"{path}: is nested too deeply, or holds itself; write it out, in a few levels"
        ) from error
    except (yaml.YAMLError, OSError, *NO_VALUE) as error:
        raise InputError(
            f"{path}: cannot be read as YAML ({error!r}); text that looks like a date or a number "
            "needs quotes"
            if isinstance(error, NO_VALUE)
            else f"{path}: cannot be read as YAML ({error}){_remedy(error)}"
        ) from error


def _remedy(error: Exception) -> str:
    """What to do about text that YAML does not take, where that can be told."""
    if "'\\t'" in str(error):
        return "; indent with spaces in the place of tabs"
    return "; save it as UTF-8" if isinstance(error, yaml.reader.ReaderError) else ""


def _content(loader: _Loader, path: Path) -> Any:
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        count = _nodes(node, {})
        if count > MOST_NODES:
            raise InputError(
                f"{path}: its aliases (*NAME) stand for {count:.3g} keys and values, at most "
                f"{MOST_NODES} are read; write out what is meant"
            )
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _nodes(node: yaml.Node, known: dict[int, int]) -> int:
    """How many nodes a node stands for, each alias written out."""
    if id(node) not in known:
        inside: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            inside = [one for pair in node.value for one in pair]
        elif isinstance(node, yaml.SequenceNode):
            inside = node.value
        known[id(node)] = 1 + sum(_nodes(one, known) for one in inside)
    return known[id(node)]
