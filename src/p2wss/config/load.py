"""Read and validate configs, and pass sections on as JSON."""

import json
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from p2wss.config.base import merge
from p2wss.config.eval import NOT_OF_MEASURES, NOT_OF_ROOFER
from p2wss.config.sections import Config
from p2wss.storage.messages import InputError, reading


def load(*documents: str | Path | dict[str, Any]) -> Config:
    """The config from YAML files or mappings. Later documents override earlier ones, and all override the defaults.

    A string that starts with ``{`` is JSON. Raises :class:`InputError` that names the invalid key and the reason.
    """
    merged: dict[str, Any] = {}
    for document in documents:
        sections = _parse(document).items()
        merge(merged, {name: {} if section is None else section for name, section in sections})
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "config"
        reason = "unknown key" if first["type"] == "extra_forbidden" else first["msg"]
        raise InputError(f"config: {key}: {reason}{_suggestion(first)}") from error


def as_config(config: Config | str | Path | dict[str, Any] | None, detail: str | None = None) -> Config:
    """A config from what a user gives: a file, a mapping of sections, or nothing. detail: replaces
    ``reconstruct.detail``.

    Raises :class:`InputError` for an unknown key or value.
    """
    stated = {} if detail is None else {"reconstruct": {"detail": detail}}
    if not isinstance(config, Config):
        return load(config or {}, stated)
    return load(config.model_dump(mode="json", exclude_unset=True), stated) if stated else config


def section_json(config: Config, *names: str, without: Collection[str] = ()) -> str:
    """The named sections as one line of JSON, readable by :func:`load`. without: keys to omit, ``a.b`` in a
    nested section, ``a.*.b`` in each item of a list."""
    exclude: dict[str, Any] = {}
    for key in without:
        *outer, last = key.replace("*", "__all__").split(".")
        level = exclude
        for name in outer:
            level = level.setdefault(name, {})
        level[last] = True
    sections = {name: getattr(config, name).model_dump(mode="json", exclude=exclude) for name in names}
    return json.dumps(sections, sort_keys=True)


def method_json(config: Config, method: str) -> str:
    """The settings that a method of the evaluation reads, as :func:`section_json` gives them."""
    if method == "roofer":
        return section_json(config, "eval", without=NOT_OF_ROOFER)
    return section_json(config, "reconstruct")


def measure_json(config: Config) -> str:
    """The settings that the measures of the evaluation read."""
    return section_json(config, "buildings", "eval", without=NOT_OF_MEASURES)


def _parse(document: str | Path | dict[str, Any]) -> dict[str, Any]:
    if isinstance(document, dict):
        return document
    import yaml  # a hundredth of a second, where there is a config

    text = str(document)
    with reading(f"config: {document}", "YAML"):
        if not text.lstrip().startswith("{"):
            text = Path(document).read_text(encoding="utf-8")
        parsed = yaml.safe_load(text) or {}
    if not isinstance(parsed, dict):
        raise InputError(f"config: {document}: expected a mapping of sections, got {type(parsed).__name__}")
    return parsed


def _suggestion(error: Any) -> str:
    from difflib import get_close_matches

    key, names = "", []
    if error["type"] == "literal_error":
        key, names = str(error["input"]), re.findall("'([^']+)'", error["ctx"]["expected"])
    elif error["type"] == "extra_forbidden":
        key = str(error["loc"][-1])
        model: Any = Config
        for part in error["loc"][:-1]:
            if isinstance(part, str) and part in getattr(model, "model_fields", {}):
                model = model.model_fields[part].annotation
        names = list(getattr(model, "model_fields", {}))
    key = key.lower()
    matches = [name for name in names if name.startswith(key)]
    if error["type"] == "literal_error":  # gpkg is short for geopackage
        matches += [name for name in names if re.match(".*".join(name), key)]
    matches = matches or get_close_matches(key, names, n=1)
    return f" (did you mean {matches[0]}?)" if matches else ""
