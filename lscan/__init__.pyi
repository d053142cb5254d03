# The public names of lscan and the modules that define them; __init__.py offers what is named here.

from lscan.acquisition.run import (
    Run as Run,
    open_run as open_run,
)
from lscan.acquisition.scan import scan as scan
from lscan.board import read_board as read_board
from lscan.calibration.calibrate import Calibration as Calibration, calibrate as calibrate
from lscan.calibration.calibrationfile import (
    load_calibration as load_calibration,
    load_plane_map as load_plane_map,
    save_calibration as save_calibration,
)
from lscan.calibration.planemap import PlaneMap as PlaneMap
from lscan.config.rig import (
    RigFile as RigFile,
    StripeSection as StripeSection,
    load_rig as load_rig,
)
from lscan.devices.api import (
    Camera as Camera,
    Track as Track,
)
from lscan.errors import LscanError as LscanError
from lscan.measure import (
    diameters as diameters,
    distances as distances,
)
from lscan.pipeline import (
    calibrate_run as calibrate_run,
    mean_picture as mean_picture,
    measure_groove as measure_groove,
    measure_run as measure_run,
    measure_sandwave as measure_sandwave,
    reconstruct as reconstruct,
)
from lscan.records import (
    BoardReading as BoardReading,
    Frame as Frame,
    Profile as Profile,
    Status as Status,
    Stripe as Stripe,
    Surface as Surface,
)
from lscan.stripe import extract_stripe as extract_stripe
from lscan.stripe.api import Extractor as Extractor
from lscan.surface import (
    load_surface as load_surface,
    save_surface as save_surface,
)
from lscan.version import __version__ as __version__
