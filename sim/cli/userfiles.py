"""The files of the tank that ``lscan schema`` knows."""

from dataclasses import replace

from lscan.cli.schema import OPTIONS
from lscan.config.rig import Rig
from lscan.config.userfiles import Options, UserFile, user_file
from sim.datasets.datasetspec import DatasetFile
from sim.datasets.suite import SuiteSpecFile
from sim.devices import CameraOptions, TrackOptions
from sim.scene.file import TankSections
from sim.studies.design.catalogue import Catalogue
from sim.studies.studyfile import StudyFile


def scene_file() -> UserFile:
    """What ``lscan-sim render`` takes, and ``lscan scan``."""
    options: Options = {
        "camera": {**OPTIONS["camera"], "sim": CameraOptions},
        "track": {**OPTIONS["track"], "sim": TrackOptions},
    }
    return user_file(
        "a scene: a rig in the tank, and what it scans", Rig, TankSections, options=options
    )


def study_file() -> UserFile:
    """What ``lscan-sim study`` takes."""
    return user_file("a study of what a rig's errors come from", StudyFile)


def dataset_file() -> UserFile:
    """What ``lscan-sim dataset`` takes."""
    return user_file("a data set of labelled pictures", DatasetFile)


def suite_file() -> UserFile:
    """What ``lscan-sim suite make`` takes."""
    return user_file("a suite of pictures with their truth", SuiteSpecFile)


def catalogue_file() -> UserFile:
    """Parts that a study's ``[design]`` chooses among."""
    found = user_file("a catalogue of parts that a rig is made from", Catalogue)
    # Of tables with the same keys the first says them all; those that a scene has are said there.
    parts = {part.model: part for part in reversed(found.sections) if part.name != "track.errors"}
    sections = [replace(part, variant="catalogue") for part in reversed(parts.values())]
    return replace(found, sections=sections)
