"""What the scanner ought to measure, in float64 NumPy, to judge tank and instrument by.

camera: where a point of the water is seen.  sheet, bow: where the laser's light is.  target: what
stands in the tank, cut by it.  visibility: what is lit and seen.  stripe, shutter, board: the truth
of a picture.  light: how bright its line is.  placement: whether a scene can be scanned at all.

The truth imports neither the renderer nor any room of the instrument that works on pictures
(the import contract in pyproject.toml), and it solves for itself what they solve: rays through a
flat port by Fermat's principle, through a dome by Bouguer's theorem, sections and visibility by
analytic geometry.  What it shares with them is what defines the tank and cannot differ:

- the scene's models and poses (sim.scene), the shapes of board and targets (lscan.config), among
  them the paper's Eq. (4) and its derivatives, and the triangles of a mesh (sim.meshes);
- the indices and coefficients of water and glass (sim.water), which have tests of their own
  against published values;
- the thickness of a Gaussian sheet (sim.scene.Laser), which the renderer computes for itself;
- the Brown-Conrady polynomials that the lens is specified by, written twice and held to OpenCV's;
- in sim.truth.light alone, photons per radiance and contrast of speckle
  (sim.sensor.radiometry, speckle): that module judges how the instrument reads a line of a given
  brightness, not the sensor, which closed forms and published values judge.
"""

from sim.truth.board import BoardTruth, board_truth
from sim.truth.camera import project
from sim.truth.light import LineBrightness, line_brightness
from sim.truth.sheet import sheet_of
from sim.truth.stripe import StripeTruth, stripe_truth, stripe_truths
from sim.truth.visibility import slice_visibility

__all__ = [
    "BoardTruth", "LineBrightness", "StripeTruth", "board_truth", "line_brightness", "project",
    "sheet_of", "slice_visibility", "stripe_truth", "stripe_truths",
]  # fmt: skip
