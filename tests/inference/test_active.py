"""One protocol for everything that learns."""

import inspect

import pytest
import torch
from sbi.inference import NLE_A, NRE_B, NRE_C
from sbi.utils import BoxUniform

from sbi_active import ALHI, ASBI, SeqBED, SeqBED_B, SeqBED_C
from sbi_active.inference import ActiveInference
from sbi_active.inference.rounds import SilentTracker

PRIOR = BoxUniform(-torch.ones(1), torch.ones(1))
TRAINERS = [ASBI, ALHI, SeqBED, SeqBED_B, SeqBED_C]
METHODS = [
    *["arrange", "append_simulations", "train", "build_posterior", "update"],
    "update_all",
]


@pytest.mark.parametrize("trainer", TRAINERS)
def test_every_trainer_meets_the_protocol(trainer):
    inference = trainer(PRIOR, show_progress_bars=False)
    assert isinstance(inference, ActiveInference)
    assert inference.belief is PRIOR
    assert inference.trials == []
    for name in METHODS:
        wanted = inspect.signature(getattr(ActiveInference, name)).parameters
        given = inspect.signature(getattr(trainer, name)).parameters
        for parameter in wanted.values():
            assert given[parameter.name].kind is parameter.kind, (name, parameter)
            assert given[parameter.name].default == parameter.default
        others = [p for n, p in given.items() if n not in wanted]
        assert all(p.default is not p.empty for p in others), name


def test_an_object_without_update_does_not_meet_it():
    class Half:
        trials = []
        belief = PRIOR
        append_simulations = train = build_posterior = update_all = arrange = None

    assert not isinstance(Half(), ActiveInference)


PARENTS = {ALHI: NLE_A, SeqBED_B: NRE_B, SeqBED_C: NRE_C}


@pytest.mark.parametrize("trainer", PARENTS)
def test_methods_take_what_sbi_takes_in_the_same_order(trainer):
    for name in ("__init__", "append_simulations", "train", "build_posterior"):
        theirs = [*inspect.signature(getattr(PARENTS[trainer], name)).parameters]
        ours = inspect.signature(getattr(trainer, name)).parameters
        assert [*ours][: len(theirs)] == theirs
        extra = [p for n, p in ours.items() if n not in theirs]
        assert all(p.kind is inspect.Parameter.KEYWORD_ONLY for p in extra)


@pytest.mark.parametrize("trainer", PARENTS)
def test_hooks_of_sbi_have_the_signatures_we_override(trainer):
    parent = PARENTS[trainer]
    for name in (
        *["_run_training_loop", "_initialize_neural_network", "_get_start_index"],
        *["_default_tracker", "_report_convergence_at_end", "_summarize"],
    ):
        theirs = [*inspect.signature(getattr(parent, name)).parameters]
        assert [*inspect.signature(getattr(trainer, name)).parameters] == theirs
    state = vars(parent(tracker=SilentTracker()))
    names = ["_theta_roundwise", "_x_roundwise", "_prior_masks", "_data_round_index"]
    assert not [n for n in [*names, "_prior", "_device", "_summary"] if n not in state]


@pytest.mark.filterwarnings("ignore:.*Maximum number of epochs")
@pytest.mark.parametrize("trainer", PARENTS)
def test_without_actions_two_rounds_are_numerically_sbi_s(trainer):
    nets = []
    for cls in (trainer, PARENTS[trainer]):
        torch.manual_seed(1)
        inference = cls(PRIOR, tracker=SilentTracker(), show_progress_bars=False)
        for index in range(2):
            theta = PRIOR.sample((300,))
            x = theta + 0.1 * torch.randn_like(theta)
            inference.append_simulations(theta, x, from_round=index)
            net = inference.train(max_num_epochs=2, training_batch_size=50)
        nets.append((net.state_dict(), inference.summary["validation_loss"]))
    (ours, our_loss), (theirs, their_loss) = nets
    assert our_loss == their_loss
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
