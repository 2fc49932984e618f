"""Settings of what is spent on fits."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Settings of what is spent on fits.

    Attributes:
        num_starts: Draws of the prior at which the bare model's search begins.
        num_kept: Searches that go on from there.
        first: Steps of these searches along secants.
        num_drawn: Draws of a further effect at which its fit begins, beside its null.
        num_far: Draws of the prior that are screened for a set with an effect that no
            number makes vanish: parameters beside it lie far from those without it.
        num_kept_far: Draws that are kept.
        secant: Steps along secants between two linearizations.
        rounds: Linearizations at most.
        worth: A fall of the sum of squares that is worth another one, in units of the
            residual's own variance.
        tried: Deviations of its prior by which a further effect is tried.
        faint: Share of them that hardly acts.
        num_bases: Models beside which larger ones are looked for.
        num_pairs: Pairs that are fitted.
        num_larger: Larger sets that are fitted, of each size.
        max_effects: Effects of a set at most.
        behind: Nats by which linear evidence puts a larger set behind one that is
            fitted, so that it is not fitted.
        passes: Tail probability of a chi-square from which nothing larger than a pair
            is looked for.
    """

    num_starts: int = 6
    num_kept: int = 2
    first: int = 8
    num_drawn: int = 3
    num_far: int = 32
    num_kept_far: int = 6
    secant: int = 5
    rounds: int = 4
    worth: float = 0.3
    tried: float = 0.3
    faint: float = 0.03
    num_bases: int = 3
    num_pairs: int = 10
    num_larger: int = 3
    max_effects: int = 4
    behind: float = 10.0
    passes: float = 0.01
