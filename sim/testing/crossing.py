"""A rule over several fields of a rig file, and how it is broken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lscan.config.documents import Document


@dataclass(frozen=True)
class Crossing:
    """A rule and how to break it.

    rule: the model's validator as ``Model.name``, or what the rule says where a driver keeps
    it.  changes: keys and their new values.  key: what the message must name; words: what it
    must say besides.  camera, track, sections: the drivers and sections of a rig it fits.
    """

    rule: str
    changes: dict[str, Any]
    key: str
    words: tuple[str, ...]
    camera: str | None = None
    track: str | None = None
    sections: dict[str, Any] = field(default_factory=dict)

    def fits(self, document: Document) -> bool:
        """Whether a rig has what the rule is about; sections: with these values in them."""
        drivers = document["camera"]["driver"], document["track"]["driver"]
        asked = self.camera or drivers[0], self.track or drivers[1]
        return drivers == asked and all(
            {**document.get(name, {}), **values} == document.get(name)
            for name, values in self.sections.items()
        )
