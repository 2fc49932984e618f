"""Sequential Bayesian experimental design by ratio estimation at single parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from sbi.sbi_types import Tracker
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self

from sbi_active.expected import require
from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.beliefs.weighted import KernelBelief
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.models.lfire import LFIRE, LFIREModel, fit_log_ratios
from sbi_active.inference.rounds.rows import Observation, require_whole
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.messages import warn
from sbi_active.simulation.outcomes import Simulations
from sbi_active.threads import single_thread


class SeqBED_LFIRE(ActiveInference):  # noqa: N801 - as NRE_B
    r"""Sequential Bayesian experimental design for implicit models.

    A belief is a set of particles. For each of them and each candidate action, LFIRE
    separates outcomes at the particle from outcomes of all; the mean log ratio is the
    utility of the action, and the ratio at the real outcome weighs the particle:

    .. math::
        U(\xi) = E\!\left[\log r(x, \theta | \xi)\right], \qquad
        w_i \propto r(x_o, \theta_i | \xi^*), \qquad
        r = \frac{p(x | \theta, \xi)}{p(x | \xi)}.

    Particles of a round are drawn from the belief, Gaussian kernels around the weighted
    particles of the last one, where the original redraws them once the effective sample
    size falls below half: one informative trial leaves far less. What distinguishes
    the method is its cost: every particle needs simulations of its own.
    :class:`.SeqBED` shares them.

    Without a simulator, the belief after ``update`` is kernels around the weighted
    particles; its diagnostics tell their effective number.

    Args:
        prior: The prior over parameters, with a support.
        settings: Settings of the logistic regressions; None is ``LFIRE()``.
        num_particles: Particles of a round; None makes as many as each has simulations.
        tracker: Tracker, which is not used: no network is trained.
        show_progress_bars: Flag that is not used.

    References:
        Kleinegesse, Drovandi & Gutmann, Bayesian Analysis 2021, arXiv:2003.09379.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(-torch.ones(1), torch.ones(1))
        >>> inference = SeqBED_LFIRE(prior)
        >>> theta, action = inference.arrange(prior.sample((400,)), torch.ones(400, 1))
        >>> x = theta + 0.3 * torch.randn_like(theta)
        >>> _ = inference.append_simulations(theta, x, action=action).train()
        >>> belief = inference.update(torch.tensor([0.5]), action=torch.ones(1))
        >>> bool((belief.mean - 0.5).abs() < 0.25)
        True
    """

    amortized = False
    _prior: Distribution

    def __init__(
        self,
        prior: Distribution,
        settings: LFIRE | None = None,
        *,
        num_particles: int | None = None,
        tracker: Tracker | None = None,
        show_progress_bars: bool = False,
    ) -> None:
        self._prior = require_support(prior)
        self._settings = LFIRE() if settings is None else settings
        given = 2 if num_particles is None else num_particles
        require(given >= 2, "num_particles >= 2", given, "use about 50")
        self._num_particles = num_particles
        self._rows: list[Simulations] = []
        self._model: LFIREModel | None = None
        self.trials = []

    def arrange(self, theta: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return every action with every particle, several times each.

        Args:
            theta: Draws from the belief, shape (n, theta_dim); the first are particles.
            action: Draws from the action space, shape (n, action_dim); the different
                ones among them are the candidates.

        Returns:
            At most n rows of parameters and of actions.

        Raises:
            ValueError: If n is too small.
        """
        candidates = action.unique(dim=0)
        share = len(theta) // len(candidates)
        num = self._num_particles or math.isqrt(share)
        repeats = share // max(num, 1)
        fewest = 2 * self._settings.num_folds
        require(
            repeats >= fewest,
            f"at least {fewest} simulations of each particle at each action",
            f"{repeats}, of {len(theta)} in all at {len(candidates)} different actions "
            f"and {num} particles",
            "allow more simulations, or fewer actions",
        )
        particles = theta[:num]
        return (
            particles.repeat_interleave(repeats, 0).repeat(len(candidates), 1),
            candidates.repeat_interleave(num * repeats, 0),
        )

    def append_simulations(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        action: Tensor | None = None,
        belief: Distribution | None = None,
    ) -> Self:
        """Store simulations of this round, see :meth:`arrange`.

        Args:
            theta: Particles, each of them several times, shape (n, theta_dim).
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            action: Actions, shape (n, action_dim).
            belief: The distribution of the particles; None is the current belief.
        """
        if action is None:
            raise ValueError(
                "expected action=, since ratios belong to an action; got none; pass "
                "the action of each row"
            )
        require_whole(x)
        rows, is_new = self._new_rows(theta, x, action, belief, exclude_invalid=False)
        kept = [] if is_new else self._rows
        self._rows = [*kept, replace(rows, x=rows.x.clone())]
        self._model = None
        return self

    def train(self, *, seed: int | None = None) -> LFIREModel:
        """Fit the log ratio of every particle at every action.

        Args:
            seed: Seed of the cross-validation's folds and the choice of marginal rows;
                None draws one from torch's global generator.

        Raises:
            RuntimeError: If there are no simulations.
            ValueError: If a particle has too few.
        """
        if not self._rows:
            raise RuntimeError(
                "expected simulations of this round; got none; append_simulations()"
            )
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        with single_thread():
            self._model = fit_log_ratios(self._settings, self._rows, seed)
        return self._model

    def build_posterior(self) -> LFIREModel:
        """Return the log ratios of this round's particles."""
        if self._model is None:
            raise RuntimeError(
                "expected log ratios of this round; got new rows since the last "
                "train(), or none; call train() first"
            )
        return self._model

    def _forget_round(self) -> None:
        self._model, self._rows = None, []

    def _learned(
        self,
        trials: Sequence[Observation],
        settings: RefinementOptions,
        seed: int | None,
        *,
        required: bool,
    ) -> Belief | None:
        """Return particles weighted by the last trial, where they are required."""
        if not required:
            return None
        trial, model = trials[-1], self.build_posterior()
        require_whole(trial.x[None])
        particles, action = model.particles, model.nearest_action(trial.action)
        if not torch.equal(action, trial.action):
            warn(
                f"SA108 the executed action {trial.action.tolist()} was not "
                f"simulated; the ratios are those at {action.tolist()}. Pass a "
                "simulator to update()."
            )
        n, warnings = len(particles), []
        rows = trial.x.expand(n, *trial.x.shape), action.expand(n, -1)
        log_ratio = model.log_ratio(particles, *rows)
        if not bool(log_ratio.isfinite().any()):  # beyond 1e19 float32 has no squares
            log_ratio = torch.zeros_like(log_ratio)
            warnings.append(
                "SA113 the ratios are finite nowhere at the last trial, which is left "
                "out: a measurement is wrong, or the simulator lacks much"
            )
        weight = log_ratio.nan_to_num(-torch.inf).softmax(0)
        belief = KernelBelief(self._prior, particles, weight)
        belief.label = "weighted particles"
        effective = float(1 / weight.square().sum())
        if effective < 0.1 * n:
            warnings.append(
                f"SA114 {effective:.1f} of {n} particles are effective: the belief is "
                "as wide as its kernels"
            )
        known = belief.diagnostics.extended(num_particles=n)
        belief.diagnostics = known.warned(*warnings)
        return belief
