"""The private names of sbi that ASBI overrides or calls, with their signatures.

A new sbi that changes one fails here and nowhere else.
"""

import inspect

import pytest
from sbi.inference import NPE_C
from sbi.inference.trainers._contracts import LossArgs, StartIndexContext, TrainConfig
from sbi.inference.trainers.npe.npe_base import PosteriorEstimatorTrainer
from sbi.utils import RestrictedPrior

from sbi_active import ASBI

HOOKS = {
    "_run_training_loop": [
        *["self", "train_loader", "val_loader", "train_config", "loss_args"],
        "summarization_kwargs",
    ],
    "_initialize_neural_network": ["self", "retrain_from_scratch", "start_idx"],
    "_get_start_index": ["self", "context"],
    "_default_tracker": ["self"],
    "_summarize": ["self", "round_"],
    "_describe_round": ["round_", "summary"],
    "get_simulations": ["self", "starting_round"],
    "_resolve_prior": ["self", "prior", "sample_with"],
    "_resolve_estimator": ["self", "estimator"],
    "_create_posterior": [
        *["self", "estimator", "prior", "sample_with", "device"],
        "posterior_parameters",
    ],
}
STATE = [
    *["_theta_roundwise", "_x_roundwise", "_prior_masks", "_proposal_roundwise"],
    *["_data_round_index", "_round", "_neural_net", "_build_neural_net", "_prior"],
    *["_device", "_summary", "_best_val_loss"],
]


@pytest.mark.parametrize("name", HOOKS)
def test_hook_has_the_signature_we_override(name):
    for cls in (NPE_C, ASBI):
        assert [*inspect.signature(getattr(cls, name)).parameters] == HOOKS[name]


@pytest.mark.parametrize("name", ["__init__", "append_simulations", "train"])
def test_public_methods_take_what_sbi_takes_in_the_same_order(name):
    theirs = [*inspect.signature(getattr(NPE_C, name)).parameters]
    ours = inspect.signature(getattr(ASBI, name)).parameters
    assert [*ours][: len(theirs)] == theirs
    extra = [p for n, p in ours.items() if n not in theirs]
    assert all(p.kind is inspect.Parameter.KEYWORD_ONLY for p in extra)


def test_build_posterior_has_sbi_s_signature_and_defaults():
    theirs = inspect.signature(NPE_C.build_posterior).parameters
    ours = inspect.signature(ASBI.build_posterior).parameters
    assert {n: p.default for n, p in theirs.items()} == {
        n: p.default for n, p in ours.items()
    }


def test_train_of_the_parent_takes_what_we_pass():
    parameters = inspect.signature(PosteriorEstimatorTrainer.train).parameters
    assert "force_first_round_loss" in parameters
    assert "num_atoms" not in parameters
    assert "use_combined_loss" not in parameters


def test_state_names():
    state = vars(NPE_C(tracker=ASBI()._tracker))
    assert not [name for name in STATE if name not in state]


def test_contracts():
    assert "resume_training" in inspect.signature(StartIndexContext).parameters
    fields = inspect.signature(TrainConfig).parameters
    assert {"training_batch_size", "learning_rate", "clip_max_norm"} <= {*fields}
    assert LossArgs is not None
    assert "_prior" in inspect.getsource(RestrictedPrior.__init__)
