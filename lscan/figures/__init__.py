"""The report's figures, counterparts of the paper's.

Each function of ``board``, ``stripes``, ``relief``, ``contours`` and ``slices`` takes records
and returns an :class:`lscan.figures.reportfigure.ReportFigure`.  Importing this package loads no
plotting library; those modules do.
"""
