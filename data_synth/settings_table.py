"""Every setting of a model with its default, limits and meaning, as a Markdown table.

`python -m data_synth.settings_table` prints the phantom's; `docs/phantom.md` holds it.
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
from pydantic_core import PydanticUndefined

from data_synth.settings import PhantomSettings

SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


def settings_table(model: type[BaseModel] = PhantomSettings) -> str:
    """The whole table; keys are written as ``section.key``."""
    lines = ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    for key, default, allowed, meaning in _rows(model, ""):
        lines.append(f"| `{key}` | {default} | {allowed} | {meaning} |")
    return "\n".join(lines) + "\n"


def _rows(
    model: type[BaseModel], head: str, given: BaseModel | None = None
) -> Iterator[tuple[str, str, str, str]]:
    meanings = attribute_docstrings(model)
    for name, field in model.model_fields.items():
        key = f"{head}{field.alias or name}"
        value = getattr(given, name) if given else field.get_default()
        below = [one for one in (field.annotation, *get_args(field.annotation)) if _is_model(one)]
        if isinstance(value, dict) and below:
            yield from _rows(below[0], f"{key}.NAME.")
        elif below and all(not one.is_required() for one in below[0].model_fields.values()):
            yield from _rows(below[0], f"{key}.", value)
        else:
            meaning = meanings.get(name, "").replace("|", "\\|")
            yield key, _default(value), _allowed(field), meaning


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _default(value: Any) -> str:
    if value is PydanticUndefined:
        return "to be given"
    if isinstance(value, BaseModel):
        return str(getattr(value, "name", value))
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
