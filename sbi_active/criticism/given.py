"""The conditions of a comparison, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sbi_active.criticism.data.sampling import Sampling
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.linear.screening import Screening
from sbi_active.criticism.thinning import in_words


def made_given(
    trials: Trials,
    *,
    num_summaries: int,
    sampling: Sampling | None,
    left_out: Sequence[str],
    screening: Screening | None,
    nuisances: Sequence[str],
    warm_up: float,
) -> Iterator[str]:
    """Yield the limits of a comparison and their reasons, a sentence each.

    Args:
        trials: Trials that were compared.
        num_summaries: Number of summaries that stand for x; 0 for none.
        sampling: Sampling that was found; None if not looked for.
        left_out: Names of effects of an order that is unknown.
        screening: Screening by linear evidence; None if all were fitted.
        nuisances: Names of the effects that each trial has anew.
        warm_up: Time in which trials that were not fitted tell of theirs.
    """
    if num_summaries:
        yield (
            f"SA524 given {num_summaries} summaries of the {trials.x[0].numel()} "
            "numbers of a trial: what they leave out was not looked at"
        )
    if sampling is not None and sampling.every > 1:
        yield in_words(sampling)
    if left_out:
        yield (
            "SA526 the order of the trials is unknown: what grows from trial to trial "
            f"was not looked for ({', '.join(left_out)})"
        )
    if screening is not None:
        nearest, behind = next(iter(screening.behind.items()))
        num = len(screening.behind)
        yield (
            f"SA527 of {num + len(screening.kept)} effects {len(screening.kept)} were "
            f"fitted: linear evidence puts the others behind, the nearest ({nearest}) "
            f"by {behind:.1f} nats"
        )
    if nuisances and warm_up == 0:
        yield (
            f"SA528 trials that were not fitted draw {', '.join(nuisances)} from the "
            "prior, which is part of their error; pass warm_up, the time in which "
            "their first samples tell of it"
        )
