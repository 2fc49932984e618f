"""Posterior of the box collision by importance sampling, at the cost of simulations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.inference.engine.potential import MeanTable, SimulatedLikelihood
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.workers.settings import IN_PROCESS
from sbi_active.tasks.reference import SampledPosterior

if TYPE_CHECKING:
    from sbi_active.tasks.box_collision.task import BoxCollisionTask

__all__ = ["BoxCollisionReference", "exact_posterior"]


def exact_posterior(
    task: BoxCollisionTask,
    trials: Sequence[Any],
    *,
    num_particles: int = 500,
    seed: int = 0,
) -> BoxCollisionReference:
    """Return the posterior of a campaign's trials, nearly exact.

    Args:
        task: Task with noise > 0.
        trials: Trials with ``action`` (1,), ``x`` (3,) and ``status``; those that are
            missing or pending are left out.
        num_particles: Effective draws to reach, see :class:`.SampledPosterior`.
        seed: Seed of the draws.

    Example:
        >>> from sbi_active.campaign import Trial
        >>> from sbi_active.tasks import get_task
        >>> task = get_task("box_collision")
        >>> x = task.real_system(torch.tensor([5.0]), seed=0)
        >>> trial = Trial(0, torch.tensor([5.0]), x, "ok")
        >>> posterior = exact_posterior(task, [trial], num_particles=20)
        >>> bool(posterior.log_evidence_se < 0.2)
        True
    """
    used = [t for t in trials if t.status in ("ok", "invalid")]
    return BoxCollisionReference(
        task.simulator,
        torch.stack([t.action for t in used]) if used else torch.empty(0, 1),
        torch.stack([t.x for t in used]) if used else torch.empty(0, 3),
        num_effective=num_particles,
        seed=seed,
    )


class BoxCollisionReference(SampledPosterior):
    r"""The posterior :math:`p(\theta \mid \mathcal D)` of the declared noise.

    A trial off the table counts as 1 where the simulator leaves it too, else as 0.

    Args:
        simulator: Simulator of the task, with Gaussian noise of standard deviation > 0.
        action: Speeds, shape (t, 1); t = 0 gives the prior.
        x: Outcomes, shape (t, 3); NaN throughout off the table.
        num_effective: Effective draws to reach.
        most: Draws at the full likelihood at most, of one simulation a trial.
        seed: Seed of the draws.

    Attributes:
        num_simulations: Simulations so far, those of densities included.

    Raises:
        ValueError: If the noise is 0, the shapes do not fit, or no draw explains the
            trials.
    """

    def __init__(
        self,
        simulator: SimulatorModel,
        action: Tensor,
        x: Tensor,
        *,
        num_effective: int = 500,
        most: int = 20_000,
        seed: int = 0,
    ) -> None:
        noise = simulator.noise
        if noise is None or not bool((noise.parameters > 0).all()):
            raise ValueError(
                "expected noise > 0, without which there is no posterior density; got "
                "0; choose get_task('box_collision', noise=0.005)"
            )
        action, x = action.reshape(-1, 1), torch.as_tensor(x)
        if len(x) != len(action) or (len(x) and x.shape[1:] != (3,)):
            raise ValueError(
                "expected action (t, 1) and x (t, 3); got "
                f"{tuple(action.shape)} and {tuple(x.shape)}; give one row a trial"
            )
        self._table = MeanTable(simulator, IN_PROCESS)
        super().__init__(
            BoxUniform(torch.zeros(3), torch.ones(3)),
            SimulatedLikelihood(self._table, action, x),
            num_effective=num_effective,
            num_draws=400,
            most=most,
            seed=seed,
        )

    @property
    def num_simulations(self) -> int:
        """Simulations so far, those of densities included."""
        return self._table.num_simulations
