"""Large libraries are screened by linear evidence before anything is fitted."""

import pytest
import torch
from torch.distributions import HalfNormal, Normal

from sbi_active.criticism import Criticism, Effect
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.steps.equivalence import MANY
from sbi_active.criticism.steps.tracing import log_priors
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, TIMES, trials


def ripple(k):
    """A wave in the reading, of a frequency of its own."""
    wave = 0.05 * torch.sin((2.0 + 0.7 * k) * TIMES + k)

    def apply(x, phi, action, context):
        return x + phi * wave

    return Effect(
        f"ripple {k}",
        hook="observation",
        prior=Normal(0.0, 1.0),
        null=0.0,
        apply=apply,
        family="ripple",
    )


def louder(sd, phi, action, context):
    return sd * (1 + phi[:, :1])


LIBRARY = [*EFFECTS, *[ripple(k) for k in range(MANY)]]


def rivals(own, library=LIBRARY):
    return RivalSet(MODEL, PRIOR, own, library, seed=0)


@pytest.fixture(scope="module")
def large():
    loop = Criticism(MODEL, PRIOR, trials(bias=0.05), effects=LIBRARY, seed=0)
    loop.trace()
    return loop, loop.rivals.simulator.num_simulations


def test_what_was_set_aside_counts_in_the_prior_and_is_said(large):
    loop, _ = large
    assert loop.trace().verdict == "bias"
    assert len(loop.rivals.effects) < len(LIBRARY)
    whole = log_priors(LIBRARY)
    assert log_priors(loop.rivals.library)["ripple 3"] == whole["ripple 3"]
    gone = next(iter(loop.screening.behind))
    assert loop.add([gone])[1].event_shape[0] == 3  # can be added all the same
    report = " ".join(str(loop.report(evaluate=False, plan=False)).split())
    assert f"of {len(LIBRARY)} effects {len(loop.rivals.effects)} were fitted" in report


def test_a_small_library_is_fitted_as_a_whole():
    search, found = linear_models(rivals(trials(), EFFECTS))
    assert found is None
    assert search.names == [e.name for e in EFFECTS]


def test_effects_on_the_noise_are_never_set_aside():
    # No column tells of them.
    alone = Effect("noise", hook="noise", prior=HalfNormal(1.0), null=0.0, apply=louder)
    _, found = linear_models(rivals(trials(bias=0.05), [*LIBRARY, alone]))
    assert "noise" in found.kept
