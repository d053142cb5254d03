"""What a build keeps beside its pages: executed pages, pictures, and folders their code runs in."""

import hashlib
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

STARTUP = """\
import atexit, os, shutil, tempfile
from pathlib import Path
folder = Path(tempfile.mkdtemp(dir={work!r}))
os.chdir(folder)
atexit.register(shutil.rmtree, folder, ignore_errors=True)
del folder
"""


def prepare(folder: Path) -> None:
    """Have every kernel start in an empty folder of its own, within the given one."""
    startup = folder / "ipython" / "profile_default" / "startup" / "00-folder.py"
    startup.parent.mkdir(parents=True, exist_ok=True)
    startup.write_text(STARTUP.format(work=str(folder)), encoding="utf-8")
    os.environ["IPYTHONDIR"] = str(folder / "ipython")
    path = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), path] if path else [str(ROOT)])


def cache(folder: Path) -> str:
    """The folder of executed pages: a new one, and they run again, where the code has changed."""
    digest = hashlib.sha256()
    for name in ("lscan", "sim", "scenes"):
        for path in sorted((ROOT / name).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(path.read_bytes())
    return str(folder / digest.hexdigest()[:12])
