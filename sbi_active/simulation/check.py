"""Look a simulator over before a campaign spends hours on it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.discrete import Actions, action_space
from sbi_active.identifiability.sensitivities import ProbeSettings
from sbi_active.identifiability.undetermined import Undetermined, find_undetermined
from sbi_active.messages import Message
from sbi_active.renamed import takes_loose
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.model import SimulatorModel, takes_seeds
from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    SimulationError,
    Simulations,
)
from sbi_active.simulation.simulator import require_noise
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers

MIN_ROWS = 16  # a choice: of the first runs, which are timed
RUNS = 12  # of all rows, beside three a parameter and one an entry of the action
ROUNDING = 1e-5  # relative difference between batches that mixes no rows
MANY = 0.5  # share of rows without a measurement that is worth a word


@dataclass(frozen=True)
class SimulatorReport:
    """Findings about a simulator; ``print`` shows them.

    Attributes:
        facts: Shape of x, where random numbers come from, outcomes, and times.
        warnings: Warnings of what deserves a look.
        defects: Defects that keep a campaign from working.
        undetermined: Parameters that no permitted action tells apart, as far as was
            tried, and the combinations of them that actions do determine.
    """

    facts: tuple[str, ...]
    warnings: tuple[Message, ...]
    defects: tuple[Message, ...]
    undetermined: tuple[Undetermined, ...] = ()

    @property
    def is_ready(self) -> bool:
        """Whether nothing was found that keeps a campaign from working."""
        return not self.defects

    def __str__(self) -> str:
        told = [f"warning: {text}" for text in self.warnings]
        told += [f"defect: {text}" for text in self.defects]
        return "\n".join(
            [*self.facts, *told, "ready" if self.is_ready else "not ready"]
        )

    __repr__ = __str__


@takes_loose(workers=Workers)
def check_simulator(
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: Actions,
    *,
    num_rows: int = 256,
    max_seconds: float = 60.0,
    num_simulations: int | None = None,
    workers: Workers | int | None = None,
    seed: int = 0,
) -> SimulatorReport:
    """Run a simulator over draws of the prior and report its defects before a campaign.

    A defect keeps a campaign from working: the simulator raises, gives rows of another
    number or shape, is deterministic, has no measurement at all, mixes its rows, or
    depends on no parameter. Everything else is a warning, such as parameters that no
    permitted action tells apart, see :func:`.find_undetermined`.

    Args:
        simulator: ``simulator(theta, action)``, see
            :class:`.Simulator`.
        prior: Prior of the parameters.
        actions: Actions that the robot may take; the values of a discrete space are all
            run.
        num_rows: Rows a check, at least 16.
        max_seconds: Seconds of simulation time; a slow simulator gets fewer rows, 16 at
            least.
        num_simulations: Simulations that the campaign needs, to tell their time.
        workers: Workers of the campaign, or the number of calls at a time.
        seed: Seed of the draws.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import DiscreteActions
        >>> report = check_simulator(
        ...     lambda theta, action: theta[:, :1] * action,
        ...     BoxUniform(torch.zeros(2), torch.ones(2)), DiscreteActions([1.0, 2.0]),
        ... )
        >>> report.is_ready, *report.warnings
        (False, 'changing theta_2 leaves x as it is (SA303)')
    """
    check = _Check(simulator, prior, action_space(actions), seed)
    try:
        num_runs = RUNS + 3 * prior.event_shape[0] + check.actions.action_dim
        affordable = int(max_seconds / num_runs / (check.look() + 1e-9))
        seconds = check.compare(max(MIN_ROWS, min(num_rows, affordable)))
        if num_simulations is not None:
            num = Workers.of(workers).num_workers
            took = timedelta(seconds=round(num_simulations * seconds / num))
            check.facts.append(
                f"campaign: at most {num_simulations:,} simulations, about {took} h on "
                f"{num} worker{'s' * (num > 1)} for them, and some to learn"
            )
    except ValueError as error:
        check.defects.append(str(error))
    except SimulationError as error:  # its last line is its code
        check.defects.append(str(error).splitlines()[-2])
    return SimulatorReport(
        (*check.facts,),
        tuple(map(Message, check.warnings)),
        tuple(map(Message, check.defects)),
        check.undetermined,
    )


class _Check:
    """A look at a simulator, whose draws and runs share their seeds.

    Attributes:
        facts: Facts so far.
        warnings: Warnings so far.
        defects: Defects so far.
        undetermined: Parameters that no action tells apart.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        seed: int,
    ) -> None:
        self.simulator, self.prior = simulator, prior
        self.actions, self.seed = actions, seed
        self.facts: list[str] = []
        self.warnings: list[str] = []
        self.defects: list[str] = []
        self.undetermined: tuple[Undetermined, ...] = ()

    def draw(self, num: int, key: str = "draw") -> tuple[Tensor, Tensor]:
        """Return parameters and actions; those of a discrete space equally often."""
        with forked_generators(self.seed, key, "theta"):
            theta = self.prior.sample((num,)).float()
        values = self.actions.listed()
        if values is None:
            seed = derive_seed(self.seed, key, "action")
            return theta, self.actions.sample((num,), seed=seed)
        with forked_generators(self.seed, key, "action"):
            order = torch.randperm(len(values))
        return theta, values[order[torch.arange(num) % len(values)]]

    def simulate(
        self, theta: Tensor, action: Tensor, key: str = "x", **how: Any
    ) -> Simulations:
        """Return simulations, what raises being missing."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            seed = derive_seed(self.seed, key)
            return simulate(self.simulator, theta, action, seed=seed, **how)

    def look(self) -> float:
        """Return seconds a row of a few rows, of which one has the shape of several."""
        theta, action = self.draw(MIN_ROWS)
        x = self.simulate(theta, action).x  # it may load
        start = time.perf_counter()
        self.simulate(theta, action)
        seconds = time.perf_counter() - start
        single = self.simulate(theta[:1], action[:1]).x
        if single.shape[1:] != x.shape[1:]:
            raise ValueError(
                f"expected x of one shape; got {tuple(x.shape[1:])} a row from "
                f"{len(theta)} rows and {tuple(single.shape[1:])} from one; keep the "
                "rows' axis for a single row"
            )
        return seconds / MIN_ROWS

    def compare(self, num_rows: int) -> float:
        """Run rows under the same and other seeds, parameters and actions.

        Returns:
            Seconds a row.
        """
        drawn = theta, action = self.draw(num_rows)
        start = time.perf_counter()
        rows = self.simulate(*drawn)
        seconds = time.perf_counter() - start
        again, other = self.simulate(*drawn), self.simulate(*drawn, "other")
        has_seeds = takes_seeds(self.simulator)
        none = "no argument for them; one is set for each 256 rows"
        counts = ", ".join(f"{n} {name}" for name, n in rows.counts.items())
        self.facts += [
            f"x: shape (n, {', '.join(map(str, rows.x.shape[1:]))})",
            f"seeds: {'one a row' if has_seeds else none}",
            f"rows: {counts}",
            f"time: {1e3 * seconds:.3g} ms for {num_rows} rows",
        ]
        self._judge_outcomes(rows)
        self._judge_noise(rows, other, *drawn)
        parts = self.simulate(*drawn, batch_size=num_rows // 3)
        if has_seeds and not _close(rows.x, parts.x):
            self.defects.append(
                "SA404 x depends on which rows are simulated together; let row i "
                "depend on theta[i], action[i] and seeds[i] alone"
            )
        if _same(rows.x, again.x):
            self._judge_arguments(rows.x, drawn)
        else:
            self.warnings.append(
                "SA405 one seed gives two different x, so that no run can be repeated; "
                "take seeds, or draw from torch's or NumPy's global generator"
            )
        return seconds / num_rows

    def _judge_outcomes(self, rows: Simulations) -> None:
        """Tell of rows without a measurement, and of those that raise."""
        num, missing = len(rows), rows.counts["missing"]
        lost = num - rows.counts["ok"]
        if lost == num:
            self.defects.append("SA401 no row has a measurement")
        elif lost > MANY * num:
            self.warnings.append(
                f"SA401 {lost / num:.0%} of the rows have no measurement"
            )
        if missing:
            first = next(iter(rows.tracebacks.values())).strip().splitlines()[-1]
            self.warnings.append(
                f"SA301 {missing} rows raise, the first {first}; their outcome is "
                "missing; return NaN where the system gave no measurement"
            )

    def _judge_noise(
        self, rows: Simulations, other: Simulations, theta: Tensor, action: Tensor
    ) -> None:
        """Tell of numbers without noise, and of noise that counts twice."""
        x, again = rows.x.flatten(1), other.x.flatten(1)
        both = x.isfinite() & again.isfinite()
        silent = ((x == again) | ~both).all(0) & both.any(0)
        if bool((silent == both.any(0)).all()):
            try:
                require_noise(rows.x, other.x)
            except ValueError as error:
                self.defects.append(str(error))
        elif bool(silent.any()):
            numbers = ", ".join(map(str, torch.nonzero(silent)[:, 0].tolist()))
            self.warnings.append(
                f"SA403 numbers {numbers} of x have no noise, and so no density; "
                "declare the noise of every channel"
            )
        model = self.simulator
        if isinstance(model, SimulatorModel) and model.noise is not None:
            sound = rows.counts["missing"] == 0
            if sound and not model.is_deterministic(theta, action):
                self.warnings.append(
                    "SA402 fn is random beside declared noise, which so counts twice; "
                    "declare noise=None, or remove the random numbers from fn"
                )

    def _judge_arguments(self, x: Tensor, drawn: tuple[Tensor, Tensor]) -> None:
        """Tell of parameters and entries of the action that change nothing."""
        (theta, action), fresh = drawn, self.draw(len(x), "fresh")
        names = getattr(self.simulator, "parameter_names", None)
        names = names or [f"theta_{i + 1}" for i in range(theta.shape[1])]
        idle = self._idle(names, x, drawn, (fresh[0], action))
        others = self._idle(self.actions.names, x, drawn, (theta, fresh[1]))
        if len(idle) == theta.shape[1]:
            self.defects.append("SA303 no parameter changes x")
        elif idle:
            self.warnings.append(f"SA303 changing {', '.join(idle)} leaves x as it is")
        if others:
            text = f"SA303 changing {', '.join(others)} leaves x as it is"
            self.warnings.append(text)
        self.undetermined = self._undetermined(names, idle, x)
        self.warnings += [f"SA406 {group}" for group in self.undetermined]

    def _idle(
        self,
        names: Sequence[str],
        x: Tensor,
        drawn: tuple[Tensor, Tensor],
        fresh: tuple[Tensor, Tensor],
    ) -> list[str]:
        """Return names of columns, of what is drawn afresh, that change nothing."""
        idle = []
        for column, name in enumerate(names):
            changed = [part.clone() for part in drawn]
            for part, old, new in zip(changed, drawn, fresh, strict=True):
                if new is not old:
                    part[:, column] = new[:, column]
            if all(map(torch.equal, changed, drawn)):  # a single action
                continue
            if _same(self.simulate(changed[0], changed[1]).x, x):
                idle.append(name)
        return idle

    def _undetermined(
        self, names: Sequence[str], idle: Sequence[str], x: Tensor
    ) -> tuple[Undetermined, ...]:
        """Return parameters that no action tells apart, beside those that are idle."""
        # As many sets of parameters as actions.
        num = min(ProbeSettings().most_actions, max(len(x) // 4, 1))
        listed = self.actions.listed()
        try:
            return find_undetermined(
                lambda theta, action, key: self.simulate(theta, action, key).x,
                self.prior,
                self.draw(num, "undetermined")[1].unique(dim=0),
                names,
                skip=[i for i, name in enumerate(names) if name in idle],
                num_rows=len(x),
                num_numbers=x[0].numel(),
                num_permitted=None if listed is None else len(listed),
                seed=self.seed,
            )
        except SimulationError:  # at parameters next to others that it could simulate
            return ()


def _same(x: Tensor, other: Tensor) -> bool:
    return bool(((x == other) | (x.isnan() & other.isnan())).all())


def _close(x: Tensor, other: Tensor) -> bool:
    measured = x[x.isfinite()]
    scale = float(measured.std()) if len(measured) > 1 else 0.0
    return torch.allclose(
        x, other, rtol=ROUNDING, atol=ROUNDING * scale * 0.1, equal_nan=True
    )
