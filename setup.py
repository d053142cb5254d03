"""What pyproject.toml cannot say: the scenes lie beside the packages, and in a wheel within lscan.

``lscan.config.scenes`` finds them in both places.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithScenes(build_py):
    """Builds the packages, and puts the scenes into lscan."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "lscan" / "scenes"
            shutil.copytree("scenes", target, dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithScenes})
