"""Code shared by the commands: errors of one line, output, the compilation cache, checks of
arguments."""

from __future__ import annotations

import errno
import gc
import importlib
import os
import shlex
import signal
import stat
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from jaxba.cli.options import BAD_INPUT, Arguments, parse
from jaxba.cli.short_help import HELP_ALL
from jaxba.cli.streams import UnwritableStreamError, tolerant_streams
from jaxba.runtime.interrupt import ENDED, INTERRUPTED, Interrupt
from jaxba.typing import InputError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of a disk that is full or may not be written: no fault of the program, wherever they come
up."""

MISFIT = 3
"""Exit status of `jaxba-solve --strict` where a solution was written, and what was measured does
not fit it."""

_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
"""Write bits of a file mode; they are checked separately, since `os.access` allows root to write
without them."""


class UsageError(InputError):
    """Invalid arguments. The message is one line for the user."""


def run_command(
    arguments: type[Arguments],
    main: Callable[[Arguments], int],
    description: str,
    argv: Sequence[str] | None,
    subcommand: str = "",
    short_page: str = "",
) -> int:
    """Parses the command line and runs `main`. Expected errors, and signals that `main` does not
    handle, are one line on stderr. Returns the exit status: that of `main`, 2 after an error, 130
    after Ctrl-C, or 143 after SIGTERM.

    Args:
        arguments: class of the arguments, made by `options`, in the module that has the command's
            name.
        main: gets the parsed arguments and returns the exit status.
        description: first line of the help.
        argv: the command line; `sys.argv[1:]` if None.
        subcommand: for the help, if `argv` is without it.
        short_page: what `--help` prints, if `--help-all` prints all options."""
    words = list(sys.argv[1:] if argv is None else argv)
    with Interrupt() as interrupt, tolerant_streams():
        try:
            if words == ["--version"]:
                print_line(_versions())
                return 0
            if short_page and {"-h", "--help"} & set(words):
                print_line(short_page)
                return 0
            if short_page:
                words = ["--help" if word == HELP_ALL else word for word in words]
            program = f"jaxba-{arguments.__module__.rpartition('.')[2]} {subcommand}".strip()
            status = _run(main, parse(arguments, description, program, words))
            print(end="", flush=True)
            return interrupt.status or status if status == INTERRUPTED else status
        except (KeyboardInterrupt, Exception) as error:
            # inside libraries Ctrl-C may have become another error
            if isinstance(error, KeyboardInterrupt) or interrupt.status:
                status = interrupt.status or INTERRUPTED
                print(ENDED[status], file=sys.stderr)
                return status
            if isinstance(error, UnwritableStreamError):
                return print_error(str(error))
            raise


def _versions() -> str:
    from importlib.metadata import version

    python = ".".join(map(str, sys.version_info[:3]))
    return f"jaxba {version('jaxba')}, JAX {version('jax')}, Python {python}"


def command_line(name: str, argv: Sequence[str] | None) -> str:
    """The command as a shell takes it, in one line; `argv` as for `run_command`."""
    from jaxba.io.files import display_name

    return display_name(shlex.join([name, *(sys.argv[1:] if argv is None else argv)]))


def _run(main: Callable[[Arguments], int], parsed: Arguments | str | None) -> int:
    if parsed is None:
        return 0
    if isinstance(parsed, str):
        return print_error(parsed)
    try:
        return main(parsed)
    except InputError as error:
        return print_error(str(error))
    except Exception as error:
        from jaxba.runtime.process import missing_platform, out_of_memory

        if out_of_memory(error):
            return print_error("not enough memory")
        from jaxba.runtime.distributed import has_lost_process

        if has_lost_process(error):  # JAX would wait for it
            status = print_error("another process of this run has ended, and so does this one")
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        if missing := missing_platform():
            return print_error(
                f"JAX_PLATFORMS is {missing!r}, but JAX has no such platform on this machine: "
                "unset it, or set cpu"
            )
        if isinstance(error, OSError) and error.errno in FULL:
            return print_error(f"{error.filename or 'a file'}: {error.strerror}")
        raise


def counted(count: int, noun: str) -> str:
    """The count with the noun, in the plural unless it is one."""
    return f"{count} {noun}{'s' * (count != 1)}"


def print_error(message: str) -> int:
    """Prints an error as one line to stderr and returns the exit status for invalid input."""
    print(f"error: {message}", file=sys.stderr)
    return BAD_INPUT


def print_line(text: str) -> None:
    """Prints a line to stdout and flushes, so that it is read while the work goes on."""
    print(text, flush=True)


def misfit_status(strict: bool, misfits: int) -> int:
    """The exit status after solves with a number of notes on what does not fit, which `strict`
    tells from success."""
    if not (strict and misfits):
        return 0
    print("error: --strict: what was measured does not fit, see the notes above", file=sys.stderr)
    return MISFIT


@contextmanager
def notes_printed(output: Callable[[str], object] = print_line) -> Iterator[None]:
    """Prints the notes of what is read inside, one line each, by `output`."""
    from jaxba.io.notes import notes_to

    with notes_to(lambda note: output(f"note: {note}")):
        yield


def console(width: int = 120, **options: Any) -> Any:
    """A console of rich that breaks no lines; its tables are `width` characters wide if it is no
    terminal."""
    from rich.console import Console

    made = Console(soft_wrap=True, highlight=False, **options)
    return (
        made
        if made.is_terminal
        else Console(soft_wrap=True, highlight=False, width=width, **options)
    )


def exit_with(status: int) -> NoReturn:
    """Ends the process. From here on Ctrl-C changes nothing."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()  # else Python looks at every object once more before it ends, for 0.04 s
    sys.exit(status)


def prepare_process(*, untraced: bool = False) -> None:
    """Keeps freed memory, loads LAPACK, and keeps compiled programs: if `untraced` those that are
    compiled in parallel, which are found without tracing them (`keep_programs`), otherwise all of
    them, by JAX's own cache."""
    from jaxba.runtime import process
    from jaxba.runtime.announce import announce_nothing
    from jaxba.runtime.program_cache import keep_programs, keep_programs_by_jax

    process.keep_memory()
    announce_nothing()
    if untraced:
        keep_programs()
    else:
        keep_programs_by_jax()
    process.load_lapack()


def check_extra(module: str) -> None:
    """Raises a UsageError that names the package to install, if a module of jaxba needs one that is
    missing."""
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise UsageError(str(error)) from None


def require(fulfilled: bool, message: str) -> None:
    """Raises a UsageError with the message unless a condition is fulfilled."""
    if not fulfilled:
        raise UsageError(message)


def check_writable(option: str, path: str | None) -> None:
    """Checks that an output file can be written, before any work; None and names of streams are
    accepted. Raises UsageError: the folder is missing or not writable, the file is read-only, or
    the path is that of a folder."""
    from jaxba.io.files import STREAMS

    if path is None or path.startswith(STREAMS):
        return
    target = Path(os.path.realpath(path))  # a symbolic link is kept, and its target is written
    require(not target.is_dir(), f"{option} {path}: is a directory")
    separators = tuple(filter(None, (os.sep, os.altsep)))
    require(
        not path.endswith(separators), f"{option} {path}: is the name of a directory, not of a file"
    )
    if os.path.exists(path) and not os.path.isfile(path):  # a pipe or device is written directly
        require(os.access(path, os.W_OK), f"{option} {path}: cannot be written")
        return
    folder = target.parent if Path(path).is_symlink() else Path(path).parent
    require(target.parent.is_dir(), f"{option} {path}: folder {folder} does not exist")
    require(
        os.access(target.parent, os.W_OK), f"{option} {path}: folder {folder} cannot be written"
    )
    read_only = target.exists() and not target.stat().st_mode & _WRITABLE
    require(not read_only, f"{option} {path}: is a read-only file")


def check_folder(option: str, path: str) -> None:
    """Checks that an output folder can be created or written, before any work is done. Raises
    UsageError: it is a file or not writable, or it does not exist and its parent is missing or not
    writable."""
    target = Path(path).absolute()
    if not target.exists():
        return check_writable(option, str(Path(path)))  # without a trailing separator
    require(target.is_dir(), f"{option} {path}: is a file, not a folder")
    require(os.access(target, os.W_OK), f"{option} {path}: folder cannot be written")


def check_positive(**values: Any) -> None:
    """Checks that numbers are positive, that tolerances (names ending in `tol`) are not negative,
    and that integers are not too large for 32 bits. Values are by argument name. Raises UsageError:
    an invalid value; names the option."""
    from jaxba.typing import LARGEST_COUNT

    for name, value in values.items():
        option = "--" + name.replace("_", "-")
        if name.endswith("tol"):
            require(value >= 0, f"{option} must not be negative, is {value:g}")
            continue
        require(value > 0, f"{option} must be positive, is {value:g}")
        too_large = isinstance(value, int) and value > LARGEST_COUNT
        require(not too_large, f"{option} must be at most {LARGEST_COUNT}, is {value}")
