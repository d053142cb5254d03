"""lscan: calibration, stripe extraction, reconstruction and measurement for laser line scanners.

What is named here is the public interface; each name is loaded when it is first asked for.  From
a scan of the calibration board and one of an object to a surface:

    import lscan

    board = lscan.scan(lscan.load_rig("board.toml"), "runs/board")
    calibration = lscan.calibrate_run(board)
    run = lscan.scan(lscan.load_rig("rig.toml"), "runs/object")
    surface = lscan.reconstruct(run, calibration.plane_map).surface
    lscan.save_surface("surface.nc", surface)
"""

from lscan.files.publicnames import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __file__, checked=True)
