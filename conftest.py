"""What holds for all tests: one thread for the matrices, which here are small.

More threads cost small matrices more time than they save, all the more where pytest-xdist runs
as many tests at a time as there are cores.  NumPy reads the setting when it is imported, which
pytest does not do before it reads this file.  It lies above ``tests``, because pytest puts the
folder of a conftest first where Python looks for modules: from ``tests`` its folder ``lscan``
would hide the package.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
