"""Export to ArviZ, of both generations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arviz_versions import Groups, data_tree, inference_data
from sbi_active.inference.beliefs.belief import names_of
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

if TYPE_CHECKING:
    from sbi_active.campaign import Campaign
    from sbi_active.criticism import Report

NUM_CHAINS = 4


def to_inference_data(
    source: Distribution | Campaign | Report | Mapping[str, Any],
    *,
    parameter_names: Sequence[str] | None = None,
    num_samples: int = 2_000,
    num_chains: int = NUM_CHAINS,
    model: str | None = None,
    seed: int = 0,
) -> Any:
    """Return draws and data in ArviZ's format.

    Groups of a belief: posterior, sample_stats (the log density ``lp`` of each draw),
    and prior where the belief knows it. A campaign adds posterior_predictive,
    prior_predictive and observed_data (one outcome a trial), constant_data (actions)
    and log_likelihood (where the simulator's noise has a density); the predictive ones
    and the likelihood where it was loaded with its simulator, without which ``lp`` is
    by kernels where it would be simulated. A report has the
    posterior of its verdict's model, or of ``model``. A benchmark run is a dict of
    variables, each of shape (draws,) or (draws, parameters): its rows as draws.

    Draws are independent; they are split over chains, so that r_hat and ess are
    defined. Coordinates name parameters, rounds, channels and entries of the action,
    which carry their units as attributes.

    Args:
        source: A belief, a campaign, a report, or a dict of arrays.
        parameter_names: Names of the parameters; None takes the simulator's, which
            beliefs remember, else theta_1, ...
        num_samples: Draws of all chains together.
        num_chains: Number of chains; draws that do not fill all are left out.
        model: Model of a report, by a name among ``report.tracing.evidences``.
        seed: Seed of the draws.

    Returns:
        ``InferenceData`` of ArviZ 0.x, ``DataTree`` of 1.x.

    Raises:
        ValueError: If names do not fit, chains are more than half of the draws, or a
            report has no such model.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> data = to_inference_data(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> data["posterior"]["theta"].dims
        ('chain', 'draw', 'parameter')
    """
    return inference_data(
        _groups(source, parameter_names, num_samples, num_chains, model, seed)
    )


def to_datatree(
    source: Distribution | Campaign | Report | Mapping[str, Any],
    *,
    parameter_names: Sequence[str] | None = None,
    num_samples: int = 2_000,
    num_chains: int = NUM_CHAINS,
    model: str | None = None,
    seed: int = 0,
) -> Any:
    """Return draws and data as an xarray ``DataTree``, which ArviZ 1.x takes.

    It needs xarray alone, so that one Python may write what another one reads: by
    ``to_netcdf``, or ``to_zarr``.

    Args:
        source: Belief, campaign, report or dict of arrays, as for
            :func:`to_inference_data`.
        parameter_names: Names of the parameters.
        num_samples: Draws of all chains together.
        num_chains: Number of chains.
        model: Model of a report, by its name.
        seed: Seed of the draws.
    """
    return data_tree(
        _groups(source, parameter_names, num_samples, num_chains, model, seed)
    )


def _groups(
    source: Any,
    names: Sequence[str] | None,
    num_samples: int,
    num_chains: int,
    model: str | None,
    seed: int,
) -> Groups:
    if not 1 <= num_chains <= num_samples // 2:
        raise ValueError(
            "expected at least two draws a chain; got "
            f"{num_samples} draws in {num_chains} chains; raise num_samples"
        )
    made = Groups(num_chains)
    num_samples -= num_samples % num_chains
    if isinstance(source, Mapping):
        _add_rows(made, source)
    elif hasattr(source, "tracing"):
        _add_report(made, source, num_samples, model, seed)
    elif isinstance(source, Distribution):
        prior = getattr(source, "prior", None)
        _add_belief(made, source, prior, names, num_samples, seed)
    elif hasattr(source, "history"):
        if names is None:
            names = source.parameter_names
        pair = source.belief, source.prior
        reads = source.simulator is None
        theta, before = _add_belief(
            made, *pair, names, num_samples, seed, is_smooth=reads
        )
        assert before is not None
        _add_trials(made, source, theta, before, seed)
    else:
        raise TypeError(
            "expected a belief, a campaign, a report or a dict of arrays; got "
            f"{type(source).__name__}; pass one of these"
        )
    return made


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
    with forked_generators(seed, "posterior"):
        theta = belief.sample(torch.Size([num_samples]))
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
    made: Groups, campaign: Campaign, theta: Tensor, before: Tensor, seed: int
) -> None:
    trials = [t for t in campaign.history if t.is_measured]
    if not trials:
        return
    action = torch.stack([t.action for t in trials])
    x = torch.stack([t.x for t in trials if t.x is not None])
    dims = [f"x_dim_{i}" for i in range(x.ndim - 1)]
    channels = campaign.channel_names
    if channels is not None and x.ndim > 1 and len(channels) == x.shape[-1]:
        dims[-1] = "channel"
        made.coords["channel"] = [*channels]
    made.coords["round"] = [t.index + 1 for t in trials]
    made.coords["action_entry"] = [*campaign.actions.names]
    shape = (len(theta), len(trials))
    # Predictive and likelihood use the same draws of the posterior.
    predicted = () if campaign.simulator is None else ("posterior", "prior")
    for group, draws in zip(predicted, (theta, before), strict=False):
        pairs = draws.repeat_interleave(len(trials), 0), action.repeat(len(draws), 1)
        key = "predictive" if group == "posterior" else "prior predictive"
        rows = simulate(campaign.simulator, *pairs, seed=derive_seed(seed, key))
        values = rows.x.reshape(*shape, *x.shape[1:])
        made.add(f"{group}_predictive", "x", values, ["round", *dims])
    made.add_data("observed_data", "x", x, ["round", *dims])
    units = {
        f"unit_{name}": unit
        for name, unit in zip(
            campaign.actions.names, campaign.actions.units, strict=True
        )
        if unit
    }
    made.add_data("constant_data", "action", action, ["round", "action_entry"], units)
    noise = getattr(campaign.simulator, "noise", None)
    if noise is not None:
        simulator: Any = campaign.simulator
        pairs = theta.repeat_interleave(len(trials), 0), action.repeat(len(theta), 1)
        observed = x.repeat(len(theta), *[1] * (x.ndim - 1))
        log_prob = noise.log_prob(observed, simulator.mean(*pairs)).reshape(shape)
        made.add("log_likelihood", "x", log_prob, ["round"])


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
    made.coords["action_entry"] = [*report.action_labels]
    x = np.asarray(residuals.x)
    dims = [f"x_dim_{i}" for i in range(x.ndim - 1)]
    made.add_data("observed_data", "x", x, ["round", *dims])
    pair = ["round", "action_entry"]
    made.add_data("constant_data", "action", residuals.action, pair)
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
            mean = simulator.evaluate(given[0], phi, given[1], index=place)
        else:
            mean = simulator.mean(*given)
        terms.append(noise.log_prob(x[k].expand(mean.shape), mean.double()))
    return torch.stack(terms, 1)


def _add_rows(made: Groups, rows: Mapping[str, Any]) -> None:
    """Add a benchmark's rows as draws; texts are left out."""
    for name, values in rows.items():
        array = np.asarray(values)
        if array.dtype.kind not in "biuf" or array.ndim == 0:
            continue
        if len(array) < 2 * made.num_chains:
            raise ValueError(
                f"expected at least {2 * made.num_chains} rows; got {len(array)}; lower"
                " num_chains"
            )
        dims = [f"{name}_dim_{i}" for i in range(array.ndim - 1)]
        made.add("posterior", str(name), array.astype(float), dims)
    if not made.variables:
        raise ValueError("expected columns of numbers; got none; pass arrays of rows")
