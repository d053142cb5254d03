"""The files of the live page, listed once: no path of a request reaches the file system."""

from pathlib import Path

FOLDER = Path(__file__).parent / "page"
KINDS = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}


def page_files(folder: Path = FOLDER) -> dict[str, tuple[Path, str]]:
    """The file and the content type behind each path of the server.

    index.html of ``folder`` is "/", every other "/live/NAME"; hidden files, folders and what
    is of none of KINDS are left out.
    """
    found = {}
    for file in sorted(folder.iterdir()):
        if file.is_file() and file.suffix in KINDS and not file.name.startswith("."):
            path = "/" if file.name == "index.html" else f"/live/{file.name}"
            found[path] = (file, KINDS[file.suffix])
    return found
