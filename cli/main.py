"""The command `grr-torch`."""

from __future__ import annotations

import itertools
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from grr_torch.cli.bench import app as bench
from grr_torch.cli.build import build
from grr_torch.cli.catalogue import catalogue
from grr_torch.cli.eval_ik import eval_ik
from grr_torch.cli.export import export
from grr_torch.cli.export_ik import export_ik
from grr_torch.cli.info import info
from grr_torch.cli.plan import plan
from grr_torch.cli.robots import robots
from grr_torch.cli.smm import smm
from grr_torch.cli.solve import solve
from grr_torch.cli.spheres import spheres
from grr_torch.cli.sweep import sweep
from grr_torch.cli.teleop import teleop
from grr_torch.cli.train_ik import train_ik
from grr_torch.cli.view import view

from grr_torch.version import __version__

app = typer.Typer(
    name="grr-torch",
    help="Global redundancy resolution roadmaps: one smooth, repeatable, checked configuration for every pose.\n\n"
    "Start with: grr-torch build --robot kinova",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
for command in (
    robots,
    build,
    info,
    view,
    solve,
    plan,
    teleop,
    smm,
    spheres,
    export,
    train_ik,
    export_ik,
    eval_ik,
    sweep,
    catalogue,
):
    app.command()(command)
app.add_typer(bench)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"grr-torch {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: What follows the program's name; by default what the process was given.
    """
    # asked to end, it ends as by Ctrl-C: nothing is left half written
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app(join_numbers(list(sys.argv[1:] if arguments is None else arguments)), prog_name="grr-torch")


# options that take as many numbers as follow, first those of commands that take no file beside options
_WITHOUT_FILE = ("--bounds", "--rotation", "--axis")
_OF_NUMBERS = (*_WITHOUT_FILE, "--point", "--start", "--goal", "--start-configuration", "--goal-configuration")
# what a file's name has in it, and no number
_FILE = re.compile(r"/|\.[A-Za-z]\w*$")


def join_numbers(arguments: list[str]) -> list[str]:
    """Puts the numbers after --bounds, --point and their like into one argument: typer takes a fixed number else.

    The first of them may stand behind an equals sign.

    Words that were to be numbers are among them, so that the error names the option.
    """
    joined: list[str] = []
    position = 0
    while position < len(arguments):
        option, equals, first = arguments[position].partition("=")
        position += 1
        words = [first] if equals else []
        if option in _OF_NUMBERS and " " not in first:
            belongs = _is_no_option if option in _WITHOUT_FILE else _is_no_file
            more = list(itertools.takewhile(belongs, arguments[position:]))
            position += len(more)
            words += more
        joined.append(f"{option}={' '.join(words)}" if words else option)
    return joined


def _is_no_option(word: str) -> bool:
    """Whether a word is none that starts another option, nor several numbers in one word."""
    return not word.startswith("--") and " " not in word


def _is_no_file(word: str) -> bool:
    """Whether it is no option, and no file either."""
    return _is_a_number(word) or (_is_no_option(word) and not _FILE.search(word) and not os.path.isfile(word))


def _is_a_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


if __name__ == "__main__":
    run()
