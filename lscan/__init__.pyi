# The public names of lscan and the modules that define them; __init__.py offers what is named here.

from lscan.acquisition.run import (
    Run as Run,
)
from lscan.acquisition.run import (
    open_run as open_run,
)
from lscan.acquisition.scan import scan as scan
from lscan.board import read_board as read_board
from lscan.calibration.api import PlaneMap as PlaneMap
from lscan.calibration.loading import load_plane_map as load_plane_map
from lscan.calibration.solve import (
    Calibration as Calibration,
)
from lscan.calibration.solve import (
    calibrate as calibrate,
)
from lscan.calibration.solve import (
    load_calibration as load_calibration,
)
from lscan.calibration.solve import (
    save_calibration as save_calibration,
)
from lscan.config.rig import StripeSection as StripeSection
from lscan.config.rigfile import (
    RigFile as RigFile,
)
from lscan.config.rigfile import (
    load_rig as load_rig,
)
from lscan.devices.api import (
    Camera as Camera,
)
from lscan.devices.api import (
    Track as Track,
)
from lscan.errors import LscanError as LscanError
from lscan.measure import (
    diameters as diameters,
)
from lscan.measure import (
    distances as distances,
)
from lscan.measurement import (
    measure_groove as measure_groove,
)
from lscan.measurement import (
    measure_run as measure_run,
)
from lscan.measurement import (
    measure_sandwave as measure_sandwave,
)
from lscan.pipeline import (
    calibrate_run as calibrate_run,
)
from lscan.pipeline import (
    mean_picture as mean_picture,
)
from lscan.pipeline import (
    reconstruct as reconstruct,
)
from lscan.records import (
    BoardReading as BoardReading,
)
from lscan.records import (
    Frame as Frame,
)
from lscan.records import (
    Profile as Profile,
)
from lscan.records import (
    Status as Status,
)
from lscan.records import (
    Stripe as Stripe,
)
from lscan.records import (
    Surface as Surface,
)
from lscan.stripe import extract_stripe as extract_stripe
from lscan.stripe.api import Extractor as Extractor
from lscan.surface import (
    load_surface as load_surface,
)
from lscan.surface import (
    save_surface as save_surface,
)
from lscan.version import __version__ as __version__
