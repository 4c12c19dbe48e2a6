"""How commands read their arguments: by click, with lists of files and with settings of the config as options."""

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import click

from p2wss.config import Config, Section, load
from p2wss.storage.messages import InputError

Function = TypeVar("Function", bound=Callable[..., Any])
Decorator = Callable[[Function], Function]
PATH = click.Path(path_type=Path)


class Option(click.Option):
    """An option. key: the setting that it overrides. takes_list: its values are all words up to the next option. more:
    shown only with --help-all."""

    def __init__(
        self, names: list[str], key: str = "", takes_list: bool = False, more: bool = False, **options: Any
    ):
        super().__init__(names, multiple=options.pop("multiple", takes_list), **options)
        self.key, self.takes_list, self.more = key, takes_list, more

    def process_value(self, ctx: click.Context, value: Any) -> Any:
        """The value. An option in its place is an error."""
        if isinstance(value, str) and value.startswith("--"):
            raise click.BadOptionUsage(self.opts[0], f"Option '{self.opts[0]}' requires an argument.", ctx)
        return super().process_value(ctx, value)


def _show_all(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value:
        context.meta[ALL_OPTIONS] = True
        click.echo(context.get_help())
        context.exit()


# key in a context whose help shows all options
ALL_OPTIONS = "p2wss.all_options"
_help_all = Option(
    ["--help-all"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_all,
    help="Show all options.",
)


class Command(click.Command):
    """A command. Its parameter ``config`` is the config from ``--config`` and from options for settings, on top of
    ``defaults``, the defaults of this command."""

    def __init__(self, *args: Any, defaults: dict[str, Any] | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        self.defaults = defaults or {}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments. Raises :class:`InputError` that names the setting with an invalid value."""
        options = [option for option in self.params if isinstance(option, Option)]
        rest = super().parse_args(ctx, _repeated(options, args))
        if "config" in ctx.params and not ctx.resilient_parsing:
            settings = [(option.key, ctx.params.pop(str(option.name))) for option in options if option.key]
            stated = [_document(key, value) for key, value in settings if value is not None]
            ctx.params["config"] = load(self.defaults, *ctx.params["config"], *stated)
        return rest

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters, with --help-all if the help leaves out options."""
        return super().get_params(ctx) + [_help_all] * any(
            getattr(each, "more", False) for each in self.params
        )

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options for every day; with --help-all also the others."""
        options = [option for option in self.get_params(ctx) if isinstance(option, click.Option)]
        for title, more in (("Options", False), ("More options", True))[: 1 + (ALL_OPTIONS in ctx.meta)]:
            chosen = [option for option in options if getattr(option, "more", False) == more]
            rows = [row for option in chosen if (row := option.get_help_record(ctx))]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=24)


class Group(click.Group):
    """A command that consists of parts."""

    command_class = Command

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of the parts in the order in which they run."""
        return list(self.commands)


class Names(click.ParamType):
    """A list as one word, A,B,.."""

    name = "A,B,.."

    def __init__(self, choices: Collection[str] = ()) -> None:
        self.choices = choices

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[str]:
        """The names in the list, without spaces around them."""
        return (
            value if isinstance(value, list) else [part.strip() for part in value.split(",") if part.strip()]
        )


def _pairs(value: str) -> dict[str, str]:
    """A mapping as one word, A=B,C=D,.."""
    pairs = [part.partition("=") for part in value.split(",") if part.strip()]
    return {name.strip(): content.strip() for name, _, content in pairs}


def option(*names: str, **options: Any) -> Decorator[Any]:
    """Add an :class:`Option`."""
    return click.option(*names, cls=Option, **options)


def file_option(name: str, help: str, required: bool = True, takes_list: bool = False) -> Decorator[Any]:
    """Add an option that names one file, or several if it ``takes_list``."""
    return option(name, type=PATH, help=help, required=required, takes_list=takes_list)


def setting(key: str, *names: str, more: bool = True, **options: Any) -> Decorator[Any]:
    """Add an option that overrides the setting ``key``, with the name, type, description and default of the setting.
    default: another default, if the command has one."""
    *sections, last = key.split(".")
    section: Any = Config
    for name in sections:
        section = section.model_fields[name].annotation
    field = section.model_fields[last]
    name = f"--{last.replace('_', '-')}"
    kind, default = field.annotation, options.pop("default", field.default)
    if kind is bool:
        name, default = f"{name}/--no-{name[2:]}", str(default).lower()
    elif get_origin(kind) is Literal:
        options["type"] = click.Choice(get_args(kind))
    elif get_origin(kind) is list:
        options["type"], default = Names(get_args(get_args(kind)[0])), ",".join(default)
    elif isinstance(kind, type) and issubclass(kind, Section):
        options["type"], default = _pairs, "..."
    else:
        options.setdefault("type", kind)
    help = f"{options.pop('help', field.description)} [{key}{f': {default}' if default != '' else ''}]"
    return option(*(names or [name]), key=key, more=more, default=None, help=help, **options)


def _document(key: str, value: Any) -> dict[str, Any]:
    """A config in which only ``key``, such as reconstruct.detail, is stated."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


def _repeated(options: Iterable[Option], words: Iterable[str]) -> list[str]:
    """The words in the form that click reads. Click takes one value per option: ``--shards A B`` becomes ``--shards A
    --shards B``. For an option that takes several numbers, the one word ``"A B"`` becomes several words."""
    named = {name: option for option in options for name in option.opts}
    result: list[str] = []
    current = ""
    for word in words:
        last = named.get(result[-1]) if result else None
        if last is not None and last.nargs > 1:
            result += word.replace(",", " ").split()
            continue
        before = named.get(result[-2]) if len(result) > 1 else None
        if before is not None and isinstance(before.type, Names) and word in before.type.choices:
            name, value = result[-2:]
            raise InputError(f"{name} {value} {word}: state a list as one word: {name} {value},{word}")
        if word.startswith("-"):
            current = word if word in named and named[word].takes_list else ""
        if not current:
            result.append(word)
        elif word != current:
            result += [current, word]
    return result
