"""What a surface was made from: as it is found, and as files have it."""

import hashlib
import json
from typing import Annotated

from pydantic import Field

from lscan.calibration.planemap import PlaneMap
from lscan.camera.optics import stated_water
from lscan.config.documents import Strict
from lscan.config.plugins import with_package
from lscan.config.rig import Rig
from lscan.records import Provenance


class StoredProvenance(Strict):
    """As records.Provenance, in a file."""

    rig: str
    pictures: Annotated[int, Field(ge=1)]
    extractor: str
    plane_map: str
    calibration_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    def provenance(self) -> Provenance:
        """As the program holds it."""
        return Provenance(**self.model_dump(include=set(StoredProvenance.model_fields)))


def provenance_of(rig: Rig, pictures: int, plane_map: PlaneMap) -> Provenance:
    """What a surface of a run's pictures is made from.

    Parameters
    ----------
    rig : Rig, the pictures were taken with
    pictures : int, their number
    plane_map : PlaneMap, of the rig's camera, as calibrated
    """
    since = rig.since_calibration
    carried_by = [stated_water(rig.optics), since and since.model_dump(mode="json")]
    content = json.dumps([plane_map.name, plane_map.parameters(), carried_by], sort_keys=True)
    return Provenance(
        rig=rig.name,
        pictures=pictures,
        extractor=with_package("lscan.extractors", rig.stripe.extractor),
        plane_map=with_package("lscan.planemaps", plane_map.name),
        calibration_sha256=hashlib.sha256(content.encode()).hexdigest(),
    )
