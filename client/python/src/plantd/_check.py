"""What a caller gives, checked where the caller is: errors name the culprit and what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

_Message = TypeVar("_Message", bound=Message)

#: How a field of the contract is called here.
_NAMES = {
    "time_step_s": "dt",
    "grace_s": "grace",
    "expires_s": "expires",
    "checkpoint_interval_s": "checkpoint_interval",
}

_WHOLE = {
    FieldDescriptor.CPPTYPE_INT32: (-(2**31), 2**31 - 1),
    FieldDescriptor.CPPTYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.CPPTYPE_UINT32: (0, 2**32 - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 2**64 - 1),
}

_KINDS = {
    FieldDescriptor.CPPTYPE_DOUBLE: "a number",
    FieldDescriptor.CPPTYPE_FLOAT: "a number",
    FieldDescriptor.CPPTYPE_BOOL: "True or False",
    FieldDescriptor.CPPTYPE_STRING: "a text",
}


def shown(value: object) -> str:
    """A value in an error, not longer than a line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def instead(name: str, names: Iterable[str]) -> str:
    """What to write instead of a name that nothing has."""
    names = list(names)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    if near:
        return f"; did you mean `{near[0]}`?"
    if not names:
        return "; there is none"
    listed = ", ".join(f"`{name}`" for name in names[:20])
    return f"; there {'is' if len(names) == 1 else 'are'} {listed}"


def one_of(argument: str, value: object, allowed: Iterable[str]) -> None:
    """That an argument is one of some texts."""
    allowed = list(allowed)
    if value not in allowed:
        near = difflib.get_close_matches(str(value), allowed, n=1, cutoff=0.6)
        hint = f" did you mean `{near[0]}`?" if near else ""
        choice = ", ".join(f"`{name}`" for name in allowed)
        raise ValueError(f"`{argument}` is {shown(value)};{hint} allowed are {choice}")


def texts(argument: str, value: Any) -> list[str]:
    """A list of texts; a text alone would be one of letters."""
    if isinstance(value, str):
        raise TypeError(f"`{argument}` is {shown(value)}; a list is needed: [{value!r}]")
    if not isinstance(value, Iterable):
        raise TypeError(f"`{argument}` is {shown(value)}; a list of texts is needed")
    return list(value)


def mapping(argument: str, value: Any, example: str) -> dict[Any, Any]:
    """A dict, or nothing."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise TypeError(f"`{argument}` is {shown(value)}; a dict is needed, such as {example}")
    return dict(value)


def build(kind: type[_Message], /, **fields: Any) -> _Message:
    """A message of the contract; what does not fit into it is named."""
    try:
        return kind(**fields)
    except (TypeError, ValueError, OverflowError, AttributeError):
        error = _fault(kind, fields, "")
    if error is None:
        raise TypeError(f"{shown(fields)} does not fit into {kind.DESCRIPTOR.name}")
    raise error


def _fault(kind: type[_Message], fields: Mapping[str, Any], path: str) -> Exception | None:
    known = kind.DESCRIPTOR.fields_by_name
    for name, value in fields.items():
        if name not in known:
            of = f" of `{path}`" if path else ""
            return TypeError(f"there is no `{name}`{of}{instead(name, known)}")
        field: Any = known[name]
        try:
            kind(**{name: value})
        except (TypeError, ValueError, OverflowError, AttributeError):
            here = _NAMES.get(name, name)
            if (kind.DESCRIPTOR.name, name) == ("PlantSettings", "max_iterations"):
                here = "newton_iterations"
            return _misfit(field, value, f"{path}.{here}" if path else here)
    return None


def _misfit(field: Any, value: Any, path: str) -> Exception:
    """Why a value does not fit into a field."""
    message = field.message_type
    if message is not None and message.GetOptions().map_entry:
        return _misfit_of_map(message, value, path)
    if field.is_repeated:
        if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, Iterable):
            return TypeError(f"`{path}` is {shown(value)}; a list is needed")
        for i, item in enumerate(value):
            error = _misfit_of_one(field, item, f"{path}[{i}]")
            if error is not None:
                return error
        return TypeError(f"`{path}` is {shown(value)}, which does not fit")
    return _misfit_of_one(field, value, path) or TypeError(f"`{path}` is {shown(value)}, which does not fit")


def _misfit_of_map(entry: Any, value: Any, path: str) -> Exception:
    if not isinstance(value, Mapping):
        return TypeError(f"`{path}` is {shown(value)}; a dict is needed")
    for key, item in value.items():
        if not isinstance(key, str):
            return TypeError(f"`{path}` has the key {shown(key)}; a text is needed")
        error = _misfit_of_one(entry.fields_by_name["value"], item, f"{path}[{key!r}]")
        if error is not None:
            return error
    return TypeError(f"`{path}` is {shown(value)}, which does not fit")


def _misfit_of_one(field: Any, value: Any, path: str) -> Exception | None:
    kind = field.cpp_type
    if kind == FieldDescriptor.CPPTYPE_MESSAGE:
        inner = getattr(field.message_type, "_concrete_class")
        if isinstance(value, inner):
            return None
        if not isinstance(value, Mapping):
            keys = ", ".join(f"`{name}`" for name in field.message_type.fields_by_name)
            return TypeError(f"`{path}` is {shown(value)}; a dict is needed, with keys of {keys}")
        return _fault(inner, value, path)
    if kind == FieldDescriptor.CPPTYPE_ENUM:
        return None if isinstance(value, int) else _unlike(path, value, "one of its names")
    if kind in _WHOLE:
        low, high = _WHOLE[kind]
        if isinstance(value, int) and low <= value <= high:
            return None
        return _unlike(path, value, f"a whole number from {low} to {high}")
    right = {
        FieldDescriptor.CPPTYPE_STRING: (str, bytes),
        FieldDescriptor.CPPTYPE_BOOL: (bool, int),
    }.get(kind, (int, float))
    return None if isinstance(value, right) else _unlike(path, value, _KINDS[kind])


def _unlike(path: str, value: Any, needed: str) -> Exception:
    return TypeError(f"`{path}` is {shown(value)}; {needed} is needed")
