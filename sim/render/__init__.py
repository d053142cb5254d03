"""The renderer: meshes, materials, integrators and the backend they run on."""

from contextlib import suppress

from lscan.devices.signals import stop_signals_held

# A signal that interrupts the import of Mitsuba's libraries ends in SIGABRT at the program's end.
# Where they are missing or do not load, whoever needs them says so.
with stop_signals_held(), suppress(Exception):
    import mitsuba  # noqa: F401
