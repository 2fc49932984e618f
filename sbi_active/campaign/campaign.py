"""Ask, tell, update: the one loop behind the command line and the benchmarks."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.state import CampaignOptions, CampaignState, Status, Trial
from sbi_active.designer import InformationGainDesigner, RandomDesigner
from sbi_active.inference import ASBI, information_gained
from sbi_active.inference.belief import require_support
from sbi_active.inference.condition import action_rows, outcome_rows
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

__all__ = ["METHODS", "Campaign"]

#: Name of a method: whether its actions are designed.
METHODS = {"asbi": True, "nsbi": False}


class Campaign:
    r"""Estimate a simulator's parameters from a few real trials.

    A round: :meth:`ask` for an action, execute it, :meth:`tell` the outcome.
    ``tell`` only records; inference runs in the next ``ask`` or in :meth:`update`.

    Args:
        simulator: ``simulator(theta, action)``, shapes (n, theta_dim) and
            (n, action_dim), giving x of shape (n, *x_shape).
        prior: Over the parameters, with a support.
        actions: What the robot may do.
        method: "asbi" designs actions, "nsbi" draws them at random.
        seed: Of everything random; the same seed and outcomes give the same campaign.
        options: Sizes and estimators.

    Raises:
        ValueError: If the method is unknown, the prior has no support, or the
            simulator is deterministic.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import DiscreteActions, MixtureDensity
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> def simulator(theta, action):
        ...     return theta * action + 0.1 * torch.randn_like(theta)
        >>> options = CampaignOptions(
        ...     num_simulations=500,
        ...     density_estimator=MixtureDensity(num_iterations=50))
        >>> actions = DiscreteActions([0.1, 1.0, 3.0])
        >>> campaign = Campaign(simulator, prior, actions, options=options)
        >>> trial = campaign.ask()
        >>> trial.action
        tensor([3.])
        >>> _ = campaign.tell(torch.tensor([1.5]))
        >>> belief = campaign.update()
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        *,
        method: str = "asbi",
        seed: int = 0,
        options: CampaignOptions | None = None,
    ) -> None:
        if method not in METHODS:
            raise ValueError(
                f"expected method to be one of {', '.join(map(repr, METHODS))}; got "
                f"{method!r}; do choose one of these"
            )
        self.simulator = simulator
        self.prior = require_support(prior)
        self.actions = actions
        options = CampaignOptions() if options is None else options
        self.state = CampaignState(method=method, seed=seed, options=options)
        self._inference = ASBI(
            prior, options.density_estimator, show_progress_bars=False
        )
        self._designer = (
            InformationGainDesigner(
                actions,
                num_samples=options.num_samples,
                estimator=options.estimator,
                eliminate=options.eliminate,
            )
            if METHODS[method]
            else RandomDesigner(actions)
        )
        self._x_shape = self._probe()
        self._round_ready = False

    def __repr__(self) -> str:
        done, pending = len(self.history), self.pending is not None
        return (
            f"Campaign({self.state.method}, {done} trials"
            f"{', one pending' if pending else ''})"
        )

    @property
    def belief(self) -> Distribution:
        """The belief after the trials in ``state.processed``; the prior before any."""
        belief = self._inference.belief
        assert belief is not None
        return belief

    @property
    def history(self) -> Sequence[Trial]:
        """The trials that were told, in order."""
        return tuple(t for t in self.state.trials if t.status != "pending")

    @property
    def pending(self) -> Trial | None:
        """The trial that was asked for and not told yet."""
        waiting = [t for t in self.state.trials if t.status == "pending"]
        return waiting[0] if waiting else None

    def ask(self) -> Trial:
        """Return the pending trial, or design the next one.

        Returns:
            The trial; execute ``trial.action``.
        """
        if self.pending is not None:
            return self.pending
        self.update()
        index = len(self.state.trials)
        trial = Trial(index, torch.empty(0))
        self.state.trials.append(trial)
        try:
            model = self._trained(index) if METHODS[self.state.method] else None
            with self._stage(index, "design"):
                design = self._designer.select(
                    model,
                    self.simulator,
                    belief=self.belief,
                    seed=derive_seed(self.state.seed, "design", index),
                )
            self._change(
                index,
                action=design.action,
                design=design,
                num_simulations=self.state.trials[index].num_simulations
                + design.num_simulations,
            )
        except BaseException:
            self.state.trials.pop()
            raise
        return self.state.trials[index]

    def tell(
        self,
        x: Tensor | np.ndarray | float | Sequence[float] | None = None,
        *,
        trial: Trial | int | None = None,
        action: Tensor | np.ndarray | Sequence[float] | None = None,
        status: Status = "ok",
    ) -> Trial:
        """Record the outcome of a trial and return at once.

        Args:
            x: The outcome, shape x_shape; NaN throughout makes the trial "invalid", NaN
                in part of it says that these numbers were not observed.
            trial: The trial or its index; None is the pending one, or a new trial
                where none is pending and ``action`` is given.
            action: The executed action where it is not the one asked for.
            status: "ok", "invalid" (it ran and gave no measurement, which tells about
                the parameters) or "missing" (a fault unrelated to them).

        Returns:
            The recorded trial. Telling the same outcome again changes nothing.

        Raises:
            ValueError: If there is no such trial, shapes do not fit, or another
                outcome was recorded for it.
        """
        if status not in ("ok", "invalid", "missing"):
            raise ValueError(
                f"expected status 'ok', 'invalid' or 'missing'; got {status!r}; do "
                "choose one of these"
            )
        target = self._trial_to_tell(trial, action)
        outcome = self._outcome(x, status)
        if outcome is not None and not bool(outcome.isfinite().any()):
            status = "invalid"
        executed = target.action
        if action is not None:
            row = torch.as_tensor(np.asarray(action), dtype=torch.float32)
            executed = action_rows(row, self.actions.action_dim, num_rows=1)[0]
        if not bool(self.actions.contains(executed)):
            warnings.warn(
                f"the executed action {executed.tolist()} is not in {self.actions}; it "
                "is simulated where it was executed",
                stacklevel=2,
            )
        told = replace(target, action=executed, x=outcome, status=status)
        if target.status != "pending":
            if not _same_outcome(target, told):
                raise ValueError(
                    f"expected no second outcome for trial {target.index}; got another "
                    "one than the one recorded; do tell(x, action=...) to record a "
                    "further trial"
                )
            return target
        if target.index == len(self.state.trials):
            self.state.trials.append(told)
        self.state.trials[target.index] = told
        return told

    def update(self) -> Distribution:
        """Bring the belief up to date with every trial told so far, and return it."""
        for trial in self.history:
            if trial.index in self.state.processed:
                continue
            if trial.status != "missing":
                self._learn_from(trial)
            self.state.processed.append(trial.index)
        return self.belief

    def run(
        self,
        real_system: Callable[[Tensor], Any],
        *,
        num_rounds: int,
        on_round: Callable[[Trial], None] | None = None,
    ) -> Distribution:
        """Run rounds on a real system that can be called.

        An exception of the real system passes through; the trial stays pending, and
        the next ``run`` goes on with it.

        Args:
            real_system: Takes an action, shape (action_dim,), and gives x.
            num_rounds: Trials to run.
            on_round: Called with each trial once the belief contains it.

        Returns:
            The belief after the last trial.
        """
        for _ in range(num_rounds):
            index = self.ask().index
            self.tell(real_system(self.state.trials[index].action), trial=index)
            self.update()
            if on_round is not None:
                on_round(self.state.trials[index])
        return self.belief

    def _learn_from(self, trial: Trial) -> None:
        assert trial.x is not None
        self._trained(trial.index)
        before = self.belief
        seed, options = self.state.seed, self.state.options
        with self._stage(trial.index, "update"):
            with forked_generators(seed, "update", trial.index):
                belief = self._inference.update(
                    trial.x,
                    action=trial.action,
                    simulator=self.simulator if options.refine else None,
                    refinement=replace(options.refinement, **options.engine),
                    seed=derive_seed(seed, "refine", trial.index),
                )
            gained = information_gained(
                belief, before, seed=derive_seed(seed, "gain", trial.index)
            )
        diagnostics, trial = belief.diagnostics, self.state.trials[trial.index]
        self._round_ready = False
        self._change(
            trial.index,
            information_gained=gained,
            num_simulations=(
                trial.num_simulations + diagnostics.get("num_simulations", 0)
            ),
            num_missing=trial.num_missing + diagnostics.get("num_missing", 0),
        )

    def _trained(self, index: int) -> Any:
        """Return the posterior trained under the current belief, training if needed."""
        if not self._round_ready:
            seed, options = self.state.seed, self.state.options
            with self._stage(index, "simulation"):
                with forked_generators(seed, "theta", index):
                    theta = self.belief.sample((options.num_simulations,))
                action = self.actions.sample(
                    (options.num_simulations,), seed=derive_seed(seed, "action", index)
                )
                rows = simulate(
                    self.simulator,
                    theta,
                    action,
                    seed=derive_seed(seed, "x", index),
                    **options.engine,
                )
                known = rows.without_missing()
            with self._stage(index, "training"):
                self._inference.append_simulations(
                    known.theta, known.x, action=known.action, belief=self.belief
                )
                with forked_generators(seed, "train", index):
                    self._inference.train()
            trial = self.state.trials[index]
            self._change(
                index,
                num_simulations=trial.num_simulations + len(rows),
                num_missing=trial.num_missing + rows.counts["missing"],
            )
            self._round_ready = True
        return self._inference.build_posterior()

    def _probe(self) -> torch.Size:
        """Return x_shape from a few simulations, which must differ by seed."""
        seed = self.state.seed
        with forked_generators(seed, "probe"):
            theta = self.prior.sample((16,))
        action = self.actions.sample((16,), seed=derive_seed(seed, "probe"))
        rows = simulate(
            self.simulator,
            theta,
            action,
            seed=derive_seed(seed, "probe", 1),
            check_noise=True,
            **self.state.options.engine,
        )
        return rows.x.shape[1:]

    def _trial_to_tell(self, trial: Trial | int | None, action: Any) -> Trial:
        if trial is None:
            if self.pending is not None:
                return self.pending
            if action is None:
                raise ValueError(
                    "expected a pending trial; got none; do ask() first, or pass "
                    "action= to record a trial that was not asked for"
                )
            return Trial(len(self.state.trials), torch.empty(0))
        index = trial.index if isinstance(trial, Trial) else trial
        if not 0 <= index < len(self.state.trials):
            raise ValueError(
                f"expected the index of one of {len(self.state.trials)} trials; got "
                f"{index}; do pass the trial that ask() returned"
            )
        return self.state.trials[index]

    def _outcome(self, x: Any, status: Status) -> Tensor | None:
        if status == "missing":
            return None
        if status == "invalid":  # numbers told along with it are no measurement
            return torch.full(self._x_shape, torch.nan)
        if x is None:
            raise ValueError(
                "expected the outcome x; got None; do tell(x), or tell(status=...) "
                "with 'invalid' or 'missing' where there is none"
            )
        tensor = x if isinstance(x, Tensor) else torch.as_tensor(np.asarray(x))
        if (
            tensor.shape != self._x_shape
            and tensor.numel() == self._x_shape.numel() == 1
        ):
            tensor = tensor.reshape(self._x_shape)
        return outcome_rows(tensor, self._x_shape)[0]

    def _change(self, index: int, **changes: Any) -> None:
        self.state.trials[index] = replace(self.state.trials[index], **changes)

    @contextmanager
    def _stage(self, index: int, name: str) -> Iterator[None]:
        """Add the time spent in the block to a trial's account."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        trial = self.state.trials[index]
        seconds, cpu_seconds = dict(trial.seconds), dict(trial.cpu_seconds)
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - wall
        cpu_seconds[name] = cpu_seconds.get(name, 0.0) + time.process_time() - cpu
        self._change(index, seconds=seconds, cpu_seconds=cpu_seconds)


def _same_outcome(a: Trial, b: Trial) -> bool:
    if a.status != b.status or not torch.equal(a.action, b.action):
        return False
    if a.x is None or b.x is None:
        return a.x is b.x
    return bool(torch.allclose(a.x, b.x, equal_nan=True))
