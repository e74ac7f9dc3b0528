"""Files of images in a folder: photos, depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxba.io.files import StrPath
from jaxba.problem.image_names import named_images


def files_of_images(folder: StrPath, names: Sequence[str], ending: str = "") -> list[Path | None]:
    """The file of each image in a folder or the folders below it, by names as `named_images`
    understands them.

    Args:
        folder: where files are.
        names: of images.
        ending: what follows the name of an image, with its own ending or without, in the name of
            its file.

    Returns:
        Files; None: there is none, or it is not clear which one."""
    found = {name: Path(folder, f"{name}{ending}") for name in names}
    lost = [name for name, file in found.items() if not file.is_file()]
    if lost:
        files = sorted(file for file in Path(folder).rglob(f"*{ending}") if file.is_file())
        called = [file.relative_to(folder).as_posix().removesuffix(ending) for file in files]
        positions = named_images(names, called).positions
        found |= {name: files[positions[name]] for name in lost if name in positions}
    return [file if file.is_file() else None for file in map(found.__getitem__, names)]
