"""The belief of the networks beside the refined one."""

from __future__ import annotations

from sbi_active.inference.beliefs.belief import Belief, ChainedBelief
from sbi_active.seeding import forked_generators

#: Nats by which the network may lie beside the refined belief before it is said.
TOLERANCE = 0.5
#: No density in float32 is further below another than this.
FLOOR = -60.0
NUM_DRAWS = 2_000  # of each belief, whose mean is then known to .02 nat a parameter


def compare(refined: Belief, chained: ChainedBelief) -> None:
    r"""Add figures on the network's belief to the refined belief's diagnostics.

    A network can pass a calibration test and be nats blunter than the data allow, since
    calibration sees no sharpness. Against the refined belief r, with c the chained one:

    .. math::
        \mathrm{loss} = E_r[\log r(\theta) - \log c(\theta)], \qquad
        \mathrm{bluntness} = H(c) - H(r).

    A loss with a positive bluntness is under-confidence; a loss without it is
    overconfidence or a wrong place. The loss is bounded by 60 nats; beyond half a nat
    it is a warning.
    """
    with forked_generators(0, "compare"):
        draws = refined.sample((NUM_DRAWS,))
        chained_draws = chained.sample((NUM_DRAWS,))
    refined_score = float(refined.log_prob(draws).double().mean())
    chained_log_prob = chained.log_prob(draws).double()
    score = float(chained_log_prob.clamp_min(refined_score + FLOOR).mean())
    entropy = -float(chained.log_prob(chained_draws).double().mean())
    loss, bluntness = refined_score - score, entropy + refined_score
    refined.diagnostics = refined.diagnostics.extended(
        refined_log_score=refined_score,
        chained_log_score=score,
        chained_loss=loss,
        chained_bluntness=bluntness,
    )
    if loss <= TOLERANCE:
        return
    kind = (
        f"under-confident, {bluntness:.1f} nats blunter than the refined belief"
        if bluntness > 0.5 * loss
        else f"overconfident or misplaced, {loss:.1f} nats behind the refined belief"
    )
    refined.diagnostics = refined.diagnostics.extended(
        network_warnings=((f"SA122 the amortized network is {kind}"),)
    )
