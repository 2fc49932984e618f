"""Export to ArviZ, of both generations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arviz_versions import Groups, data_tree, inference_data
from sbi_active.criticism.effects.effect import Context
from sbi_active.expected import suggests
from sbi_active.inference.beliefs.belief import names_of
from sbi_active.seeding import derive_seed, draws_of, forked_generators
from sbi_active.simulation import simulate

if TYPE_CHECKING:
    from sbi_active.campaign import Campaign


@suggests
def to_datatree(
    source: Any,
    *,
    parameter_names: Sequence[str] | None = None,
    num_samples: int = 2_000,
    num_chains: int = 4,
    model: str | None = None,
    simulator: Callable[..., Any] | None = None,
    action: Tensor | None = None,
    x: Tensor | None = None,
    seed: int = 0,
) -> xr.DataTree:
    """Return draws and data as an xarray ``DataTree``, which ArviZ 1.x takes.

    It needs xarray alone, so that one Python may write what another one reads: by
    ``to_netcdf``, or ``to_zarr``.

    Groups of a belief: posterior, sample_stats (the log density ``lp`` of each draw),
    and prior where the belief knows it; with ``simulator`` and ``action`` also
    posterior_predictive, one outcome an action and draw. A campaign adds
    posterior_predictive, prior_predictive and observed_data (one outcome a trial),
    constant_data (actions) and log_likelihood (where the simulator's noise has a
    density); the predictive ones and the likelihood where it was loaded with its
    simulator, without which ``lp`` is by kernels where it would be simulated. A report
    has the posterior of its verdict's model, or of ``model``.

    Draws are independent; they are split over chains, so that r_hat and ess are
    defined. Coordinates name parameters, rounds, channels and entries of the action,
    which carry their units as attributes.

    Args:
        source: A belief, a campaign or a report.
        parameter_names: Names of the parameters; None takes the simulator's, which
            beliefs remember, else theta_1, ...
        num_samples: Draws of all chains together.
        num_chains: Number of chains; draws that do not fill all are left out.
        model: Model of a report, by a name among ``report.tracing.evidences``.
        simulator: Simulator that a belief predicts outcomes with.
        action: Actions at which it does, shape (k, action_dim).
        x: Outcomes measured there, shape (k, *x_shape), if any: observed_data, and
            log_likelihood where the simulator declares its noise.
        seed: Seed of the draws.

    Raises:
        ValueError: If names do not fit, chains are more than half of the draws, a
            report has no such model, or actions come without a simulator or not with a
            belief.
    """
    if not 1 <= num_chains <= num_samples // 2:
        raise ValueError(
            "expected at least two draws a chain; got "
            f"{num_samples} draws in {num_chains} chains; raise num_samples"
        )
    is_belief = isinstance(source, Distribution)
    if (simulator is None) != (action is None) or (action is not None) > is_belief:
        raise ValueError(
            "expected a belief with simulator and action, or neither; got "
            f"{type(source).__name__}, simulator {simulator!r} and action {action}; "
            "pass both with a belief: a campaign predicts its own trials"
        )
    made = Groups(num_chains)
    num_samples -= num_samples % num_chains
    if hasattr(source, "tracing"):
        _add_report(made, source, num_samples, model, seed)
    elif is_belief:
        prior = getattr(source, "prior", None)
        draws = _add_belief(made, source, prior, parameter_names, num_samples, seed)
        if action is not None:
            made.coords["round"] = [*range(1, len(action) + 1)]
            _add_outcomes(made, simulator, draws, action, x, seed)
    elif hasattr(source, "history"):
        names = parameter_names or source.parameter_names
        pair = source.belief, source.prior
        reads = source.simulator is None
        draws = _add_belief(made, *pair, names, num_samples, seed, is_smooth=reads)
        _add_trials(made, source, draws, seed)
    else:
        raise TypeError(
            "expected a belief, a campaign or a report; got "
            f"{type(source).__name__}; pass one of these"
        )
    return data_tree(made)


def to_inference_data(source: Any, **options: Any) -> Any:
    """Return draws and data in ArviZ's format.

    Args:
        source: A belief, a campaign or a report.
        options: Options of :func:`to_datatree`, which says what is in which group.

    Returns:
        ``InferenceData`` of ArviZ 0.x, ``DataTree`` of 1.x.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> data = to_inference_data(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> data["posterior"]["theta"].dims
        ('chain', 'draw', 'parameter')
    """
    return inference_data(to_datatree(source, **options))


def _add_belief(
    made: Groups,
    belief: Distribution,
    prior: Distribution | None,
    names: Sequence[str] | None,
    num_samples: int,
    seed: int,
    *,
    is_smooth: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """Add posterior, its log density and the prior; return the draws of both.

    Some densities are simulated; a smooth one is not.
    """
    theta = draws_of(belief, num_samples, seed, "posterior")
    names = names_of(belief, theta.shape[1]) if names is None else names
    if len(names) != theta.shape[1]:
        raise ValueError(
            f"expected {theta.shape[1]} parameter names; got {[*names]}; "
            "give one a parameter"
        )
    made.coords["parameter"] = [*names]
    made.add("posterior", "theta", theta, ["parameter"])
    name = "smooth_log_prob" if is_smooth else "log_prob"
    log_prob = getattr(belief, name, belief.log_prob)
    made.add("sample_stats", "lp", log_prob(theta), [])
    if prior is None:
        return theta, None
    with forked_generators(seed, "prior"):
        before = prior.sample(torch.Size([num_samples]))
    made.add("prior", "theta", before, ["parameter"])
    return theta, before


def _add_trials(
    made: Groups, campaign: Campaign, draws: tuple[Tensor, Tensor | None], seed: int
) -> None:
    trials = [t for t in campaign.history if t.is_measured]
    if not trials:
        return
    made.coords["round"] = [t.index + 1 for t in trials]
    action = torch.stack([t.action for t in trials])
    x = torch.stack([t.x for t in trials if t.x is not None])
    space, channels = campaign.actions, campaign.channel_names
    named: Any = {"names": space.names, "units": space.units, "channels": channels}
    _add_outcomes(made, campaign.simulator, draws, action, x, seed, **named)


def _add_outcomes(
    made: Groups,
    simulator: Callable[..., Any] | None,
    draws: tuple[Tensor, Tensor | None],
    action: Tensor,
    x: Tensor | None,
    seed: int,
    *,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    channels: Sequence[str] | None = None,
) -> None:
    """Add what is predicted at actions, and what was measured there.

    Args:
        made: Groups to add to; the coordinate "round" numbers the actions.
        simulator: Simulator; None predicts nothing.
        draws: Draws of the posterior, and of the prior if it is known.
        action: Actions, shape (k, action_dim).
        x: Outcomes, shape (k, *x_shape); None if nothing was measured.
        seed: Seed of the simulations.
        names: Names of the action's entries; without any they are numbered.
        units: Units of the entries that have one.
        channels: Names of the channels; None takes the simulator's.
    """
    action = torch.as_tensor(action).reshape(len(action), -1).float()
    x = None if x is None else torch.as_tensor(x)
    names = names or [f"action_{i + 1}" for i in range(action.shape[1])]
    channels = channels or getattr(simulator, "channel_names", None)

    def rows(theta: Tensor) -> tuple[Tensor, Tensor]:
        return theta.repeat_interleave(len(action), 0), action.repeat(len(theta), 1)

    # Predictive and likelihood use the same draws of the posterior.
    values: dict[str, Tensor] = {}
    for group, theta in zip(("posterior", "prior"), draws, strict=True):
        if theta is not None and simulator is not None:
            key = "predictive" if group == "posterior" else "prior predictive"
            found = simulate(simulator, *rows(theta), seed=derive_seed(seed, key)).x
            values[group] = found.reshape(-1, len(action), *found.shape[1:])
    shape = values["posterior"].shape[2:] if x is None else x.shape[1:]
    dims = [f"x_dim_{i}" for i in range(len(shape))]
    if channels is not None and shape and len(channels) == shape[-1]:
        dims[-1] = "channel"
        made.coords["channel"] = [*channels]
    made.coords["action_entry"] = [*names]
    for group, outcomes in values.items():
        made.add(f"{group}_predictive", "x", outcomes, ["round", *dims])
    pairs = zip(names, units, strict=False)
    named = {f"unit_{name}": unit for name, unit in pairs if unit}
    made.add_data("constant_data", "action", action, ["round", "action_entry"], named)
    if x is None:
        return
    made.add_data("observed_data", "x", x, ["round", *dims])
    noise = getattr(simulator, "noise", None)
    if noise is not None:
        model: Any = simulator
        observed = x.repeat(len(draws[0]), *[1] * (x.ndim - 1))
        log_prob = noise.log_prob(observed, model.mean(*rows(draws[0])))
        made.add("log_likelihood", "x", log_prob.reshape(-1, len(x)), ["round"])


def _add_report(
    made: Groups, report: Any, num_samples: int, model: str | None, seed: int
) -> None:
    """Add the posterior of one of a report's models, and what the trials were."""
    evidences = report.tracing.evidences
    name = str(report.tracing.key) if model is None else model
    if name not in evidences:
        raise ValueError(
            f"expected a model among {', '.join(map(repr, evidences))}; got {name!r}; "
            "pass model="
        )
    found = evidences[name]
    rng = np.random.default_rng(derive_seed(seed, "report"))
    # Densities of trials go with the posterior that they made, not a widened one, which
    # is what the verdict's own model has to be used with.
    is_widened = found.narrow is not None and name == str(report.tracing.key)
    narrow = found.draws if is_widened or found.narrow is None else found.narrow
    draws = _spread(np.asarray(narrow), num_samples, rng)
    made.coords["parameter"] = [*found.names]
    made.add("posterior", "theta", draws, ["parameter"])
    residuals = report.residuals
    made.coords["round"] = [int(i) + 1 for i in residuals.index]
    told = residuals.action, torch.as_tensor(residuals.x)
    own = torch.as_tensor(draws), None
    _add_outcomes(made, None, own, *told, seed, names=report.action_labels)
    log_prob = _rival_log_likelihood(report, found, draws)
    if log_prob is not None and not is_widened:
        made.add("log_likelihood", "x", log_prob, ["round"])
    probabilities = report.probabilities
    made.coords["model"] = [*probabilities]
    values = np.array([*probabilities.values()])
    made.add_data("constant_data", "probability", values, ["model"])
    made.attrs.update(model=name, verdict=report.verdict)
    made.attrs["log_evidence"] = float(found.log_evidence)


def _spread(draws: np.ndarray, num: int, rng: np.random.Generator) -> np.ndarray:
    r"""Return draws of which none repeats, by a kernel that keeps mean and covariance.

    A weighted sample that was resampled repeats its points, as do more draws than
    there are, and tails of ties have no Pareto shape. With h Silverman's width for the
    points that differ,

    .. math::
        \theta' = \bar\theta + \sqrt{1 - h^2}\, (\theta - \bar\theta) + h L z .
    """
    different = len(np.unique(draws, axis=0))
    repeats = different < max(len(draws), num)
    picked = draws[rng.choice(len(draws), size=num, replace=repeats)]
    dim = draws.shape[1]
    if not repeats or different <= dim:
        return picked
    h = (4 / ((dim + 2) * different)) ** (1 / (dim + 4))
    h = min(h, 1.0)
    mean = draws.mean(0)
    values, vectors = np.linalg.eigh(np.cov(draws.T).reshape(dim, dim))
    noise = rng.normal(size=(num, dim)) * np.sqrt(np.clip(values, 0, None))
    spread = mean + np.sqrt(1 - h**2) * (picked - mean) + h * noise @ vectors.T
    return np.clip(spread, draws.min(0), draws.max(0))


def _rival_log_likelihood(report: Any, found: Any, draws: np.ndarray) -> Any:
    """Return the log likelihood of each trial under a rival, shape (n, t).

    None if it is more than the simulator, effects and declared noise: a residual
    process, an unknown size of noise, nuisances of single trials.
    """
    simulator, key = report.simulator, found.key
    effects = {e.name: e for e in getattr(simulator, "effects", ())}
    used = [effects[name] for name in key.effects if name in effects]
    plain = len(used) == len(key.effects)
    plain &= all(e.scope == "campaign" and e.hook != "noise" for e in used)
    own = len(getattr(simulator, "base", simulator).parameter_names or ())
    size = own + sum(e.phi_dim for e in used)
    noise = simulator.noise if report.residuals.noise == "declared" else None
    is_whole = key.error is None and report.tracing.misfit is None
    if noise is None or not (plain and is_whole and draws.shape[1] == size):
        return None
    theta = torch.as_tensor(draws, dtype=torch.float32)
    x = torch.as_tensor(np.asarray(report.residuals.x)).double()
    action = torch.as_tensor(report.residuals.action).float()
    phi, first = {}, own
    for effect in used:
        phi[effect.name] = theta[:, first : first + effect.phi_dim]
        first += effect.phi_dim
    terms = []
    for k in range(len(x)):
        given = theta[:, :own], action[k].expand(len(theta), -1)
        if effects:
            place = torch.full((len(theta),), float(report.residuals.index[k]))
            mean = simulator.evaluate(given[0], phi, given[1], context=Context(place))
        else:
            mean = simulator.mean(*given)
        terms.append(noise.log_prob(x[k].expand(mean.shape), mean.double()))
    return torch.stack(terms, 1)
