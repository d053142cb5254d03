"""What holds the tank and the instrument to their figures: ``make validate``."""

import os

# Chapters side by side work on small matrices: a thread of BLAS for each core makes them wait for
# one another (two of lengths in other water took twice as long).  Before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
