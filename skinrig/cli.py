"""Command line `skinrig`: its commands, the demo and exit codes."""

import logging
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.main import get_command

from skinrig import errors, kernel_cache
from skinrig.command_line import completion, options
from skinrig.command_line.help import Command, Commands
from skinrig.command_line.options import Json, Out, Seed, option
from skinrig.commands import (
    analysing,
    capturing,
    dynamic,
    editing,
    export,
    fusing,
    importing,
    measuring,
    planning,
    reconstructing,
    rendering,
    sessions,
    showing,
    simulating,
)
from skinrig.console import Console, EscapingFormatter, escape_controls
from skinrig.next_steps import format_welcome
from skinrig.progress import beat_while_running, watch_start

app = typer.Typer(
    name="skinrig",
    cls=Commands,
    help="Capture, calibrate and reconstruct skin appearance with real or simulated rigs.",
    epilog=f"Start with: skinrig demo\n\nExit codes: {errors.EXIT_CODE_HELP}",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=True,
    rich_markup_mode=None,
)


def _version(shown: bool) -> None:
    if shown:
        from importlib.metadata import version

        typer.echo(f"skinrig {version('skinrig')}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[bool, option("Log details to stderr.", "--verbose")] = False,
) -> None:
    level = logging.INFO if verbose else logging.WARNING
    form = "%(levelname)s %(name)s: %(message)s"
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(EscapingFormatter(form))
    logging.basicConfig(handlers=[handler], level=level)
    if context.invoked_subcommand is None:
        from importlib.metadata import version as version_of

        typer.echo(format_welcome(Path(), version_of("skinrig")))


@app.command(cls=Command)
@options.command
def demo(
    out: Out = Path("demo"),
    rigs: Annotated[
        str, typer.Option(autocompletion=completion.complete_rig_list)
    ] = "flash,dome,gradient,probe",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate, calibrate, reconstruct and report all rigs at small scale; start here.

    Example: skinrig demo --out demo

    Parameters
    ----------
    rigs
        Rigs, separated by commas: flash, dome, gradient, probe.
    """
    from skinrig.demo import run_demo

    console = Console(json)
    console.print_document(
        "skinrig.demo/1", run_demo(out, rigs.split(","), seed=seed, console=console)
    )


for command in (
    sessions.verify,
    importing.photo,
    importing.diagnose,
    reconstructing.calibrate,
    reconstructing.reconstruct,
    fusing.fuse,
    measuring.bench,
    measuring.soak,
    measuring.study,
    measuring.doctor,
    rendering.render,
    editing.edit,
    showing.report,
    showing.status,
    showing.view,
    export.export,
):
    app.command(cls=Command)(command)
dynamic.fit_app.command("traits", cls=Command)(editing.fit_traits)
dynamic.fit_app.command("template", cls=Command)(reconstructing.fit_template)
dynamic.fit_app.command("reflectance", cls=Command)(reconstructing.fit_reflectance)
dynamic.fit_app.command("brdf", cls=Command)(editing.fit_brdf)
app.add_typer(simulating.simulate_app, name="simulate")
app.add_typer(capturing.capture_app, name="capture")
app.add_typer(capturing.serve_app, name="serve")
app.add_typer(sessions.session_app, name="session")
app.add_typer(planning.plan_app, name="plan")
app.add_typer(importing.import_app, name="import")
app.add_typer(dynamic.fit_app, name="fit")
app.add_typer(dynamic.apply_app, name="apply")
analysing.analyse_app.command("albedo", cls=Command)(editing.analyse_albedo)
app.add_typer(analysing.analyse_app, name="analyse")


WAITING_COMMANDS: Final = frozenset({"capture", "serve"})
"""Commands that wait for people and other programs: their steps are not reported again."""


@cache
def _build_commands() -> Any:
    """Build the tree of all commands, which takes 30 ms, once per process."""
    return get_command(app)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code; no traceback reaches the user."""
    if os.environ.get("SKINRIG_TRACEBACK"):
        _build_commands()(args=argv, standalone_mode=False)
        return errors.EXIT_DONE
    given = sys.argv[1:] if argv is None else argv
    waits = errors.find_command(given) in WAITING_COMMANDS
    try:
        with nullcontext() if waits else beat_while_running():
            result = _build_commands()(args=argv, standalone_mode=False)
    except (typer.Exit, SystemExit) as stop:
        code = getattr(stop, "exit_code", None)
        return int(code if code is not None else getattr(stop, "code", 0) or 0)
    except (typer.Abort, KeyboardInterrupt):
        return _report_failure(KeyboardInterrupt(), errors.EXIT_INTERRUPTED, given)
    except Exception as error:
        if errors.is_interruption(error):  # an import that Ctrl-C ends raises a SystemError
            return _report_failure(KeyboardInterrupt(), errors.EXIT_INTERRUPTED, given)
        if hasattr(error, "exit_code") and hasattr(error, "show"):  # a usage error of Typer's
            error.show()
            return _report_failure(error, errors.EXIT_USAGE, given, print_message=False)
        return _report_failure(error, errors.exit_code(error), given)
    if result == errors.EXIT_INTERRUPTED:  # Typer turns Ctrl-C into this code, without a word
        return _report_failure(KeyboardInterrupt(), errors.EXIT_INTERRUPTED, given)
    return int(result or 0)


def _report_failure(
    error: BaseException, code: int, arguments: Sequence[str], *, print_message: bool = True
) -> int:
    """Report why a command ended, on stderr and with --json as a document; return its code."""
    format_message = getattr(error, "format_message", None)
    if isinstance(error, KeyboardInterrupt):
        message = errors.format_interruption(arguments)
    else:
        message = (
            errors.format_error(error)
            if print_message or format_message is None
            else str(format_message())
        )
    if print_message:
        print(f"skinrig: {escape_controls(message)}", file=sys.stderr)
    # still one document only: a command prints its own last, after all that can fail
    Console("--json" in arguments).print_document(
        "skinrig.error/1",
        {"error": message, "code": errors.message_code(message), "exit_code": code},
    )
    return code


def _interrupt(number: int, frame: object) -> None:
    """End like Ctrl-C: temporary folders are removed, child processes and light end."""
    raise KeyboardInterrupt


def run() -> None:
    """Entry point of the console script."""
    signal.signal(signal.SIGTERM, _interrupt)
    kernel_cache.provide_kernel_cache(os.environ)
    watch_start("--json" in sys.argv)
    sys.exit(main())


if __name__ == "__main__":
    run()
