"""Rules of a rig file over several of its fields, and how each is broken: crossings.toml."""

from dataclasses import dataclass

from lscan.config.documents import Document, merge
from lscan.files.disk import packaged_table


@dataclass(frozen=True)
class CrossRule:
    """A rule and how to break it.

    rule: the model's validator as ``Model.name``, or a sentence where a driver checks it.
    rig: what a rig must contain for the rule to apply.  changes: dotted keys and their new
    values.  key: what the message must name; words: what else it must say.
    """

    rule: str
    rig: Document
    changes: Document
    key: str
    words: tuple[str, ...]

    def fits(self, document: Document) -> bool:
        """Whether a rig contains what the rule applies to."""
        return merge(document, self.rig) == document


CROSSINGS = tuple(
    CrossRule(rule["rule"], rig, rule["changes"], rule["key"], tuple(rule["words"]))
    for rule in packaged_table("sim.testing", "crossings.toml")["crossing"]
    for rig in rule["rigs"]
)
