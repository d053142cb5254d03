"""What a NetCDF file of ours must not have, as strangers' programs stumble over it."""

from pathlib import Path

import h5py

HIDDEN = {"REFERENCE_LIST", "DIMENSION_LIST"}
"""Attributes of HDF5, not of NetCDF."""


def stumbling_blocks(path: Path) -> list[str]:
    """What NetCDF-3 does not hold, or CF does not allow: none is right.

    Strings of variable length and whole numbers of 64 bits; a coordinate with ``_FillValue``;
    an array without a name in words; a number without a unit.
    """
    found = []
    with h5py.File(path, "r") as file:
        for where, attributes in [
            ("", file.attrs),
            *((name, one.attrs) for name, one in file.items()),
        ]:
            for key in set(attributes) - HIDDEN:
                kind = attributes.get_id(key).dtype
                if kind.kind == "O" or kind in ("i8", "u8"):
                    found.append(f"{where}: {key} is {kind}")
        for name, array in file.items():
            if b"This is a netCDF dimension but" in array.attrs.get("NAME", b""):
                continue
            if array.dtype.kind == "O" or array.dtype in ("i8", "u8"):
                found.append(f"{name} is {array.dtype}")
            if array.is_scale and "_FillValue" in array.attrs:
                found.append(f"{name}: a coordinate with _FillValue")
            needed = {"long_name", "units"} if array.dtype.kind == "f" else {"long_name"}
            found += [f"{name}: no {key}" for key in needed - set(array.attrs)]
    return found
