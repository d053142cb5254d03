"""Every stripe extractor and every plane map on pictures and boards whose truth is known.

``pictures`` draws laser lines, ``extractors`` reads them; ``boards`` shows calibration boards
through a port, ``maps`` solves them; ``page`` lays out table and picture, ``run`` does it all.
"""
