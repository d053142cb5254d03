"""Where the code of pages runs: in empty folders beneath ``out``."""

import hashlib
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "out" / "docs-work"

STARTUP = """\
import atexit, os, shutil, tempfile
from pathlib import Path
folder = Path(tempfile.mkdtemp(dir={work!r}))
os.chdir(folder)
atexit.register(shutil.rmtree, folder, ignore_errors=True)
del folder
"""


def prepare() -> None:
    """Have every kernel start in an empty folder of its own."""
    startup = WORK / "ipython" / "profile_default" / "startup" / "00-folder.py"
    startup.parent.mkdir(parents=True, exist_ok=True)
    text = STARTUP.format(work=str(WORK))
    startup.write_text(text, encoding="utf-8")
    os.environ["IPYTHONDIR"] = str(WORK / "ipython")
    path = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), path] if path else [str(ROOT)])


def cache() -> str:
    """The folder of executed pages: a new one, and they run again, where the code has changed."""
    digest = hashlib.sha256()
    for folder in ("lscan", "sim", "scenes"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".toml"):
                digest.update(path.read_bytes())
    return str(ROOT / "out" / "docs-cache" / digest.hexdigest()[:12])
