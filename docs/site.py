"""Hooks of mkdocs: pages that are made from the code, and files of the repository that pages link to."""

from __future__ import annotations

import inspect
import posixpath
import re
from pathlib import Path
from typing import Any

import click
from mkdocs.structure.files import File

import p2wss
from p2wss import cli
from p2wss.cli.parser import ALL_OPTIONS
from p2wss.config.generate import default_yaml
from p2wss.fetching.area import Fetched
from p2wss.formats.validity import Validity
from p2wss.reconstruction.scene import Scene, SceneBuilding, Surface

ROOT = Path(__file__).resolve().parents[1]
_ROLE = re.compile(r":\w+:`~?([^`]+)`")
_LINK = re.compile(r"(\]\()([^)#\s]+)([^)]*\))")


def on_files(files: Any, config: Any) -> Any:
    """Add the reference, and every file of the repository that a page links to, below ``repository/``."""
    pages = {
        "reference/python.md": f"# Python\n\n[Examples](../manual/python.md).\n\n{_python()}",
        "reference/commands.md": f"# Commands\n\n{_commands()}",
        # last among what a search finds: it names everything
        "reference/settings.md": "---\nsearch:\n  boost: 0.1\n---\n# Settings\n\n`p2wss config` prints the same.\n\n"
        f"```yaml\n{default_yaml()}```\n",
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    pending = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md"]
    for file in list(files):
        if file.src_uri.endswith(".md") and file.src_uri not in pages:
            pending += [path for _, path in _outside(f"docs/{file.src_uri}", file.content_string)]
    added = set()
    while pending:
        path = pending.pop()
        if path in added or not (ROOT / path).is_file():
            continue
        added.add(path)
        if path.endswith(".md"):
            text = (ROOT / path).read_text(encoding="utf-8")
            pending += [each for _, each in _outside(path, text)]
            files.append(File.generated(config, f"repository/{path}", content=_relinked(path, text)))
        else:
            files.append(File.generated(config, f"repository/{path}", abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links to files outside of docs/ lead to their copies."""
    source = page.file.src_uri
    return (
        markdown
        if source.startswith(("repository/", "reference/"))
        else _relinked(f"docs/{source}", markdown)
    )


def _outside(page: str, text: str) -> list[tuple[str, str]]:
    """(link, path in the repository) of the links of a page to files outside of docs/."""
    links = [link for _, link, _ in _LINK.findall(text) if "://" not in link]
    paths = [(link, posixpath.normpath(posixpath.join(posixpath.dirname(page), link))) for link in links]
    return [(link, path) for link, path in paths if not path.startswith("docs/")]


def _relinked(page: str, text: str) -> str:
    """The text with links that work in the site, where docs/ is the top and the repository a folder of it."""
    place = page.removeprefix("docs/") if page.startswith("docs/") else f"repository/{page}"

    def link_to(match: re.Match[str]) -> str:
        before, link, rest = match.groups()
        if "://" in link:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
        target = path.removeprefix("docs/") if path.startswith("docs/") else f"repository/{path}"
        return before + posixpath.relpath(target, posixpath.dirname(place) or ".") + rest

    return _LINK.sub(link_to, text)


def _python() -> str:
    """Signatures and docstrings of the public interface."""
    named = {f"p2wss.{name}": getattr(p2wss, name) for name in p2wss.__all__}
    for kind in (Scene, SceneBuilding, Surface, Fetched, Validity):
        members = {f"{kind.__name__}.{name}": each for name, each in vars(kind).items() if name[0] != "_"}
        named |= {kind.__name__: kind} | {
            name: each for name, each in members.items() if inspect.getdoc(each)
        }
    parts = []
    for name, each in named.items():
        if "." in name and isinstance(each, str | int | float | tuple):
            continue
        signature = _signature(each) if inspect.isfunction(each) else ""
        text = _with_lists(_ROLE.sub(r"`\1`", inspect.getdoc(each) or ""))
        paragraphs = [f"```python\n{p}\n```" if p.startswith(">>>") else p for p in text.split("\n\n")]
        level = "###" if name.split(".")[0] != "p2wss" and "." in name else "##"
        head = f"{level} {name}\n\n" + (f"```python\n{name}{signature}\n```\n\n" if signature else "")
        parts.append(head + "\n\n".join(paragraphs) + "\n")
    return "\n".join(parts)


def _with_lists(text: str) -> str:
    """The sections of a docstring (numpydoc) as lists of Markdown."""
    parts = re.split(r"\n\n(\w+)\n-{4,}\n", f"\n\n{text}".rstrip())
    sections = zip(parts[1::2], parts[2::2], strict=True)
    return parts[0].strip() + "".join(f"\n\n**{head}**\n\n{_listed(body)}" for head, body in sections)


def _listed(body: str) -> str:
    """The items of a section, each a line with a name and perhaps a type above indented lines of text."""
    if body.startswith(">>>"):
        return body
    lines = []
    for item in re.split(r"\n(?=\S)", body):
        head, *rest = item.split("\n")
        name, _, kind = head.partition(" : ")
        text = " ".join(map(str.strip, rest))
        lines.append(f"- `{name}`" + (f", {kind}" if kind else "") + (f": {text}" if text else ""))
    return "\n".join(lines)


def _signature(function: Any) -> str:
    """The parameters of a function, one per line if they are many."""
    signature = inspect.signature(function)
    words = []
    for each in signature.parameters.values():
        if each.kind is each.KEYWORD_ONLY and "*" not in words:
            words.append("*")
        default = "" if each.default is each.empty else f" = {each.default!r}"
        words.append(
            each.name + (f": {each.annotation}" if each.annotation is not each.empty else "") + default
        )
    end = "" if signature.return_annotation is signature.empty else f" -> {signature.return_annotation}"
    line = f"({', '.join(words)}){end}"
    return line if len(line) < 70 else "(\n    " + ",\n    ".join(words) + f",\n){end}"


def _commands() -> str:
    """The help of every command."""
    parts = []
    top = click.Context(cli.program, info_name="p2wss", **cli.program.context_settings)
    for name in cli.program.list_commands(top):
        command = cli.program.get_command(top, name)
        assert command is not None
        context = click.Context(command, info_name=name, parent=top, max_content_width=100)
        context.meta[ALL_OPTIONS] = True
        parts.append(f"## {name}\n\n```text\n{command.get_help(context)}\n```\n")
        for part in command.list_commands(context) if isinstance(command, click.Group) else ():
            inner = command.get_command(context, part)
            assert inner is not None
            help_text = inner.get_help(click.Context(inner, info_name=part, parent=context))
            parts.append(f"### {name} {part}\n\n```text\n{help_text}\n```\n")
    return "\n".join(parts)
