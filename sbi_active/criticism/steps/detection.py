"""When the bare model, refitted, misses the data: levels."""

from __future__ import annotations

import numpy as np

#: Log Bayes factor of an alarm: under the bare model's prior predictive it is exceeded,
#: at any stopping time, with a probability of at most 1/20.
THRESHOLD = float(np.log(20.0))
#: Tail probability of the refitted chi-square that is an alarm by itself.
LEVEL = 0.01
#: Tail probability of a chi-square which is too small for the declared noise.
TOO_SMALL = 1e-4
#: Tail probability of a verdict's residual below which something else is missing.
REFUTED = 0.001
