"""What lscan raises: one clear line that names what, where, the value and what is allowed."""

import sys


class LscanError(Exception):
    """Base of every error a user may meet; its text is one line fit for the screen.

    Examples
    --------
    >>> import lscan
    >>> try:
    ...     lscan.load_rig("paper/sandwav")
    ... except lscan.LscanError as error:
    ...     print(error)
    paper/sandwav: cannot be read: ... of that name; did you mean paper/sandwave? (allowed: ...
    """

    exit_code = 2


class InputError(LscanError):
    """A file, an image, a scene or an argument that cannot be used as it is."""

    def __init__(
        self, what: str, *, where: object = None, value: object = None, allowed: object = None
    ) -> None:
        """Build the line ``where: what (got value; allowed: allowed)``.

        What cannot be printed, as a line end in a name, is written as Python does.

        Parameters
        ----------
        what : str, what is wrong, in a few words
        where : the file and key, the command-line option or the array at fault
        value : the value at fault, shown with ``repr``
        allowed : what would have been accepted, in words
        """
        self.what, self.where, self.value, self.allowed = what, where, value, allowed
        notes = []
        if value is not None:
            notes.append(f"got {_short(value)}")
        if allowed is not None:
            notes.append(f"allowed: {allowed}")
        prefix = f"{where}: " if where is not None else ""
        suffix = f" ({'; '.join(notes)})" if notes else ""
        text = f"{prefix}{what}{suffix}"
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))


class DiskError(InputError):
    """A disk that is full or failed while it was written to: no fault of what was given."""

    exit_code = 1


class BoardNotFound(LscanError):
    """The calibration board, or enough of it, could not be found in the picture."""

    exit_code = 1


class MeasurementError(LscanError):
    """The data do not carry the measurement asked for (no wedge, no groove, too few points)."""

    exit_code = 1


class DeviceError(LscanError):
    """A camera or a track failed or refused; names device, value, unit and limit."""

    exit_code = 1


class Stopped(LscanError):
    """Work that its user stopped, by Ctrl-C or another signal that ends a program."""

    exit_code = 130  # as a shell reports SIGINT


def missing_package(error: ModuleNotFoundError) -> str:
    """What to do about a package that an import did not find, in one line.

    Parameters
    ----------
    error : ModuleNotFoundError, of the import
    """
    if error.name in sys.stdlib_module_names:
        return (
            f"needs Python's module {error.name}, which this system has not: Linux and macOS have, "
            "Windows has not; install it in WSL there"
        )
    return (
        f"needs the package {error.name}, which is not installed; "
        "what the tank needs is installed by pip install 'lscan[tank]'"
    )


def _short(value: object, limit: int = 80) -> str:
    """The value in at most ``limit`` characters, both its ends kept: a path's name is the last."""
    text = repr(value)
    if len(text) <= limit:
        return text
    tail = limit // 2
    return f"{text[: limit - 1 - tail]}…{text[-tail:]}"
