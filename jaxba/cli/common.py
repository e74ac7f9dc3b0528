"""What the commands share: arguments, errors in one line, the compilation cache."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn, TypeVar

Arguments = TypeVar("Arguments")

BAD_INPUT = 2
"""Exit status for input that cannot be used."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells define it."""

CACHE_VARIABLE = "JAXBA_CACHE"
"""Environment variable: folder of compiled programs; `off` switches the cache off."""


_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
"""Bits of a mode; root may write without any."""


class UsageError(ValueError):
    """Arguments that make no sense. The message is one line for a person."""


def run_command(
    arguments: type[Arguments], main: Callable[[Arguments], int], description: str, argv: Sequence[str] | None
) -> int:
    """Parses the command line and runs `main`; every expected error becomes one line on stderr and status 2, and so
    does Ctrl-C, with status 130, where `main` does not deal with it."""
    import tyro

    print_all_names()
    try:
        parsed = tyro.cli(arguments, args=argv, description=description)
        from jaxba.damping.policy_file import PolicyFileError
        from jaxba.damping.registry import UnknownPolicyError
        from jaxba.methods.registry import UnknownMethodError
        from jaxba.problem.bundle_problem import ProblemError
        from jaxba.solver.names import SolverNameError

        names = (UnknownPolicyError, UnknownMethodError, SolverNameError)
        try:
            return main(parsed)
        except (ProblemError, UsageError, PolicyFileError, *names) as error:
            return complain(str(error))
        except Exception as error:
            from jaxba.runtime.process import out_of_memory

            if not out_of_memory(error):
                raise
            return complain("not enough memory")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def print_all_names() -> None:
    """Escapes what the encoding of stdout or stderr lacks, such as stray bytes in a file's name, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def complain(message: str) -> int:
    """Prints an error line and returns the exit status for bad input."""
    print(f"error: {message}", file=sys.stderr)
    return BAD_INPUT


def say(text: str) -> None:
    """Prints to stdout at once; where its reader has gone the work goes on, and what is said is lost."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        close_pipe()


def exit_with(status: int) -> NoReturn:
    """Ends the process after flushing; a closed pipe on stdout is no error."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        close_pipe()
    sys.exit(status)


def close_pipe() -> None:
    """Stdout, and what waits in its buffer, goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def prepare_process(*, untraced: bool = False) -> None:
    """Settings for speed: memory is kept, compiled programs are cached.

    Args:
        untraced: whether cached programs are found without tracing them (`jaxba.runtime.executable_cache`), for a
            command that runs few programs, all of them through `ParallelCompilation`; else JAX's cache is used.
    """
    from jaxba.runtime import process

    process.keep_memory()
    use_compilation_cache(untraced)


def use_compilation_cache(untraced: bool = False) -> None:
    """Keeps compiled programs in the user's cache folder, so that the next run starts at once.

    One way or the other: what JAX has read from its cache cannot be written again.
    """
    import jax

    from jaxba.datasets.bal.paths import user_cache
    from jaxba.runtime import compilation

    choice = os.environ.get(CACHE_VARIABLE, "")
    if choice.lower() == "off" or jax.config.values.get("jax_compilation_cache_dir"):
        return
    folder = Path(choice) if choice else user_cache("xla")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # a home that cannot be written costs time, nothing else
    if untraced:
        compilation.use_cache(folder)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def check_writable(option: str, path: str | None) -> None:
    """Refuses an output file that could not be written later, before any work is done.

    Raises:
        UsageError: the folder is missing or not writable, the file is read-only, or the path is a folder or ends as
            that of one.
    """
    from jaxba.io.files import STREAMS

    if path is None or path.startswith(STREAMS):
        return
    target = Path(os.path.realpath(path))  # a link stays: what it points to is written
    if target.is_dir():
        raise UsageError(f"{option} {path}: is a directory")
    if path.endswith(tuple(filter(None, (os.sep, os.altsep)))):
        raise UsageError(f"{option} {path}: is the name of a directory, not of a file")
    if os.path.exists(path) and not os.path.isfile(path):  # a pipe or device is written itself
        if not os.access(path, os.W_OK):
            raise UsageError(f"{option} {path}: cannot be written")
        return
    folder = target.parent if Path(path).is_symlink() else Path(path).parent
    if not target.parent.is_dir():
        raise UsageError(f"{option} {path}: folder {folder} does not exist")
    if not os.access(target.parent, os.W_OK):
        raise UsageError(f"{option} {path}: folder {folder} cannot be written")
    if target.exists() and not target.stat().st_mode & _WRITABLE:
        raise UsageError(f"{option} {path}: is a read-only file")


def check_folder(option: str, path: str) -> None:
    """Refuses a folder that could not be made or written to later, before any work is done.

    Raises:
        UsageError: it cannot be written or is a file, or the one that would hold it is missing or cannot be written.
    """
    target = Path(path).absolute()
    if target.exists() and not target.is_dir():
        raise UsageError(f"{option} {path}: is a file, not a folder")
    if not target.exists():
        check_writable(option, str(Path(path)))  # without a separator at its end
    elif not os.access(target, os.W_OK):
        raise UsageError(f"{option} {path}: folder cannot be written")


def check_positive(**values: Any) -> None:
    """Refuses numbers that are not positive (or, for tolerances, negative), and counts that programs cannot hold.

    Raises:
        UsageError: naming the option.
    """
    from jaxba.typing import LARGEST_COUNT

    for name, value in values.items():
        option = "--" + name.replace("_", "-")
        if name.endswith("tol"):
            if not value >= 0:
                raise UsageError(f"{option} must not be negative, is {value:g}")
        elif not value > 0:
            raise UsageError(f"{option} must be positive, is {value:g}")
        elif isinstance(value, int) and value > LARGEST_COUNT:
            raise UsageError(f"{option} must be at most {LARGEST_COUNT}, is {value}")
