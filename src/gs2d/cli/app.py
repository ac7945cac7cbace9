"""Runs a command line and returns its exit code.

0: done. 1: internal error. 2: user error (one line). 3: the result is complete, but a part such as the report could
not be written. 130: interrupted. 141: the reader of a pipe closed it (``gs2d recipes | head -1``).
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
from gs2d.cli.command_line import NAMES, command_help, program_help
from gs2d.cli.commands import COMMANDS, Common, DoctorCommand, InfoCommand, RecipesCommand, TrainCommand
from gs2d.cli.console import Console, show_help
from gs2d.cli.interrupts import INTERRUPTED, Interruptible
from gs2d.cli.parser import HELP_WORDS, UsageError, check_inputs, parse
from gs2d.config.registry import origin_of
from gs2d.core.memory_limit import address_space
from gs2d.core.processes import process_rank
from gs2d.core.text import printable
from gs2d.errors import Gs2dError
from gs2d.pipeline.prepare.options import HowItRuns

OK, EXIT_BUG, EXIT_USAGE, INCOMPLETE, PIPE_CLOSED = 0, 1, 2, 3, 141
_USER_ERRORS = frozenset(
    getattr(errno, name)
    for name in ("ENOSPC EDQUOT EFBIG EACCES EPERM EROFS EMFILE ENOMEM ENAMETOOLONG ELOOP ENOTDIR EISDIR EIO".split())
)
_WITHOUT_TRAINING = (RecipesCommand, DoctorCommand, InfoCommand)  # import torch themselves, if at all
# Messages of torch on the CPU and on a GPU, of C++, and of the loader of shared libraries.
_NO_MEMORY = re.compile(
    "can't allocate memory|out of memory|std::bad_alloc|failed to map segment|cannot allocate memory", re.IGNORECASE
)
_NO_THREAD = re.compile("can't start new thread|Resource temporarily unavailable")  # Python, the kernel


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code; prints every error on stderr."""
    try:
        if (lines := _help_or_version(argv)) is not None:
            show_help(lines)
            return OK
        command = _for_this_process(parse(argv))
        check_inputs(command)  # before anything heavy is imported
    except BrokenPipeError:  # `gs2d train --help | head`
        _drop_stdout()
        return PIPE_CLOSED
    except (UsageError, Gs2dError) as error:
        return _fail(str(error)) if os.environ.get("RANK", "0") == "0" else EXIT_USAGE
    interruptible = Interruptible()
    console = Console(
        quiet=command.quiet, as_json=command.json, verbose=command.verbose, before_each=interruptible.check
    )
    try:
        if not isinstance(command, _WITHOUT_TRAINING):
            importlib.import_module("gs2d.pipeline.train.train_run")  # with torch: see `interrupts`
        with interruptible:
            execute(command, console)
            console.flush()
        return _report_missing(console, argv, command)
    except KeyboardInterrupt:
        console.close()
        if process_rank().leads:
            line = f"interrupted; resume with: {_resumed(argv)}" if isinstance(command, HowItRuns) else "interrupted"
            _print_error(line)
        return INTERRUPTED
    except BrokenPipeError:  # `gs2d ... | head`
        _drop_stdout()
        return PIPE_CLOSED
    except Exception as error:
        console.close()
        if getattr(error, "reported", False):  # lost contact to another process, which reports the reason
            return EXIT_USAGE
        return _report(error, command.verbose)


def execute(command: Common, console: Console) -> None:
    """Run a parsed command."""
    try:
        COMMANDS[_name_of(command)].run(command, console)
    finally:
        console.close()


def _name_of(command: Common) -> str:
    return next(name for name, options in NAMES.items() if options is type(command))


def leave(code: int) -> NoReturn:
    """End the process, after writing the rest of stdout, or dropping it if the pipe is closed."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        _drop_stdout()
        code = PIPE_CLOSED if isinstance(error, BrokenPipeError) else code or _report(error, verbose=False)
    if code and os.environ.get("WORLD_SIZE", "1") != "1":  # threads may still talk to processes that have ended
        os._exit(code)
    sys.exit(code)


def _drop_stdout() -> None:
    """Redirect stdout to nothing, so that Python does not write again at shutdown."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _help_or_version(argv: Sequence[str]) -> list[str] | None:
    """Return the lines of help or version, or None if a command is to run."""
    words = list(argv)
    if not words:
        return program_help()
    if words[0] == "help":
        words = [*words[1:], "--help"]
    if "--version" in words or words[0] in ("version", "-V"):
        return [f"gs2d {gs2d.__version__}"]
    requested = [word for word in words if word in HELP_WORDS]
    everything = "--help-all" in requested
    if requested and words[0] in NAMES:
        return command_help(words[0], everything=everything)
    if requested and words[0] in HELP_WORDS:
        return program_help(everything=everything)
    return None


def _for_this_process(command: Common) -> Common:
    """Return the command for this process; of several processes only the first prints.

    Raises UsageError if the command cannot run in several processes.
    """
    place = process_rank()
    if place.size > 1 and not isinstance(command, TrainCommand):
        raise UsageError(f"gs2d {_name_of(command)} runs in one process, got {place.size}; gs2d train is for torchrun")
    return command if place.leads else replace(command, quiet=True, json=False)


def _fail(message: str) -> int:
    _print_error(f"error: {' '.join(message.split())}")
    return EXIT_USAGE


def _print_error(text: str) -> None:
    """Print a line on stderr."""
    print(printable(text), file=sys.stderr)


def _print_traceback(error: BaseException) -> None:
    print(printable("".join(traceback.format_exception(error)), lines=True), end="", file=sys.stderr)


def _report(error: Exception, verbose: bool) -> int:
    """Print an error and return its exit code."""
    if isinstance(error, Gs2dError):
        return _fail(str(error))
    if verbose:
        _print_traceback(error)
    if isinstance(error, OSError) and error.errno in _USER_ERRORS:
        return _fail(f"{error.strerror}: {error.filename or 'no file named'}; fix that and run the command again")
    message = str(error) if isinstance(error, RuntimeError | ImportError | OSError) else ""
    no_thread = _NO_THREAD.search(message)
    if isinstance(error, MemoryError) or no_thread or _NO_MEMORY.search(message):
        if (limit := address_space()) is not None:
            return _fail(f"out of memory: the address space is limited to {limit / 2**30:.2f} GiB; raise ulimit -v")
        if no_thread:
            return _fail("cannot start more threads or processes; raise ulimit -u, or use fewer --threads")
        return _fail("out of memory; use a larger --downscale, or fewer splats (--set STAGE.densify.max_splats=N)")
    text = " ".join(str(error).split()) or "no message"
    hint = "" if verbose else "; run again with --verbose and report it with the traceback"
    _print_error(f"fault in {origin_of(error)}: {type(error).__name__}: {text[:500]}{hint}")
    return EXIT_BUG


def _report_missing(console: Console, argv: Sequence[str], command: Common) -> int:
    """Print missing results of a finished command and the commands that write them; return the exit code."""
    for event in console.missing:
        if command.verbose and event.error is not None:
            _print_traceback(event.error)
        line = f"not made: {event.what}"
        if console.quiet:  # the reason was not printed
            line += f" ({event.reason})"
        again = _resumed(argv) if event.command is None else event.command
        _print_error(f"{line}; again: {again}" if again else line)
    return INCOMPLETE if console.missing else OK


def _resumed(argv: Sequence[str]) -> str:
    """Return the command line that continues this one."""
    words = [word for word in argv if word not in ("--resume", "--overwrite")]
    return f"gs2d {shlex.join([*words, '--resume'])}"
