"""Suites: rendered pictures with their truth, hashed, read without the tank that made them."""

from lscan.suites.content import (
    BoardCase,
    CaseTruth,
    LightLayers,
    ScanCase,
    SuiteCase,
    SuiteContent,
    axes_of,
)
from lscan.suites.files import (
    Suite,
    find_suite,
    is_written,
    open_suite,
    pack_suite,
    suites_found,
    verify_suite,
    write_case,
    write_manifest,
)

__all__ = [
    "BoardCase", "CaseTruth", "LightLayers", "ScanCase", "Suite", "SuiteCase", "SuiteContent",
    "axes_of", "find_suite", "is_written", "open_suite", "pack_suite", "suites_found",
    "verify_suite", "write_case", "write_manifest",
]  # fmt: skip
