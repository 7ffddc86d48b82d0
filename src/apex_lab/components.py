"""Components of a configuration: nodes with a `_target_`, checked against the signature of what they build.

The type hints of a constructor are its schema: every key must be one of its parameters and every value must have the
parameter's type, strictly (no "3" for 3, no 1 for true; a whole number is taken for a float). Bounds are written as
`Annotated[int, Field(ge=1)]`, alternatives as `Literal[...]`. A new model therefore needs no schema of its own.
"""

from __future__ import annotations

import difflib
import inspect
import json
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hydra.utils import get_object, instantiate
from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic.errors import PydanticSchemaGenerationError, PydanticUndefinedAnnotation

from apex_lab.errors import UserError

Node = Mapping[str, Any]

_STRICT = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)


def is_node(value: object) -> bool:
    """Whether a value of a plain configuration describes a component."""
    return isinstance(value, Mapping) and "_target_" in value


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`"; did you mean 'x'?"`, or nothing where no known word is close."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{close[0]}'?" if close else ""


def target_of(node: Node, key: str) -> Callable[..., Any]:
    """The class or function that a node names.

    Raises:
        UserError: there is no such thing.
    """
    name = node["_target_"]
    if not isinstance(name, str):
        raise UserError(f"{key}._target_ = {name!r} is not the name of a class, such as 'torch.optim.Adam'.")
    try:
        target = get_object(name)
    except Exception as error:  # importing a module can raise anything
        raise UserError(f"{key}._target_ = {name!r} cannot be imported: {one_line(error)}.") from error
    if not callable(target):
        raise UserError(f"{key}._target_ = {name!r} is not a class or function.")
    return target


def check(node: Node, key: str, supplied: Iterable[str] = ()) -> None:
    """Checks a component and all components inside it, without building any.

    Args:
        node: plain containers, all interpolations resolved.
        key: where the node stands in the configuration, for messages.
        supplied: parameters that code gives at construction, not the configuration.

    Raises:
        UserError: unknown key, missing key, wrong type or value out of bounds; one sentence.
    """
    target = target_of(node, key)
    parameters, open_ended = _parameters(target, set(supplied))
    values = {name: value for name, value in node.items() if name != "_target_"}
    for name in values:
        if name in supplied or (name not in parameters and not open_ended):
            raise UserError(f"Unknown key {key}.{name} = {values[name]!r}{did_you_mean(name, parameters)}.")
    for name, value in values.items():
        _check_nested(value, f"{key}.{name}")
        if _holds_nodes(value) and name in parameters:
            parameters[name] = (Any, ...)
    try:
        # Field names such as `model_size` or `schema` are legal parameters: aliases keep pydantic from minding them.
        aliases = {name: f"field_{i}" for i, name in enumerate(parameters)}
        schema = create_model(
            "Component", __config__=_STRICT, **{aliases[name]: spec for name, spec in parameters.items()}
        )
        known = {aliases[name]: value for name, value in values.items() if name in parameters}
    except (PydanticSchemaGenerationError, PydanticUndefinedAnnotation) as error:
        raise UserError(f"{key}: the type hints of {node['_target_']} cannot be read: {one_line(error)}.") from error
    names = {alias: name for name, alias in aliases.items()}
    validate(schema, known, key, names)


def build(node: Node, key: str, **supplied: Any) -> Any:
    """Builds a checked component; what its constructor refuses becomes one sentence.

    Raises:
        UserError: the constructor raised ValueError or TypeError.
    """
    try:
        return instantiate(dict(node), _convert_="all", **supplied)
    except UserError:
        raise
    except Exception as error:
        cause = error.__cause__ or error
        if isinstance(cause, UserError):
            raise UserError(f"{key}: {cause}") from error
        if isinstance(cause, (ValueError, TypeError)):
            raise UserError(f"{key} ({node['_target_']}): {one_line(cause)}.") from error
        raise


def takes(node: Node, key: str, parameter: str) -> bool:
    """Whether what a node builds has a parameter of that name."""
    return parameter in inspect.signature(target_of(node, key)).parameters


def validate(schema: type[BaseModel], values: Node, key: str, names: Mapping[str, str] | None = None) -> BaseModel:
    """Strictly validates plain values; the first fault becomes one sentence.

    Validation goes through JSON, where a list stands for a tuple and a string for a path or an enumeration.
    """
    try:
        return schema.model_validate_json(json.dumps(values))
    except ValidationError as error:
        raise UserError(_sentence(error, values, key, names or {}, schema)) from error


def one_line(error: BaseException) -> str:
    """What an exception says, on one line and without a full stop."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text.rstrip(".")


def _parameters(target: Callable[..., Any], supplied: set[str]) -> tuple[dict[str, Any], bool]:
    """Parameter name -> (type, default or ...) as pydantic wants it, and whether further keywords are taken."""
    signature = inspect.signature(target)
    hints = _hints(target)
    parameters: dict[str, Any] = {}
    open_ended = False
    for name, parameter in signature.parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            open_ended = True
        elif parameter.kind is not parameter.VAR_POSITIONAL and name not in supplied:
            default = ... if parameter.default is parameter.empty else parameter.default
            parameters[name] = (hints.get(name, Any), default)
    return parameters, open_ended


def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    """Resolved type hints of what `target` is called with; a hint that cannot be resolved is left out.

    Some libraries annotate with names that exist for type checkers only.
    """
    function = inspect.unwrap(target.__init__ if inspect.isclass(target) else target)  # type: ignore[misc]
    namespace = getattr(function, "__globals__", {})
    hints: dict[str, Any] = {}
    for name, hint in getattr(function, "__annotations__", {}).items():
        holder = types.SimpleNamespace(__annotations__={name: hint})
        try:
            hints.update(typing.get_type_hints(holder, globalns=namespace, include_extras=True))
        except NameError:
            continue
    return hints


def _holds_nodes(value: object) -> bool:
    if is_node(value):
        return True
    if isinstance(value, Mapping):
        return any(_holds_nodes(item) for item in value.values())
    return isinstance(value, list) and any(_holds_nodes(item) for item in value)


def _check_nested(value: object, key: str) -> None:
    if is_node(value):
        check(typing.cast(Node, value), key)
    elif isinstance(value, Mapping):
        for name, item in value.items():
            _check_nested(item, f"{key}.{name}")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            _check_nested(item, f"{key}[{i}]")


def _sentence(error: ValidationError, values: Node, key: str, names: Mapping[str, str], schema: type[BaseModel]) -> str:
    """The first fault of a validation as one sentence with key, value and what is wanted."""
    faults = error.errors(include_url=False)
    first = faults[0]
    place = _place(values, first["loc"])
    if first["type"] == "missing":
        place.append(first["loc"][-1])
    words = [str(names.get(str(part), part)) for part in place]
    full = ".".join([key, *words] if key else words)
    if first["type"] == "extra_forbidden":
        known = _fields_at(schema, place[:-1])
        return f"Unknown key {full} = {first['input']!r}{did_you_mean(words[-1], known)}."
    if first["type"] == "missing":
        return f"{full} is missing: give it a value."
    wanted = "; or ".join(dict.fromkeys(fault["msg"] for fault in faults if fault["loc"][: len(place)] == tuple(place)))
    wanted = wanted.removeprefix("Value error, ")
    if not place:
        return f"{key + ': ' if key else ''}{wanted.rstrip('.')}."
    return f"{full} = {first['input']!r} is wrong: {wanted[:1].lower()}{wanted[1:].rstrip('.')}."


def _place(values: object, location: tuple[int | str, ...]) -> list[int | str]:
    """The keys in an error's location; pydantic also names the branch of a union there."""
    place: list[int | str] = []
    for part in location:
        if isinstance(values, list):
            inside = isinstance(part, int) and part < len(values)
        else:
            inside = isinstance(values, Mapping) and part in values
        if inside:
            place.append(part)
            values = values[part]  # type: ignore[index]
    return place


def _fields_at(schema: type[BaseModel], place: list[int | str]) -> list[str]:
    """Names of the fields of the model that stands at a place inside a schema."""
    for part in place:
        field = schema.model_fields.get(str(part))
        inner = field.annotation if field is not None else None
        if not (inspect.isclass(inner) and issubclass(inner, BaseModel)):
            return []
        schema = inner
    return list(schema.model_fields)
