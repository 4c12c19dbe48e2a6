"""The command line, one module per command. A command reads files, calls its stage and writes files.

Commands are imported when they run, and import heavy modules when they run, so that ``p2wss --help`` responds at
once. Whatever decides a result belongs in the package of the stage.
"""

import gc
import importlib
import logging
import os
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from click.shell_completion import shell_complete

from p2wss import __version__
from p2wss.storage import messages
from p2wss.storage.arguments import missing_extra
from p2wss.storage.messages import InputError

# module and command have the same name
COMMANDS = {
    "Commands": {
        "demo": "reconstruct a small drawn town: a first run that needs no data",
        "reconstruct": "reconstruct buildings from your own LiDAR and footprints",
        "scene": "a place on the map as a scene for radar: fetch its data, reconstruct it",
        "view": "show buildings of any CityJSON file in 3D, in a browser",
        "explain": "why the roof of a building is as it is",
        "outlines": "derive building outlines from LiDAR, without footprints",
        "evaluate": "measure the buildings of a CityJSON file of any program against LiDAR",
        "check": "validate the solids of CityJSON files",
        "inspect": "describe the contents of files, or the inputs of a run",
        "config": "print every setting with its default",
        "workflow": "begin a project of the Snakemake workflow",
        "doctor": "show what is installed, and what is missing for what",
        "warm-up": "compile the code before the first use",
    },
    "Stages of the workflow, in its order": {
        "towns": "generate a synthetic town in IGN's file formats",
        "fetch": "get footprints, terrain and LiDAR of a region",
        "scenes": "cut tiles, clean footprints, draw roof angles",
        "buildings": "build the closed meshes of one scene",
        "scans": "simulate the LiDAR survey of one scene",
        "crops": "crop the points of each building",
        "dvae": "train the discrete VAE that tokenises point patches",
        "model": "train Point2WSS",
        "eval": "evaluate the methods and write the report",
    },
}
_COMPLETE = "_P2WSS_COMPLETE"


@contextmanager
def importing(*without: str) -> Iterator[None]:
    """Turn off garbage collection for imports in the block: they leave no garbage, and the search would take a tenth of
    the start. without: packages hidden in the block, which other packages import if they are installed, but this
    command does not need."""
    gc.disable()
    hidden = set(without) - sys.modules.keys()
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]
        gc.freeze()
        gc.enable()


class Program(click.Group):
    """The commands, which are imported when they are called."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command, imported from its module; None if there is no such command."""
        if cmd_name not in self.commands:
            return None
        name = cmd_name.replace("-", "_")
        with importing():
            return getattr(importlib.import_module(f"p2wss.cli.{name}"), name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of :data:`COMMANDS`."""
        for title, commands in COMMANDS.items():
            with formatter.section(title):
                formatter.write_dl(list(commands.items()))


@click.group(
    cls=Program,
    commands=[click.Command(name, help=text) for part in COMMANDS.values() for name, text in part.items()],
    epilog="p2wss COMMAND --help describes a command; the Snakemake workflow runs the stages. "
    "@FILE stands for arguments that are listed in a file, one per line.",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(__version__, message="p2wss %(version)s")
def program() -> None:
    """Watertight LoD2 buildings from building footprints and aerial LiDAR."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Returns the exit status: the one that the command returns, else 0; 2 for an error that the user
    can fix."""
    # numpy's matrices are small here: threads that wait for each other, spinning, only cost time
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic would look for plugins in all packages that are installed
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    words = sys.argv[1:] if arguments is None else arguments
    messages.start()
    # laspy both logs and raises errors of broken files; the exception is reported below
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # and so does GDAL
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # pyogrio reports every file that it writes
    if instruction := os.environ.get(_COMPLETE):
        return shell_complete(program, {}, "p2wss", _COMPLETE, instruction)
    try:
        try:
            with program.make_context("p2wss", with_files(words)) as ctx:
                status = program.invoke(ctx) or 0
        except click.exceptions.NoArgsIsHelpError as error:
            print(error.format_message())
            status = 0
        sys.stdout.flush()
        return status
    except click.exceptions.Exit as end:  # of --help and --version
        return end.exit_code
    except BrokenPipeError:  # whoever reads what this prints has stopped, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except (KeyboardInterrupt, SystemError) as error:
        # compiled code raises SystemError, caused by KeyboardInterrupt
        if not isinstance(error.__cause__ or error, KeyboardInterrupt):
            raise
        return _failed("interrupted", 128 + signal.SIGINT)
    except ModuleNotFoundError as error:
        return _failed(f"error: {missing_extra(error)}")
    except (InputError, click.UsageError) as error:
        return _failed(f"error: {_message(error)}")


def with_files(words: Iterable[str]) -> list[str]:
    """The arguments, with the lines of FILE in place of @FILE: Linux starts no program with more than 2 MB of
    arguments."""
    result: list[str] = []
    for word in words:
        if not word.startswith("@"):
            result.append(word)
            continue
        try:
            result += filter(None, Path(word[1:]).read_text(encoding="utf-8").splitlines())
        except (OSError, ValueError) as error:
            raise InputError(f"{word}: not a readable list of arguments: {error}") from error
    return result


def _failed(text: str, status: int = 2) -> int:
    """Say on stderr why the command ends, and return its status."""
    print(f"p2wss: {text}", file=sys.stderr)
    return status


def _message(error: InputError | click.UsageError) -> str:
    """The error in one line, with the command whose help explains the arguments."""
    if isinstance(error, InputError):
        return str(error)
    text = " ".join(error.format_message().split())
    return f"{text} (see {error.ctx.command_path} --help)" if error.ctx else text
