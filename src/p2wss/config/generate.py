"""Generate ``config/default.yaml`` and ``config/schema.json``."""

import json
from pathlib import Path

from p2wss.config.base import Section
from p2wss.config.sections import Config


def default_yaml() -> str:
    """All keys with their defaults and one-line descriptions, as YAML."""
    lines = [
        "# All settings; the defaults run the miniature. Generated from src/p2wss/config by `make config`.",
        "# yaml-language-server: $schema=schema.json",
    ]
    _append_section(Config(), lines, "")
    return "\n".join(lines) + "\n"


def _append_section(model: Section, lines: list[str], indent: str) -> None:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, Section):
            description = field.description or (type(value).__doc__ or "").split("\n")[0]
            lines += ([""] if not indent else []) + [f"{indent}{name}:  # {description}"]
            _append_section(value, lines, indent + "  ")
        else:
            plain = json.dumps(model.model_dump(mode="json")[name], ensure_ascii=False)
            lines.append(
                f"{indent}{name}: {plain}" + (f"  # {field.description}" if field.description else "")
            )


def json_schema() -> str:
    """The JSON schema of a config."""
    return json.dumps(Config.model_json_schema(), indent=1) + "\n"


def main(folder: str = "config") -> None:
    """Write ``default.yaml`` and ``schema.json``."""
    Path(folder, "default.yaml").write_text(default_yaml(), encoding="utf-8")
    Path(folder, "schema.json").write_text(json_schema(), encoding="utf-8")
