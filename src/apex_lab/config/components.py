"""Components of a configuration: nodes with a `_target_`, checked against the signature of what they build.

The type hints of a constructor are its schema: every key must be one of its parameters and every value must have the
parameter's type, strictly (no "3" for 3, no 1 for true; a whole number is taken for a float). Bounds are written as
`Annotated[int, Field(ge=1)]`, alternatives as `Literal[...]`. A new model therefore needs no schema of its own.
"""

from __future__ import annotations

import functools
import inspect
import pkgutil
import re
import types
import typing
from abc import ABCMeta
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pydantic import ConfigDict, create_model
from pydantic.errors import PydanticSchemaGenerationError, PydanticUndefinedAnnotation

from apex_lab.base import faults
from apex_lab.base.errors import UserError
from apex_lab.base.machine import GIGABYTE, free_memory
from apex_lab.base.validation import did_you_mean, one_line, sentence, shown, validate

Node = Mapping[str, Any]

_STRICT = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)


def is_node(value: object) -> bool:
    """Whether a value of a plain configuration describes a component."""
    return isinstance(value, Mapping) and "_target_" in value


def arguments_of(node: Node) -> dict[str, Any]:
    """What a node gives to the constructor."""
    return {str(name): value for name, value in node.items() if name not in ("_target_", "_partial_")}


def target_of(node: Node, key: str) -> Callable[..., Any]:
    """The class or function that a node names.

    Raises:
        UserError: there is no such class or function.
    """
    name = node["_target_"]
    if not isinstance(name, str):
        raise UserError(f"{key}._target_ = {shown(name)} is not the name of a class, such as 'torch.optim.Adam'.")
    try:
        target = pkgutil.resolve_name(name)
    except (Exception, SystemExit) as error:  # importing a module can raise anything
        raise UserError(sentence(f"{key}._target_ = '{name}' cannot be imported: {one_line(error)}")) from error
    if not callable(target):
        raise UserError(f"{key}._target_ = '{name}' is not a class or function.")
    return target


def takes(node: Node, key: str, parameter: str) -> bool:
    """Whether what a node builds has a parameter of that name."""
    return parameter in _signature(target_of(node, key), key).parameters


def check(node: Node, key: str, supplied: Iterable[str] = ()) -> None:
    """Checks a component and all components inside it, without building any.

    Args:
        node: plain containers, all interpolations resolved.
        key: where the node stands in the configuration, for messages.
        supplied: parameters that code gives at construction, not the configuration.

    A node with `_partial_: true` makes a function that builds the component when it gets the missing parameters; so
    parameters may be missing.

    Raises:
        UserError: unknown key, missing key, wrong type or value out of bounds; one sentence.
    """
    parameters, open_ended = _parameters(target_of(node, key), key, set(supplied))
    values = arguments_of(node)
    if node.get("_partial_"):
        parameters = {
            name: (hint, None if default is ... and name not in values else default)
            for name, (hint, default) in parameters.items()
        }
    for name, value in values.items():
        if name not in parameters and (name in supplied or not open_ended):
            raise UserError(sentence(f"Unknown key {key}.{name} = {shown(value)}{did_you_mean(name, parameters)}"))
        _check_nested(value, f"{key}.{name}")
        if _holds_nodes(value) and name in parameters:
            _check_built(value, parameters[name][0], f"{key}.{name}")
            parameters[name] = (Any, ...)
    # pydantic minds some names of fields (`model_...`, `schema`) that are fine for parameters
    fields = {name: f"field_{i}" for i, name in enumerate(parameters)}
    try:
        schema: Any = create_model(
            "Component", __config__=_STRICT, **{fields[name]: spec for name, spec in parameters.items()}
        )
    except (PydanticSchemaGenerationError, PydanticUndefinedAnnotation) as error:
        raise UserError(f"{key}: the type hints of {node['_target_']} cannot be read: {one_line(error)}.") from error
    known = {fields[name]: value for name, value in values.items() if name in parameters}
    validate(schema, known, key, {field: name for name, field in fields.items()})


def build(node: Node, key: str, **supplied: Any) -> Any:
    """Builds a checked component and all components inside it; what a constructor refuses becomes one sentence.

    Raises:
        UserError: a constructor raised something.
    """
    arguments = {name: _build_inside(value, f"{key}.{name}") for name, value in arguments_of(node).items()}
    if node.get("_partial_"):
        return functools.partial(target_of(node, key), **arguments)
    try:
        return target_of(node, key)(**arguments, **supplied)
    except UserError as error:
        raise UserError(sentence(f"{key}: {one_line(error)}")) from error
    except (ValueError, TypeError) as error:
        raise UserError(sentence(f"{key} ({node['_target_']}): {one_line(error)}")) from error
    except Exception as error:
        raise UserError(_broken(error, f"{key} ({node['_target_']})")) from error
    except SystemExit as error:  # of a function that is no component, such as sys.exit
        raise UserError(f"{key} ({node['_target_']}) ends the program: it is no component.") from error


def _broken(error: Exception, where: str) -> str:
    """The sentence for what a constructor has not foreseen."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        asked = re.search(r"(\d+) bytes", str(error))
        size = f"{int(asked.group(1)) / GIGABYTE:,.1f} GB at once" if asked else "more memory"
        return f"{where} asks for {size}, and {free_memory() / GIGABYTE:.1f} GB are free here: choose smaller sizes."
    return faults.told(error, where)


def _build_inside(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        if is_node(value):
            return build(value, key)
        return {name: _build_inside(item, f"{key}.{name}") for name, item in value.items()}
    if isinstance(value, list):
        return [_build_inside(item, f"{key}[{i}]") for i, item in enumerate(value)]
    return value


def _signature(target: Callable[..., Any], key: str) -> inspect.Signature:
    try:
        return inspect.signature(target)
    except ValueError as error:  # some built-in classes
        raise UserError(sentence(f"{key}._target_ cannot be used: {one_line(error)}")) from error


def _parameters(target: Callable[..., Any], key: str, supplied: set[str]) -> tuple[dict[str, Any], bool]:
    """Parameter name -> (type, default or ...) as pydantic wants it, and whether further keywords are taken."""
    hints = _hints(target)
    parameters: dict[str, Any] = {}
    open_ended = False
    for name, parameter in _signature(target, key).parameters.items():
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


def _check_built(value: Any, hint: Any, key: str) -> None:
    """Refuses a nested component of a class that its parameter does not allow, as far as both are classes."""
    if not is_node(value) or value.get("_partial_"):
        return
    built = target_of(value, key)
    wanted = _classes(hint)
    if inspect.isclass(built) and wanted and not issubclass(built, wanted):
        names = " or ".join("nothing" if one is type(None) else one.__name__ for one in wanted)
        raise UserError(f"{key}: {value['_target_']} cannot stand here, where {names} is asked for.")


def _classes(hint: Any) -> tuple[type, ...]:
    """Classes that a type hint allows; empty where classes do not decide.

    Any, protocols, typed dictionaries, array types and the abstract collections have metaclasses or registries of their
    own: what satisfies them need not be a subclass.
    """
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _classes(typing.get_args(hint)[0])
    if origin in (typing.Union, types.UnionType):
        parts = [_classes(part) for part in typing.get_args(hint)]
        return tuple(one for part in parts for one in part) if all(parts) else ()
    plain = hint if origin is None else origin
    if type(plain) not in (type, ABCMeta) or plain.__module__ == "collections.abc":
        return ()
    return (plain,)


def _holds_nodes(value: object) -> bool:
    if isinstance(value, Mapping):
        return is_node(value) or any(_holds_nodes(item) for item in value.values())
    return isinstance(value, list) and any(_holds_nodes(item) for item in value)


def _check_nested(value: object, key: str) -> None:
    if isinstance(value, Mapping):
        if is_node(value):
            check(value, key)
            return
        for name, item in value.items():
            _check_nested(item, f"{key}.{name}")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            _check_nested(item, f"{key}[{i}]")
