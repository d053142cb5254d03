"""The metric route: camera and laser sheet from pictures of a board in several poses.

For rigs whose board cannot be made coplanar with the sheet.  ``viewsfile`` reads the pictures,
``usedviews`` finds the camera and the boards' poses (lscan.camera.resection) and leaves out the views
that are outliers, ``lines``, ``consensus``, ``equations`` and ``sheet`` find the laser's plane from
the line seen on the boards, ``solve`` goes all the way, ``planemap`` is the map that comes of it,
``file`` keeps it, or a camera alone, and ``overlays`` shows what was seen of each view.
"""
