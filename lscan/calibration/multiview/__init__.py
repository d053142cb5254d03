"""The metric route: camera and laser sheet from pictures of a board in several poses.

For rigs whose board cannot be made coplanar with the sheet.  ``viewsfile`` reads the pictures,
``solve`` finds the camera and the boards' poses (lscan.camera.fit), leaves out the views that
are outliers and reports on each, ``lines``, ``equations`` and ``sheet`` find the laser's
plane from the line seen on the boards, ``planemap`` is the map that comes of it, ``file`` keeps it.
"""
