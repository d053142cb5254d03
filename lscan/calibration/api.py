"""What a plane map is, and how one is found by name.

A solver is registered under the entry-point group ``lscan.planemaps``.  A map's full name is
the solver's name and, after a hyphen, its variant: ``graticule-2-norulers`` is solved by
``graticule`` with the variant ``2-norulers``, ``projective`` by ``projective`` with "".
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from lscan.config.plugins import find_plugin
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Floats, PlanePoints

NOTHING_KNOWN = OpticsSection()


@runtime_checkable
class PlaneMap(Protocol):
    """A solved map from the picture to the laser sheet.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> plane_map = lscan.load_calibration("calibration.json").plane_map
    >>> points = plane_map.to_plane(np.array([[320.0, 240.0]]), sigma_px=np.array([0.1]))
    >>> points.xz_mm.shape, points.status.tolist()
    ((1, 2), [0])
    """

    @property
    def name(self) -> str:
        """Full name, solver and variant."""
        ...

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm in the plane frame, of pixels; vectorised over N.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        sigma_px : (N,) array, optional, px, standard uncertainty of each pixel coordinate; 0 by
            default

        Returns
        -------
        PlanePoints
            Its uncertainty combines that of the pixels with that of the map.  A pixel that is NaN
            has no value and the status NO_DATA (only the caller knows why it is NaN); one outside
            the covered region (region.py) has the status OUT_OF_BOARD and no number.

        Raises
        ------
        InputError
            For arrays of wrong shape, and for a sigma_px that is negative or NaN beside a pixel
            that is neither.
        """
        ...

    def parameters(self) -> dict[str, Any]:
        """What the map is made of, in plain JSON types; ``restore`` takes it back."""
        ...


class PlaneMapSolver(Protocol):
    """Solves plane maps of one family.

    One with a method ``check_variant(variant)``, which raises the InputError of ``solve`` for an
    unknown variant without data, has a rig file that asks for it refused before the scan.

    One whose search is long may have a method ``near(solved)``: the solver that begins it at a map
    of almost the same marks.  Cross-validation then begins each solution at that from all marks.
    """

    def solve(self, reading: BoardReading, variant: str, optics: OpticsSection) -> PlaneMap:
        """The map fitted to the marks that were found.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, second part of the map's name, "" where there is none
        optics : OpticsSection, what is known of the camera beforehand; a solver may do without

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            For too few marks.
        """
        ...

    def restore(self, variant: str, parameters: dict[str, Any]) -> PlaneMap:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none
        parameters : dict, as ``PlaneMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        ...


@dataclass(frozen=True)
class NamedSolver:
    """A solver together with the full name it was asked for.

    Attributes
    ----------
    name : str, full name of the map, family and variant
    solver : PlaneMapSolver, of the family
    variant : str, second part of the name, "" where there is none
    """

    name: str
    solver: PlaneMapSolver
    variant: str

    @property
    def searches(self) -> bool:
        """Whether the solver can begin its search at another map."""
        return hasattr(self.solver, "near")

    def near(self, solved: PlaneMap) -> "NamedSolver":
        """The solver of this name that begins its search at a map of almost the same marks.

        Parameters
        ----------
        solved : PlaneMap, of this name

        Raises
        ------
        AttributeError
            Where it cannot (``searches``).
        """
        return replace(self, solver=self.solver.near(solved))  # type: ignore[attr-defined]

    def solve(self, reading: BoardReading, optics: OpticsSection | None = None) -> PlaneMap:
        """The map of this name fitted to a reading.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        optics : OpticsSection, optional, what is known of the camera beforehand; by default what an
            empty section says

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            For too few marks.
        """
        return self.solver.solve(reading, self.variant, optics or NOTHING_KNOWN)

    def bare(self, reading: BoardReading, optics: OpticsSection | None = None) -> PlaneMap:
        """The map of this name, its uncertainty left out where that saves time.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        optics : OpticsSection, optional, as ``solve``

        Raises
        ------
        InputError, BoardNotFound
            As ``solve``.
        """
        quick = getattr(self.solver, "bare", self.solver.solve)
        solved: PlaneMap = quick(reading, self.variant, optics or NOTHING_KNOWN)
        return solved

    def restore(self, parameters: dict[str, Any]) -> PlaneMap:
        """The map of this name that parameters came from.

        Parameters
        ----------
        parameters : dict, as ``PlaneMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        return self.solver.restore(self.variant, parameters)


def find_solver(name: str) -> NamedSolver:
    """The solver for a full map name.

    Parameters
    ----------
    name : str, family and, after a hyphen, variant

    Raises
    ------
    InputError
        For an unknown family; it lists those there are.

    Examples
    --------
    >>> find_solver("graticule-2-norulers").variant
    '2-norulers'
    """
    family, _, variant = name.partition("-")
    return NamedSolver(name, find_plugin("lscan.planemaps", family, where="plane map"), variant)
