"""Runs a command line and returns its exit code: 0 done, 1 internal error, 2 user error (one line), 130 interrupted.

3: the result is complete, but a part such as the report could not be written. 141: the reader of a pipe closed it
(``gs2d recipes | head -1``).
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import re
import shlex
import sys
import traceback
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

import gs2d
from gs2d.cli import layout
from gs2d.cli.command_line import NAMES
from gs2d.cli.command_registry import COMMANDS
from gs2d.cli.commands import (
    Common,
    DemoCommand,
    DoctorCommand,
    InfoCommand,
    RecipesCommand,
    ReconstructCommand,
    TrainCommand,
)
from gs2d.cli.console import Console, show_help
from gs2d.cli.interrupts import INTERRUPTED, Interruptible
from gs2d.cli.parser import HELP_WORDS, UsageError, check_inputs, parse
from gs2d.core.memory_limit import address_space, check_address_space
from gs2d.core.processes import here
from gs2d.core.text import printable
from gs2d.errors import Gs2dError

OK, EXIT_BUG, EXIT_USAGE, INCOMPLETE, NOBODY_READS = 0, 1, 2, 3, 141
_MENDABLE = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.EMFILE,
    errno.ENOMEM,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EIO,
}
_LIGHT = (RecipesCommand,)  # which load no numbers
_NO_TRAINING = (*_LIGHT, DoctorCommand, InfoCommand)  # which load torch themselves, if at all
# How torch says it on the CPU and on a GPU, how C++ does, and the loader of shared libraries.
_NO_MEMORY = re.compile(
    "can't allocate memory|out of memory|std::bad_alloc|failed to map segment|cannot allocate memory", re.IGNORECASE
)
_NO_THREAD = re.compile("can't start new thread|Resource temporarily unavailable")  # Python, the kernel


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code; prints every error on stderr."""
    try:
        if (asked := _answer(argv)) is not None:
            show_help(asked)
            return OK
        command = _of_this_process(parse(argv))
        check_inputs(command)  # before anything heavy is imported
    except BrokenPipeError:  # `gs2d train --help | head`
        _drop_stdout()
        return NOBODY_READS
    except (UsageError, Gs2dError) as error:
        return _fail(str(error)) if os.environ.get("RANK", "0") == "0" else EXIT_USAGE
    interruptible = Interruptible()
    console = Console(
        quiet=command.quiet, as_json=command.json, verbose=command.verbose, before_each=interruptible.check
    )
    try:
        if not isinstance(command, _LIGHT):
            check_address_space()
        if not isinstance(command, _NO_TRAINING):
            importlib.import_module("gs2d.pipeline.train.train_run")  # torch and all: see `interrupts`
        with interruptible:
            execute(command, console)
            console.flush()
        return _what_is_missing(console, argv, command)
    except KeyboardInterrupt:
        console.close()
        return _interrupted(argv, command) if here().leads else INTERRUPTED
    except BrokenPipeError:  # `gs2d ... | head`
        _drop_stdout()
        return NOBODY_READS
    except Exception as error:
        console.close()
        if getattr(error, "told", False):  # contact was lost to another process, and another one says why
            return EXIT_USAGE
        return _report(error, command.debug)


def execute(command: Common, console: Console) -> None:
    """Run a parsed command."""
    try:
        COMMANDS[_name_of(command)].run(command, console)
    finally:
        console.close()


def _name_of(command: Common) -> str:
    return next(name for name, options in NAMES.items() if options is type(command))


def leave(code: int) -> NoReturn:
    """End the process; what stdout still holds is written, or silently dropped if nobody reads it."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        _drop_stdout()
        code = NOBODY_READS if isinstance(error, BrokenPipeError) else code or _report(error, debug=False)
    if code and os.environ.get("WORLD_SIZE", "1") != "1":  # threads that still talk to processes that are gone
        os._exit(code)
    sys.exit(code)


def _drop_stdout() -> None:
    """Drop what cannot be written, so that Python does not try again when it shuts down."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _answer(argv: Sequence[str]) -> list[str] | None:
    """Return what is printed where nothing is done: help and the version; None where a command is asked for."""
    from gs2d.cli import help as helps

    words = list(argv)
    if not words:
        return helps.first_day()
    if words[0] == "help":
        words = [*words[1:], "--help"]
    if "--version" in words or words[0] in ("version", "-V"):
        return [f"gs2d {gs2d.__version__}"]
    asked = [word for word in words if word in HELP_WORDS]
    if not asked:
        return None
    everything = "--help-all" in asked
    if words[0] in NAMES:
        return helps.command_help(words[0], everything=everything)
    if words[0] in HELP_WORDS:
        return helps.program_help(everything=everything)
    return None


def _of_this_process(command: Common) -> Common:
    """Return the command as this process of several does it: process 0 alone prints.

    Raises
    ------
    UsageError
        It is for one process.
    """
    place = here()
    if place.size > 1 and not isinstance(command, TrainCommand):
        raise UsageError(f"gs2d {_name_of(command)} runs in one process, got {place.size}; gs2d train is for torchrun")
    return command if place.leads else replace(command, quiet=True, json=False)


def _fail(message: str) -> int:
    _complain(f"error: {' '.join(message.split())}")
    return EXIT_USAGE


def _complain(text: str) -> None:
    """Print a line on stderr; a terminal gets lines that break between words."""
    screen, text = sys.stderr is not None and sys.stderr.isatty(), printable(text)
    for line in layout.message(text, layout.terminal_width()) if screen else [text]:
        print(line, file=sys.stderr)


def _trace(error: BaseException) -> None:
    print(printable("".join(traceback.format_exception(error)), lines=True), end="", file=sys.stderr)


def _report(error: Exception, debug: bool) -> int:
    """Print an error; the exit code says whose it is."""
    if debug:
        _trace(error)
    if isinstance(error, Gs2dError):
        return _fail(str(error))
    if isinstance(error, OSError) and error.errno in _MENDABLE:
        return _fail(f"{error.strerror}: {error.filename or 'no file named'}; mend that and run the command again")
    said = str(error) if isinstance(error, RuntimeError | ImportError | OSError) else ""
    no_thread = _NO_THREAD.search(said)
    if isinstance(error, MemoryError) or no_thread or _NO_MEMORY.search(said):
        if (limit := address_space()) is not None:
            return _fail(f"out of memory: the address space is limited to {limit / 2**30:.2f} GiB; raise ulimit -v")
        if no_thread:
            return _fail("cannot start more threads or processes; raise ulimit -u, or use fewer --threads")
        return _fail("out of memory; use a larger --downscale, or fewer splats (--set STAGE.densify.max_splats=N)")
    text = " ".join(str(error).split()) or "no message"
    hint = "" if debug else "; run again with --debug and report it with the traceback"
    _complain(f"fault in gs2d: {type(error).__name__}: {text[:500]}{hint}")
    return EXIT_BUG


def _what_is_missing(console: Console, argv: Sequence[str], command: Common) -> int:
    """Print what a finished command could not make and how to make it; 0 where that is nothing."""
    for event in console.missing:
        if command.debug and event.error is not None:
            _trace(event.error)
        line = f"not made: {event.what}"
        if console.quiet:  # nobody has read why
            line += f" ({event.reason})"
        again = _resumed(argv) if event.command is None else event.command
        if again and sys.stderr is not None and sys.stderr.isatty():
            _complain(f"{line}; again:")
            print(printable(again), file=sys.stderr)  # whole, to be copied
        else:
            _complain(f"{line}; again: {again}" if again else line)
    return INCOMPLETE if console.missing else OK


def _resumed(argv: Sequence[str]) -> str:
    """Return the same command, that goes on."""
    words = [word for word in argv if word not in ("--resume", "--overwrite")]
    return f"gs2d {shlex.join([*words, '--resume'])}"


def _interrupted(argv: Sequence[str], command: Common) -> int:
    line = "interrupted"
    if isinstance(command, TrainCommand | DemoCommand | ReconstructCommand):
        trained = any((command.out / "checkpoints").glob("*.pt"))
        found = isinstance(command, ReconstructCommand) and (command.out / "capture").exists()
        if trained or isinstance(command, ReconstructCommand):  # which starts where there is nothing yet
            kept = "the cameras are kept; " if found else _search(command)
            line += f"; {'' if trained else kept}resume with: {_resumed(argv)}"
        else:
            line += "; nothing was kept, because training had not begun"
    print(printable(line + command.after_interrupt(argv)), file=sys.stderr)
    return INTERRUPTED


def _search(command: TrainCommand | DemoCommand | ReconstructCommand) -> str:
    """Return what a search for cameras that was interrupted leaves, in words."""
    from gs2d.sfm.search import SEARCH
    from gs2d.sfm.workspace import hidden_workspace

    if (hidden_workspace(command.out / "capture") / SEARCH).exists():
        return "what was found of the cameras is kept; "
    return "nothing was kept, as no camera was found; "
