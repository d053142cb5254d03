"""The command ``lscan live``: a thin face over lscan.live."""
