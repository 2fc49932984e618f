"""What everything that learns has in common."""

import copy
import inspect
import os
import pickle
import sys
import warnings

import cloudpickle
import pytest
import sbi.neural_nets
import torch
from sbi.inference import NLE_A, NPE_C, NRE_C, DirectPosterior
from sbi.inference.trainers._contracts import StartIndexContext, TrainConfig
from sbi.inference.trainers.npe.npe_base import PosteriorEstimatorTrainer
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform, RestrictedPrior

from sbi_active import ALHI, ASBI, RefinementOptions, SeqBED, simulate
from sbi_active.inference import ActionEmbedding, SeqBED_LFIRE
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.trainers.action_rounds import SilentTracker
from tests.campaign import problem

# A worker cannot import a test module.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

PRIOR = BoxUniform(-torch.ones(1), torch.ones(1))


def simulator(theta, action):
    return theta * action + 0.1 * torch.randn_like(theta)


def round_of(inference):
    """Return a trainer after a round, small as it is."""
    torch.manual_seed(0)
    theta, action = PRIOR.sample((200,)), torch.ones(200, 1)
    theta, action = inference.arrange(theta, action)
    inference.append_simulations(theta, simulator(theta, action), action=action)
    inference.train(max_num_epochs=2)
    return inference


@pytest.mark.filterwarnings("ignore:.*Maximum number of epochs")
@pytest.mark.parametrize(
    ("trainer", "estimator"),
    [(ASBI, "maf"), (ALHI, None), (SeqBED, None), (SeqBED, "mlp")],
)
def test_a_pickled_trainer_goes_on(trainer, estimator):
    whole = round_of(trainer(PRIOR, estimator, show_progress_bars=False))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sbi's, of what its own trainers lose
        loaded = pickle.loads(pickle.dumps(whole))
    x_o, action = torch.tensor([0.3]), torch.ones(1)
    beliefs = []
    for inference in (whole, loaded):
        torch.manual_seed(1)
        inference.update(x_o, action=action, seed=0)
        round_of(inference)  # a network built anew
        beliefs.append(inference.update(x_o, action=action, seed=1))
    theta = torch.linspace(-0.9, 0.9, 7)[:, None]
    ours, theirs = (belief.log_prob(theta) for belief in beliefs)
    assert torch.equal(ours, theirs)


@pytest.mark.filterwarnings("ignore:.*Maximum number of epochs")
@pytest.mark.filterwarnings("ignore:When the inference object is pickled")
def test_a_trainer_on_a_builder_of_sbi_is_loaded_by_another_process(tmp_path):
    whole = round_of(ASBI(PRIOR, posterior_nn("maf"), show_progress_bars=False))
    path, this = tmp_path / "trainer.pkl", os.getpid()
    theta = torch.tensor([[-0.5], [0.5]])
    path.write_bytes(pickle.dumps(whole))

    def believed(inference):
        torch.manual_seed(1)
        belief = inference.update(torch.tensor([0.3]), action=torch.ones(1), seed=0)
        return belief.log_prob(theta)[:, None]

    def elsewhere(theta, action, seeds):
        assert os.getpid() != this
        return believed(pickle.loads(path.read_bytes()))

    loaded = simulate(elsewhere, theta, theta, seed=0, workers=2, batch_size=2).x
    assert torch.allclose(loaded, believed(whole), atol=1e-4)


@pytest.mark.parametrize("trainer", [ASBI, ALHI])
def test_settings_of_sbi_build_the_network(trainer, recwarn):
    """From 0.28 on sbi has settings with a method ``build`` in place of names."""
    config = getattr(sbi.neural_nets, "MAFConfig", None)
    if config is None:
        pytest.skip("this version of sbi has names and functions alone")
    own = config(hidden_features=11)
    trained = round_of(trainer(PRIOR, own, show_progress_bars=False))
    assert 11 in {p.shape[0] for p in trained._neural_net.parameters()}
    round_of(trainer(PRIOR, show_progress_bars=False))
    assert not [w for w in recwarn if w.category is FutureWarning]


@pytest.mark.parametrize("trainer", [ASBI, ALHI, SeqBED])
def test_a_round_is_kept_alone_and_shares_no_memory(trainer):
    """Rows of earlier rounds train nothing, and may be gigabytes."""
    inference = trainer(PRIOR, show_progress_bars=False)
    for num in (30, 20, 20):
        belief = PRIOR if num == 30 else inference.belief
        theta, x, action = PRIOR.sample((num,)), torch.ones(num, 2), torch.ones(num, 1)
        given = {"action": action, "belief": belief}
        inference.append_simulations(theta, x, **given)
        for tensor in (theta, x, action):
            tensor.fill_(torch.nan)
        if num == 30:
            inference._belief = copy.copy(PRIOR)
    rows, outcomes, _ = inference.get_simulations()
    assert len(rows) == len(outcomes) == 40
    assert bool(rows.isfinite().all() and outcomes.isfinite().all())


PARENTS = {ASBI: NPE_C, ALHI: NLE_A, SeqBED: NRE_C}
#: Private names of sbi that are overridden or called, with their parameters.
HOOKS = {
    "_run_training_loop": "self train_loader val_loader train_config loss_args "
    "summarization_kwargs",
    "_initialize_neural_network": "self retrain_from_scratch start_idx",
    "_get_start_index": "self context",
    "_default_tracker": "self",
    "_summarize": "self round_",
    "_describe_round": "round_ summary",
    "get_simulations": "self starting_round",
    "_resolve_prior": "self prior sample_with",
    "_resolve_estimator": "self estimator",
    "_create_posterior": "self estimator prior sample_with device posterior_parameters",
}
STATE = (
    "_theta_roundwise _x_roundwise _prior_masks _data_round_index _round _neural_net "
    "_build_neural_net _prior _device _summary _best_val_loss"
)


@pytest.mark.parametrize("trainer", PARENTS)
def test_methods_take_what_sbi_takes_in_the_same_order(trainer):
    for name in ("__init__", "append_simulations", "train", "build_posterior"):
        given = inspect.signature(getattr(PARENTS[trainer], name)).parameters
        theirs = [*given]
        ours = inspect.signature(getattr(trainer, name)).parameters
        assert [*ours][: len(theirs)] == theirs
        extra = [p for n, p in ours.items() if n not in theirs]
        assert all(p.kind is inspect.Parameter.KEYWORD_ONLY for p in extra)
        if name == "build_posterior":
            defaults = [ours[n].default for n in theirs]
            assert [p.default for p in given.values()] == defaults


def test_none_is_sbi_s_to_refuse_where_it_is_not_its_default():
    """It was taken for the default, whatever that is."""
    theta = PRIOR.sample((100,))
    inference = ASBI(PRIOR).append_simulations(theta, theta)
    with pytest.raises(TypeError, match="discard_prior_samples"):
        inference.train(discard_prior_samples=None)
    inference.train(clip_max_norm=None, calibration_kernel=None, max_num_epochs=1)


@pytest.mark.parametrize("trainer", PARENTS)
def test_hooks_of_sbi_have_the_signatures_we_override(trainer):
    """A new sbi that changes one fails here and nowhere else."""
    for name, parameters in HOOKS.items():
        for cls in (PARENTS[trainer], trainer):
            found = [*inspect.signature(getattr(cls, name)).parameters]
            assert found == parameters.split(), (cls, name)
    state = vars(PARENTS[trainer](tracker=SilentTracker()))
    assert not [name for name in STATE.split() if name not in state]


def test_contracts_of_sbi():
    parameters = inspect.signature(PosteriorEstimatorTrainer.train).parameters
    assert "force_first_round_loss" in parameters
    assert "num_atoms" not in parameters
    assert "use_combined_loss" not in parameters
    assert "resume_training" in inspect.signature(StartIndexContext).parameters
    fields = inspect.signature(TrainConfig).parameters
    assert {"training_batch_size", "learning_rate", "clip_max_norm"} <= {*fields}
    assert "_report_convergence_at_end" in dir(NRE_C)
    assert "_proposal_roundwise" in vars(NPE_C(tracker=SilentTracker()))
    assert "_prior" in inspect.getsource(RestrictedPrior.__init__)


@pytest.mark.filterwarnings("ignore:.*Maximum number of epochs")
@pytest.mark.parametrize(
    ("trainer", "estimator"),
    [(ASBI, "mdn"), (ASBI, "maf"), *((t, None) for t in [*PARENTS][1:])],
)
def test_without_actions_two_rounds_are_numerically_sbi_s(trainer, estimator):
    runs = []
    for cls in (trainer, PARENTS[trainer]):
        torch.manual_seed(1)
        given = () if estimator is None else (estimator,)
        quiet = {"tracker": SilentTracker(), "show_progress_bars": False}
        inference, proposal = cls(PRIOR, *given, **quiet), PRIOR
        for index in range(2):
            theta = proposal.sample((150,))
            x = theta + 0.1 * torch.randn_like(theta)
            told = {"proposal": proposal} if given else {"from_round": index}
            inference.append_simulations(theta, x, **told)
            net = inference.train(max_num_epochs=2, training_batch_size=50)
            if given:  # the next round is of the posterior
                proposal = inference.build_posterior().set_default_x(torch.zeros(1, 1))
        runs.append((net.state_dict(), inference.summary["validation_loss"], proposal))
    (ours, our_loss, own), (theirs, their_loss, other) = runs
    assert our_loss == their_loss
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    if estimator is not None:
        assert type(own) is DirectPosterior
        drawn = []
        for posterior in (own, other):
            torch.manual_seed(2)
            drawn.append((posterior.log_prob(theta[:10]), posterior.sample((5,))))
        assert all(torch.equal(*pair) for pair in zip(*drawn, strict=True))


def test_embedding_sees_x_in_its_own_shape():
    seen = []

    class Net(torch.nn.Module):
        def forward(self, x):
            seen.append(x.shape)
            return x.flatten(1).sum(1, keepdim=True)

    embedding = ActionEmbedding(Net(), x_shape=(1, 4, 4), action_dim=2)
    out = embedding(torch.ones(3, 18))
    assert seen == [(3, 1, 4, 4)]
    assert out.tolist() == [[16.0, 1.0, 1.0]] * 3
    with pytest.raises(ValueError, match="expected a packed condition of 18 numbers"):
        embedding(torch.ones(3, 17))


# Outcomes as far away as float32 reaches, told to the trainers themselves


SETTINGS = RefinementOptions(num_histories=300, num_effective=25)
SIZES = (1e15, -3e38)


def trained(make):
    torch.manual_seed(0)
    theta, action = problem.PRIOR.sample((300,)), torch.ones(300, 1)
    if make is SeqBED_LFIRE:
        trainer = SeqBED_LFIRE(problem.PRIOR)
        theta, action = trainer.arrange(theta, action)
    else:
        network = problem.OPTIONS.density_estimator
        network = problem.RATIOS if make is SeqBED else network
        trainer = make(problem.PRIOR, network, show_progress_bars=False)
    x = theta * action + 0.1 * torch.randn_like(theta)
    trainer.append_simulations(theta, x, action=action).train()
    return trainer


#: Trainers, simulators, and what is told.
UPDATES = [
    *[(make, None, -3e38) for make in (ASBI, ALHI, SeqBED, SeqBED_LFIRE)],
    *[(ASBI, problem.MODEL, x) for x in SIZES],
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("make", "simulator", "x"), UPDATES)
def test_updates_give_a_belief_to_go_on_from(make, simulator, x):
    trainer = trained(make)
    told = {"simulator": simulator, "refinement": SETTINGS, "seed": 1}
    try:
        belief = trainer.update(torch.tensor([x]), action=torch.ones(1), **told)
    except UnexplainedOutcomeError:  # no parameters have a likelihood at all
        assert trainer.trials == []
    else:
        assert bool(belief.sample((50,)).isfinite().all())
        assert not bool(belief.log_prob(problem.PRIOR.sample((50,))).isnan().any())
    if simulator is not None:
        after = trainer.update(torch.tensor([0.6]), action=torch.ones(1), **told)
        assert bool(after.sample((50,)).isfinite().all())


@pytest.mark.parametrize("x", SIZES)
def test_what_the_network_cannot_say_changes_nothing(x):
    trainer = trained(ASBI)
    if x == 1e15:  # squares still fit: coarse, and said to be
        with pytest.warns(UserWarning, match="lies within the prior's support"):
            trainer.update(torch.tensor([x]), action=torch.ones(1))
        return
    with pytest.warns(UserWarning, match="its density is finite nowhere"):
        belief = trainer.update(torch.tensor([x]), action=torch.ones(1))
    assert belief.diagnostics.trustworthy is False
    theta = torch.tensor([[0.2], [0.7]])
    assert torch.equal(belief.log_prob(theta), problem.PRIOR.log_prob(theta))
