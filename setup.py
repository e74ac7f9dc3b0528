"""Puts copies of `configs/` into the wheel, where an installed jaxba finds them. All else is in
pyproject.toml."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

FILES = sorted(Path("configs").glob("*/*.yaml"))
"""As `jaxba/settings/configurations.py` looks for them: configs/KIND/NAME.yaml."""


class BuildWithConfigs(build_py):
    """Copies the package and its configurations."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return  # they are read where they lie
        for file in FILES:
            target = Path(self.build_lib, "jaxba", file)
            self.mkpath(str(target.parent))
            self.copy_file(str(file), str(target))

    def get_source_files(self) -> list[str]:
        """What a source distribution holds."""
        return [*super().get_source_files(), *map(str, FILES)]


setup(cmdclass={"build_py": BuildWithConfigs})
