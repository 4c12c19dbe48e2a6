"""Checks of the arguments of public functions, before anything slow begins, with messages in the words of Python.

A parameter is checked by its name, since one name means the same in every function.
"""

import inspect
import logging
import math
import os
import re
from collections.abc import Callable
from functools import wraps
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

from p2wss.storage.messages import InputError

# packages that only some functions need, and the extras of pyproject.toml that bring them
EXTRAS = {
    "pyarrow": "parquet",
    "torch": "network",
    "filelock": "network",
    "embreex": "scan",
    "matplotlib": "report",
    "PIL": "report",
    "snakemake": "workflow",
    "folium": "map",
}
# options of the command line whose settings have other names
_SETTINGS = {"layer": "footprint_layer"}
_OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)")
P = ParamSpec("P")
T = TypeVar("T")


def missing_extra(error: ModuleNotFoundError) -> InputError:
    """What to install for a package that is missing. Raises ``error`` for a package that no extra brings."""
    package = str(error.name).split(".")[0]
    if package not in EXTRAS:
        raise error
    return InputError(f"needs {package}; type: pip install 'p2wss[{EXTRAS[package]}]'")


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """The function with its arguments checked by :data:`_CHECKS`: a wrong argument raises :class:`InputError`. So does
    a missing package; the message names the extra to install.

    None passes where it is the default.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def of_checked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:
            return function(*args, **kwargs)  # which raises it with the name of the function
        for name, value in bound.arguments.items():
            if name in _CHECKS and not (value is None and signature.parameters[name].default is None):
                check, expected = _CHECKS[name]
                try:
                    bound.arguments[name] = check(value)
                except (TypeError, ValueError) as error:
                    shown = " ".join(repr(value).split())
                    shown = shown if len(shown) < 60 else f"a {type(value).__name__}"
                    raise InputError(f"{name}: state {expected}, not {shown}") from error
        try:
            return function(*bound.args, **bound.kwargs)
        except ModuleNotFoundError as error:
            raise missing_extra(error) from error

    return of_checked


def public(function: Callable[P, T]) -> Callable[P, T]:
    """The function, :func:`checked`, with errors and log lines in words of Python: options of commands are replaced by
    the parameters or settings of the same meaning."""
    parameters = inspect.signature(function).parameters
    inner = checked(function)

    def word(match: re.Match[str]) -> str:
        name = match[1].replace("-", "_")
        return f"{name}=" if name in parameters else f"reconstruct.{_SETTINGS.get(name, name)}"

    def reword(record: logging.LogRecord) -> bool:
        record.msg, record.args = _OPTION.sub(word, record.getMessage()), ()
        return True

    @wraps(function)
    def in_words(*args: P.args, **kwargs: P.kwargs) -> T:
        log = logging.getLogger("p2wss")
        log.addFilter(reword)
        try:
            return inner(*args, **kwargs)
        except InputError as error:
            text = _OPTION.sub(word, str(error))
            if text == str(error):
                raise
            raise InputError(text) from error
        finally:
            log.removeFilter(reword)

    return in_words


def _one_of(*kinds: type, having: str = "") -> Callable[[Any], Any]:
    """A check that a value has one of these types. having: an attribute that is enough, for types that are slow to
    import."""

    def check(value: Any) -> Any:
        if not isinstance(value, kinds) and not (having and hasattr(value, having)):
            raise TypeError
        return value

    return check


def _names(value: Any) -> list[str]:
    return [value] if isinstance(value, str) else list(map(str, value))


def _some_names(value: Any) -> list[str]:
    if not (names := _names(value)):
        raise ValueError
    return names


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise TypeError
    return float(value)


def _at_least(low: int) -> Callable[[Any], int]:
    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
            raise TypeError
        return int(value)

    return check


def _box(value: Any) -> tuple[float, ...]:
    x_min, y_min, x_max, y_max = box = tuple(map(_number, value))
    if x_min > x_max or y_min > y_max:
        raise ValueError
    return box


_A_PATH = (_one_of(str, os.PathLike), "a path")
# for the name of each parameter: a function that returns the value in one form, or raises TypeError or ValueError; what
# is expected, for the message
_CHECKS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "path": _A_PATH,
    "folder": _A_PATH,
    "terrain": _A_PATH,
    "model": _A_PATH,
    "crs": (_one_of(str, Integral, having="to_epsg"), "a CRS, such as EPSG:28992"),
    "config": (_one_of(str, os.PathLike, dict, having="reconstruct"), "a file or sections of the config"),
    "ids": (_some_names, "ids of buildings"),
    "formats": (_names, "names of formats"),
    "name": (_one_of(str), "text"),
    "id_field": (_one_of(str), "the name of a column"),
    "detail": (_one_of(str), '"low", "normal" or "high"'),
    "bbox": (_box, "four numbers: x_min, y_min, x_max, y_max"),
    "eave_height_m": (_number, "metres"),
    "threads": (_at_least(1), "a whole number, at least 1"),
    "seed": (_at_least(0), "a whole number, at least 0"),
    "progress": (_one_of(bool, having="__call__"), "True, False or a function of two numbers"),
}
