"""Where compiled programs are kept between processes: in the user's cache folder, unless something
else is said."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path
from typing import Any

import jax

from jaxba.runtime.compilation import has_cache, use_cache
from jaxba.runtime.distrust import programs_folder
from jaxba.runtime.process import user_cache

VARIABLE = "JAXBA_CACHE"
"""Environment variable with the folder of compiled programs; `off`: none are kept."""

_is_chosen = False  # whether this process keeps programs, or was told not to


def keep_programs(folder: str | os.PathLike[str] | None = None) -> None:
    """Keeps compiled programs on disk, where `solve` of this process and of later ones finds them
    without tracing them.

    The commands and `jaxba.bundle_adjustment` do that by themselves. Where JAX's own compilation
    cache is on (`jax_compilation_cache_dir`), that one is used instead, and nothing changes.
    Programs are native code: the folder must be one that nobody else writes to.

    Args:
        folder: where they are kept; `off`: nowhere. None: as the environment variable JAXBA_CACHE
            says, else in the user's cache folder.

    A folder that cannot be written keeps nothing, and is no error."""
    global _is_chosen
    _is_chosen = True
    use_cache(_folder(folder))


def keep_programs_by_default() -> None:
    """`keep_programs`, unless this process has chosen already."""
    if not _is_chosen:
        keep_programs()


def programs_are_kept() -> bool:
    """Whether this process keeps programs on disk by `keep_programs`."""
    return has_cache()


def keep_programs_by_jax() -> None:
    """Lets JAX's own cache keep the programs, which excludes `keep_programs`. It has also those
    that are compiled one by one, but every process traces them anew."""
    folder = _folder(None)
    if folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    _remove_damaged_programs(folder)


def _folder(asked: str | os.PathLike[str] | None) -> Path | None:
    """The folder for programs of this kind of machine; None: nothing is kept, or JAX's own cache is
    on."""
    choice = os.fspath(asked) if asked is not None else os.environ.get(VARIABLE, "")
    if choice.lower() == "off" or jax.config.values.get("jax_compilation_cache_dir"):
        return None
    try:
        return programs_folder(Path(choice) if choice else user_cache("xla"))
    except OSError:
        return None  # without a writable folder it only takes longer


def _remove_damaged_programs(folder: Path) -> None:
    """From now on removes cached programs that JAX cannot read: it neither replaces them nor stops
    to warn of them.

    A process that is killed while it writes one, or a full disk, leaves a part of it (JAX 0.12)."""
    shown = warnings.showwarning

    def show(message: Warning | str, *where: Any, **named: Any) -> None:
        damaged = re.match(
            r"Error reading persistent compilation cache entry for '([\w.-]+)'", str(message)
        )
        if damaged is None:
            return shown(message, *where, **named)
        for entry in folder.glob(f"{damaged[1]}-*"):
            entry.unlink(missing_ok=True)

    warnings.showwarning = show
