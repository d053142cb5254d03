"""What the plane maps of this package share: a record that is its file, and a solver's frame."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Generic, TypeVar, cast

from pydantic import PrivateAttr

from lscan.calibration.api import NOTHING_KNOWN
from lscan.calibration.evaluate import Estimator, lack_of_fit_mm, to_points
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.records import BoardReading, Floats, PlanePoints


class SolvedMap(Strict):
    """Base of the plane maps: the fields are what a calibration file holds of one.

    A subclass gives ``estimate``, ``region`` and ``lack_of_fit_mm`` (evaluate.Estimator).
    """

    _name: str = PrivateAttr("")

    @property
    def name(self) -> str:
        """Full name, family and variant."""
        return self._name

    def to_plane(self: Estimator, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm in the plane frame, of pixels, as api.PlaneMap promises.

        sigma_mm combines the pixel's uncertainty, that of the map's parameters, and the map's
        mean lack of fit.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        sigma_px : (N,) array, optional, px, standard uncertainty of u and of v; 0 by default

        Raises
        ------
        InputError
            For arrays of wrong shape, and for a bad sigma_px.
        """
        return to_points(self, image_px, sigma_px)

    def parameters(self) -> dict[str, Any]:
        """The fields as JSON types."""
        dumped: dict[str, Any] = self.model_dump(mode="json")
        return dumped


Solved = TypeVar("Solved", bound=SolvedMap)


class MapSolver(ABC, Generic[Solved]):
    """Base of the solvers of one family of maps.

    Attributes
    ----------
    family : str, first part of a map's name
    model : type, of the map
    what : str, the family in words, for messages
    variants : tuple of str, second parts there are
    allowed : str, the names there are in words, for messages
    """

    family: ClassVar[str]
    model: type[Solved]
    what: ClassVar[str]
    variants: ClassVar[tuple[str, ...]] = ("",)
    allowed: ClassVar[str]

    def check_variant(self, variant: str) -> None:
        """Refuse a variant that there is not; nothing is solved.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none

        Raises
        ------
        InputError
            For a variant that there is not.
        """
        self._require(variant)

    def _require(self, variant: str) -> None:
        if variant not in self.variants:
            raise InputError(
                f"no such {self.what}",
                where="plane map",
                value=full_name(self.family, variant),
                allowed=self.allowed,
            )

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Solved:
        """The map fitted to the marks that were found.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, second part of the map's name, "" where there is none
        optics : OpticsSection, what is known of the camera beforehand

        Raises
        ------
        InputError
            For an unknown variant.
        BoardNotFound
            Where the marks found do not determine the map.
        """
        self.check_variant(variant)
        return self._named(self.fit(reading, variant, optics), variant)

    @abstractmethod
    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Solved:
        """As ``solve``, of a variant that there is.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, one of ``variants``
        optics : OpticsSection, what is known of the camera beforehand
        """

    def restore(self, variant: str, parameters: dict[str, Any]) -> Solved:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, second part of the map's name, "" where there is none
        parameters : dict, as ``SolvedMap.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        self._require(variant)
        read = check(self.model, parameters, where=None, prefix="parameters")
        return self._named(read, variant)

    def _named(self, solved: Solved, variant: str) -> Solved:
        solved._name = full_name(self.family, variant)
        return solved


def with_lack_of_fit(solved: Solved, reading: BoardReading) -> Solved:
    """The map with the lack of fit that the marks of a reading show.

    Parameters
    ----------
    solved : SolvedMap, with an ``estimate``
    reading : BoardReading, px and mm, the map was solved from
    """
    lack_mm = lack_of_fit_mm(cast(Estimator, solved), reading)
    return solved.model_copy(update={"lack_of_fit_mm": lack_mm})


def full_name(family: str, variant: str) -> str:
    """The full name of a map.

    Parameters
    ----------
    family, variant : str, its two parts; the second may be ""

    Examples
    --------
    >>> full_name("polynomial", "3"), full_name("projective", "")
    ('polynomial-3', 'projective')
    """
    return f"{family}-{variant}" if variant else family
