"""The metric route: camera and laser sheet from pictures of a board in several poses.

For rigs whose board cannot be made coplanar with the sheet.  ``views`` reads the pictures and shows
what was seen of each, ``solve`` finds the camera and the boards' poses (lscan.camera.resection),
leaves out the views that are outliers and goes all the way, ``sheet`` finds the laser's plane from
the line seen on the boards, ``planemap`` is the map that comes of it.
"""
