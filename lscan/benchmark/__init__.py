"""Every stripe extractor and every plane map on pictures and boards whose truth is known.

``pictures`` draws laser lines, ``extractors`` reads them; ``boards`` shows calibration boards
through a port, ``maps`` solves them; ``page`` lays out table and picture, ``run`` does it all.
"""

from lscan.benchmark.extractors import ExtractorRow, bench_extractors
from lscan.benchmark.maps import MapRow, bench_maps
from lscan.benchmark.page import write_bench
from lscan.benchmark.run import MAPS, registered_extractors, run_bench

__all__ = [
    "MAPS",
    "ExtractorRow",
    "MapRow",
    "bench_extractors",
    "bench_maps",
    "registered_extractors",
    "run_bench",
    "write_bench",
]
