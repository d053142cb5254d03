"""Suites: rendered pictures with their truth, hashed, read without the tank that made them."""

from lscan.suites.boards import BoardCase
from lscan.suites.content import CaseTruth, SuiteCase, SuiteContent, axes_of
from lscan.suites.find import find_suite, suites_found
from lscan.suites.layers import LightLayers
from lscan.suites.reader import Suite, open_suite, pack_suite, verify_suite
from lscan.suites.scans import ScanCase
from lscan.suites.writer import is_written, write_case, write_manifest

__all__ = [
    "BoardCase",
    "CaseTruth",
    "LightLayers",
    "ScanCase",
    "Suite",
    "SuiteCase",
    "SuiteContent",
    "axes_of",
    "find_suite",
    "is_written",
    "open_suite",
    "pack_suite",
    "suites_found",
    "verify_suite",
    "write_case",
    "write_manifest",
]
