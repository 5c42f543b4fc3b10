"""YAML as users write it: read with nothing that is written in it lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import InputError


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


def read_yaml(path: Path) -> Any:
    """What a YAML file holds; None where it is empty.

    Raises
    ------
    InputError
        When it cannot be read, or a section gives a key twice.
    """
    try:
        with path.open("rb") as stream:
            return yaml.load(stream, _Loader)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (yaml.YAMLError, OSError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({error})") from error
