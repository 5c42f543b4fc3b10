"""What is wrong with what a user wrote, key by key, in words."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

PLAIN = {
    **dict.fromkeys(("tuple_type", "list_type"), "needs a list, such as [first, second]"),
    **dict.fromkeys(("float_parsing", "float_type"), "needs a number"),
    **dict.fromkeys(("int_parsing", "int_type", "int_from_float"), "needs a whole number"),
    **dict.fromkeys(("bool_parsing", "bool_type"), "needs true or false"),
}
"""What the library's kinds of error ask for, in words."""


class Section(BaseModel):
    """Keys that a user writes: none unknown, and no number infinite or written as ``true``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _is_no_truth(cls, given: Any) -> Any:
        """The library takes true for the number 1, which nobody means by it."""
        for name, field in cls.model_fields.items() if isinstance(given, dict) else ():
            kinds = _kinds(field.annotation)
            truth = find_truth(given.get(field.alias or name))
            if truth is not None and bool not in kinds and kinds & {int, float}:
                raise ValueError(f"{name}: {str(truth).lower()} is no number")
        return given


def find_truth(value: Any) -> bool | None:
    """The first true or false among what a user wrote, lists looked into; None if there is none."""
    if isinstance(value, list | tuple):
        return next((one for one in map(find_truth, value) if one is not None), None)
    return value if isinstance(value, bool) else None


def each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Keys and values of an object in JSON, whose reader else keeps the last of each name.

    Raises
    ------
    ValueError
        When a key is given twice.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{key} is given a second time; keep one of them")
        found[key] = value
    return found


def _kinds(annotation: Any) -> set[Any]:
    """The types that an annotation is made of."""
    return {annotation}.union(*map(_kinds, get_args(annotation)))


def describe_validation(
    error: ValidationError,
    where: str,
    model: type[BaseModel] | None = None,
    other: tuple[str, type[BaseModel]] | None = None,
) -> str:
    """A validation error as lines that name the file, the key, and what came.

    With the ``model`` that was to be filled, an unknown key is answered with the nearest known, and
    with the sections that have a key of this name; ``other`` is a file, in words, that may have
    been meant, and its model.
    """
    lines = []
    for one in error.errors():
        key = ".".join(str(part) for part in one["loc"]) or "(all)"
        message = one["msg"].removeprefix("Value error, ")
        if one["type"] == "extra_forbidden":
            message = f"unknown key; {_instead(one['loc'], model, other)}"
        elif one["type"] == "missing":
            message = "is missing"
            if model is not None:
                message += "; what stands here replaces a default, so all of it must be written"
        elif one["type"] == "model_type" and (below := _keys(_at(one["loc"], model))):
            message = f"needs keys below it ({', '.join(below)})"
        elif one["type"].startswith("union_tag"):
            kind = one["ctx"]["discriminator"].strip("'")
            given = f", got {one['ctx']['tag']!r}" if "tag" in one["ctx"] else ""
            known = one["ctx"].get("expected_tags", "")
            message = f"needs `{kind}:`, one of {known}{given}" if known else f"needs `{kind}:`"
        elif one["type"] == "string_type" and not isinstance(one["input"], dict | list | None):
            message = "needs text; put it in quotes as it stands in the file"
        elif one["type"] == "string_pattern_mismatch":
            message = "needs letters, digits and '_ . -' alone, a letter or digit first"
        elif one["type"] in PLAIN:
            message = PLAIN[one["type"]]
        elif one["type"] in ("too_short", "too_long"):
            needed = one["ctx"].get("min_length", one["ctx"].get("max_length"))
            message = f"needs {needed} entries, not {one['ctx']['actual_length']}"
        came = "" if isinstance(one["input"], dict) else f" (got {_short(one['input'])})"
        lines.append(f"{where}: {key}: {message}{came}")
    return "\n".join(lines)


def _short(value: Any) -> str:
    """As Python writes it, its middle left out where it is long."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-60:]}"


def _instead(
    place: tuple[int | str, ...],
    model: type[BaseModel] | None,
    other: tuple[str, type[BaseModel]] | None,
) -> str:
    """What to do about an unknown key."""
    key = str(place[-1])
    found = _homes(key, model)
    if other and not found:
        found = [f"in {other[0]}, {home}" for home in _homes(key, other[1])]
    homes = " or ".join(found)
    # A name that is known elsewhere is hardly misspelt: only a close likeness is then named too.
    near = get_close_matches(key, _keys(_at(place[:-1], model)), 1, 0.7 if homes else 0.6)
    said = [f"it belongs {homes}"] if homes else []
    said += [f"did you mean {near[0]}?"] if near else []
    return ", or ".join(said) or "check its spelling"


def _homes(key: str, model: Any, section: str = "") -> list[str]:
    """Where a model and those within it have such a key."""
    known = _keys(model)
    homes = [f"under {section}" if section else "at the top level"] if key in known else []
    for name in known:
        inner, place = _within(model, name), f"{section}.{name}" if section else name
        if get_origin(inner) is dict:
            inner, place = _within(inner, "NAME"), f"{place}.NAME"
        homes += _homes(key, inner, place)
    return homes


def _keys(model: Any) -> dict[str, Any]:
    """Annotations of a model's fields, by the keys under which they are given."""
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        return {}
    return {one.alias or name: one.annotation for name, one in model.model_fields.items()}


def _at(place: tuple[int | str, ...], model: Any) -> Any:
    """The model at a place within a model, or None."""
    for part in place:
        model = _within(model, part)
    return model


def _within(known: Any, key: int | str) -> Any:
    """The model under one key of a model or of a mapping, or None."""
    if get_origin(known) is dict:
        return get_args(known)[1]
    inner = _keys(known).get(str(key))
    kinds = [one for one in get_args(inner) if isinstance(one, type)]
    return kinds[0] if type(None) in kinds else inner
