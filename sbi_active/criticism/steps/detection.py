"""When the bare model, refitted, misses the data: levels, and its alternatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED

#: Log Bayes factor of an alarm: under the bare model's prior predictive it is exceeded,
#: at any stopping time, with a probability of at most 1/20.
THRESHOLD = float(np.log(20.0))
#: Tail probability of the refitted chi-square that is an alarm by itself.
LEVEL = 0.01
#: Tail probability of a chi-square which is too small for the declared noise.
TOO_SMALL = 1e-4
#: Tail probability of a verdict's residual below which something else is missing.
REFUTED = 0.001


def alternatives(
    effects: Sequence[str], equivalent: Sequence[frozenset[str]]
) -> dict[str, float]:
    """Return the weights of the alternatives to the bare model, which sum to one.

    The residual process, noise inflation and each effect have equal weights; effects
    that nothing separates count as one, and effects that nothing separates from the
    bare model do not count.

    Args:
        effects: Names of the effects.
        equivalent: Groups that nothing separates, with "none" for the bare model.

    Example:
        >>> groups = [frozenset({"none", "gain"}), frozenset({"bias", "offset"})]
        >>> alternatives(["gain", "bias", "offset"], groups)["bias"]  # 1 / 2 of 1 / 3
        0.16666666666666666
    """
    shares = {UNEXPLAINED: 1.0, SCATTER: 1.0}
    for name in effects:
        group = next((g for g in equivalent if name in g), frozenset({name}))
        if NONE not in group:
            shares[name] = 1 / len(group & {*effects})
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items()}
