"""What an address that OpenCV cannot open as a stream answers instead."""

import urllib.error
import urllib.request
from http.client import HTTPException

LONGEST_WAIT_S = 2.0

NEEDED = (
    "needed: a stream, such as MJPEG over http (multipart/x-mixed-replace) or rtsp; look up its "
    "address in the camera's manual"
)


def unopened(url: str | None) -> str:
    """Why a stream could not be opened, in words, and what to do; asks an http address for it.

    url: None for a device or a file.
    """
    if url is None:
        return (
            "cannot be opened; check that it is there, that no other program uses it, and the "
            "name (`lscan devices` lists what is connected)"
        )
    answer = _answer(url) if url.startswith(("http://", "https://")) else None
    if answer is None:
        return (
            "cannot be opened; check that the camera is on, that it and this computer are in one "
            "network, and camera.options.url"
        )
    if answer.startswith(("multipart/", "video/")):
        return (
            f"cannot be opened, though the address answers ({answer}); look at it in a browser, "
            "and end other programs that use the camera"
        )
    return f"what the address sends is no stream of pictures ({answer}); {NEEDED}"


def ended_early(count: int) -> str:
    """What to say of an address that gave ``count`` pictures at once, and ended."""
    if count == 0:
        return f"what the address sends is no stream of pictures; {NEEDED}"
    pictures = "1 picture" if count == 1 else f"{count} pictures"
    return f"the address gave {pictures} and ended; {NEEDED}"


def _answer(url: str) -> str | None:
    """The kind of content, or the refusal, of an http address; None where none answers."""
    try:
        with urllib.request.urlopen(url, timeout=LONGEST_WAIT_S) as answer:
            return str(answer.headers.get_content_type())
    except urllib.error.HTTPError as refusal:
        return f"{refusal.code} {refusal.reason}"
    except (OSError, ValueError, HTTPException):
        return None
