"""Every stripe extractor and every plane map on pictures and boards whose truth is known.

``pictures`` draws laser lines, ``extractors`` reads them; ``boards`` shows calibration boards
through a port, ``maps`` solves them; ``page`` lays out table and picture, ``run`` does it all.
"""

from lscan.bench.extractors import ExtractorRow, bench_extractors
from lscan.bench.maps import MapRow, bench_maps
from lscan.bench.page import write_bench
from lscan.bench.run import MAPS, registered_extractors, run_bench

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
