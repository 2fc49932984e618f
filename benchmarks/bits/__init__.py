"""Results to the last bit, for which products of matrices must not depend on memory."""

import os

# Read by MKL when torch is imported: else sums depend on where an array happens to lie.
os.environ.setdefault("MKL_CBWR", "COMPATIBLE")
