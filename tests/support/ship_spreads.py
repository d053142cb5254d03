"""Write the tables of scattered light that are shipped: ``make tables``.

    python tests/support/ship_spreads.py

One file for each water of ``scenes``, in ``sim/water/spreads``; those of waters that no scene has
any more are removed.  Some minutes: a table takes up to 81 s of a core.
"""

from collections.abc import Iterator
from pathlib import Path
from zipfile import ZIP_LZMA, ZipFile

import numpy as np
from places import SCENES

from lscan.config.rig import load_rig
from lscan.records import Floats
from sim.render.spreads import KEPT, MOST_PHOTONS, SEED, make_spread, shipped_file
from sim.scene import scene_of
from sim.water import Optics, water_optics

FOLDERS = ("paper", "best", "waters", "targets")
NO_RIGS = ("rig.toml", "calibration-board.toml")
# The largest value of a table, ln of a distance's irradiance, is 10: rounding is 0.06 % of the
# irradiance at most, a fifth of the tables' standard error.
BITS = 13


def shipped_waters() -> Iterator[Optics]:
    """The waters of the scenes in FOLDERS, some of them several times."""
    for folder in FOLDERS:
        for file in sorted((SCENES / folder).glob("*.toml")):
            if file.name not in NO_RIGS:
                tank = scene_of(load_rig(file)).tank
                yield water_optics(tank.water, tank.laser.wavelength_nm)


def main() -> None:
    """Write what is missing, remove what no scene needs."""
    wanted = set()
    for water in shipped_waters():
        file = Path(str(shipped_file(water)))
        file.parent.mkdir(exist_ok=True)
        wanted.add(file)
        if not file.exists():
            spread = make_spread(water, MOST_PHOTONS, SEED)
            write(file, {name: getattr(spread, name) for name in KEPT})
            print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB", flush=True)
    for file in set(next(iter(wanted)).parent.glob("*.npz")) - wanted:
        file.unlink()


def write(file: Path, tables: dict[str, Floats]) -> None:
    """Write tables as NumPy's archive of single precision, rounded and compressed."""
    with ZipFile(file, "w", ZIP_LZMA) as archive:
        for name, table in tables.items():
            mantissa, exponent = np.frexp(table)
            rounded = np.ldexp(np.round(mantissa * 2**BITS) / 2**BITS, exponent)
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, rounded.astype(np.float32), allow_pickle=False)


if __name__ == "__main__":
    main()
