"""Every setting of the phantom with its default, limits and meaning, as a Markdown table.

`python -m data_synth.settings_table` prints it; `docs/phantom.md` holds it.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from data_synth.settings import PhantomSettings

SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


def settings_table() -> str:
    """The whole table; keys are written as ``section.key``."""
    lines = ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    for key, default, allowed, meaning in _rows(PhantomSettings(), ""):
        lines.append(f"| `{key}` | {default} | {allowed} | {meaning} |")
    return "\n".join(lines) + "\n"


def _rows(settings: BaseModel, head: str) -> Iterator[tuple[str, str, str, str]]:
    kind = type(settings)
    meanings = attribute_docstrings(kind)
    for name, field in kind.model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            yield from _rows(value, f"{head}{name}.")
        else:
            meaning = meanings.get(name, "").replace("|", "\\|")
            yield f"{head}{name}", _default(value), _allowed(field), meaning


def _default(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(str(one) for one in value) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else str(value)


def _allowed(field: FieldInfo) -> str:
    limits = [
        f"{sign} {getattr(one, short):g}"
        for one in field.metadata
        for short, sign in SIGNS.items()
        if getattr(one, short, None) is not None
    ]
    kinds = [field.annotation, *get_args(field.annotation)]
    names = [str(n) for kind in kinds if get_origin(kind) is Literal for n in get_args(kind)]
    return ", ".join(limits + list(dict.fromkeys(names)))


def attribute_docstrings(kind: type) -> dict[str, str]:
    """Docstrings below the attributes of a class and of the classes it extends, on one line."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if issubclass(one, BaseModel) and one is not BaseModel:
            tree = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
            assert isinstance(tree, ast.ClassDef)
            for before, after in zip(tree.body, tree.body[1:], strict=False):
                if isinstance(before, ast.AnnAssign) and isinstance(after, ast.Expr):
                    name, text = ast.unparse(before.target), ast.literal_eval(after.value)
                    found[name] = " ".join(str(text).replace("``", "`").split())
    return found


if __name__ == "__main__":
    sys.stdout.write(settings_table())
