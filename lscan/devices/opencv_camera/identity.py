"""Which camera is behind a number: the names that Linux gives to a video device.

udev links ``/dev/v4l/by-id`` to the devices by maker, model and, where the camera has one, serial
number; the kernel names the model in ``/sys/class/video4linux``.  A number says nothing: it goes to
whichever camera is plugged in first.
"""

from pathlib import Path

ROOT = Path("/")


def names_by_id(root: Path = ROOT) -> dict[Path, tuple[str, ...]]:
    """The links in /dev/v4l/by-id by the device that each leads to; {} where there are none.

    root: of the file system.
    """
    found: dict[Path, tuple[str, ...]] = {}
    for link in sorted((root / "dev/v4l/by-id").glob("*")):
        device = link.resolve()
        found[device] = (*found.get(device, ()), f"/dev/v4l/by-id/{link.name}")
    return found


def device_identity(device: int | str | None, root: Path = ROOT) -> str | None:
    """What tells a video device from others as far as this system knows; None where it does not.

    Two of one model without serial numbers are not told apart.  device: as in a rig file, None for
    what is no device.
    """
    if device is None:
        return None
    path = root / f"dev/video{device}" if isinstance(device, int) else root / device.lstrip("/")
    node = path.resolve()
    names = names_by_id(root).get(node)
    if names:
        return names[0].rpartition("/")[2]
    try:
        return (root / "sys/class/video4linux" / node.name / "name").read_text().strip() or None
    except (OSError, UnicodeDecodeError):
        return None
