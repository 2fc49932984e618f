"""Look a simulator over before a campaign spends hours on it."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.discrete import Actions, action_space
from sbi_active.identifiability.sensitivities import ProbeSettings
from sbi_active.identifiability.undetermined import Undetermined, find_undetermined
from sbi_active.renamed import takes_loose
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.simulation.model import SimulatorModel, takes_seeds
from sbi_active.simulation.outcomes import MissingRowsWarning, SimulationError
from sbi_active.simulation.report import SimulatorReport
from sbi_active.simulation.simulator import outcome_tensor, require_noise
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers

MIN_ROWS = 16  # a choice: of the first runs, which are timed
RUNS = 6  # of all rows, beside one a parameter and one an entry of the action
ROUNDING = 1e-5  # relative difference between batches that mixes no rows
MANY = 0.5  # share of rows without a measurement that is worth a word


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
        num_simulations: Simulations that the campaign needs, for
            :attr:`SimulatorReport.minutes`.
        workers: Workers of the campaign, or the number of calls at a time.
        seed: Seed of the draws.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import DiscreteActions
        >>> report = check_simulator(
        ...     lambda theta, action: theta[:, :1] * action,
        ...     BoxUniform(torch.zeros(2), torch.ones(2)), DiscreteActions([1.0, 2.0]),
        ... )
        >>> report.is_ready, report.is_deterministic, report.idle_parameters
        (False, True, ('theta_2',))
    """
    check = _Check(simulator, prior, action_space(actions), seed)
    check.found["num_simulations"] = num_simulations
    check.found["num_workers"] = Workers.of(workers).num_workers
    theta, action = check.draw(MIN_ROWS)
    seconds = check.look(theta, action)
    if not check.defects:
        num_runs = RUNS + 3 * theta.shape[1] + action.shape[1] + RUNS
        affordable = int(max_seconds / num_runs / (seconds / MIN_ROWS + 1e-9))
        try:
            check.compare(max(MIN_ROWS, min(num_rows, affordable)))
        except SimulationError as error:
            check.defects.append(_told(error))
    return check.report()


class _Check:
    """A look at a simulator, whose draws and runs share their seeds.

    Attributes:
        found: Findings so far, by their names in the report.
        defects: Defects so far.
        warnings: Warnings so far.
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
        self.found: dict[str, Any] = {"takes_seeds": takes_seeds(simulator)}
        self.defects: list[str] = []
        self.warnings: list[str] = []

    def report(self) -> SimulatorReport:
        """Return what was found."""
        told: Any = {"defects": (*self.defects,), "warnings": (*self.warnings,)}
        return SimulatorReport(**self.found, **told)

    def draw(self, num: int, key: str = "draw") -> tuple[Tensor, Tensor]:
        """Return parameters and actions; those of a discrete space equally often."""
        with forked_generators(self.seed, key, "theta"):
            theta = self.prior.sample((num,)).float()
        values = getattr(self.actions, "values", None)
        if values is None:
            seed = derive_seed(self.seed, key, "action")
            return theta, self.actions.sample((num,), seed=seed)
        with forked_generators(self.seed, key, "action"):
            order = torch.randperm(len(values))
        return theta, values[order[torch.arange(num) % len(values)]]

    def call(self, theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        """Call the simulator once; raises what it raises."""
        is_model = isinstance(self.simulator, SimulatorModel)
        takes = is_model or self.found["takes_seeds"]
        given = {"seeds": seeds.clone()} if takes else {}
        with forked_generators(self.seed, "call"):
            x = self.simulator(theta.clone(), action.clone(), **given)
        return outcome_tensor(x, len(theta))

    def simulate(self, theta: Tensor, action: Tensor, key: str = "x") -> Any:
        """Return simulations, what raises being missing."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            seed = derive_seed(self.seed, key)
            return simulate(self.simulator, theta, action, seed=seed)

    def look(self, theta: Tensor, action: Tensor) -> float:
        """Return seconds of several rows; one row must give x of the same shape.

        Where a call raises, rows are simulated so that only those are lost that raise.
        """
        seeds, seconds = row_seeds(self.seed, len(theta)), math.nan
        try:
            self.call(theta, action, seeds)  # it may load
            start = time.perf_counter()
            x = self.call(theta, action, seeds)
            seconds = time.perf_counter() - start
            single = self.call(theta[:1], action[:1], seeds[:1])
        except Exception as error:  # whatever the user's code raises is the finding
            start = time.perf_counter()
            try:
                self.simulate(theta, action)
            except (SimulationError, ValueError):
                self.defects.append(_told(error))
            return time.perf_counter() - start
        if single.shape[1:] != x.shape[1:]:
            self.defects.append(
                f"expected x of one shape; got {tuple(x.shape[1:])} a row from "
                f"{len(theta)} rows and {tuple(single.shape[1:])} from one; keep the "
                "rows' axis for a single row"
            )
        return seconds

    def compare(self, num_rows: int) -> None:
        """Run so many rows under the same and other seeds, parameters and actions."""
        theta, action = self.draw(num_rows)
        seeds = row_seeds(derive_seed(self.seed, "x"), num_rows)
        start = time.perf_counter()
        rows = self.simulate(theta, action)
        seconds = time.perf_counter() - start
        again, other = (self.simulate(theta, action, key) for key in ("x", "other"))
        independent = None
        if self.found["takes_seeds"] and rows.counts["missing"] == 0:
            order = torch.arange(num_rows).flip(0)
            x = self.call(theta, action, seeds)
            permuted = self.call(theta[order], action[order], seeds[order])
            independent = _close(permuted, x[order])
        is_deterministic, noiseless = _silent(rows.x, other.x)
        self.found |= {
            "num_rows": num_rows,
            "x_shape": (*rows.x.shape[1:],),
            "seconds": seconds,
            "counts": rows.counts,
            "is_reproducible": _same(rows.x, again.x),
            "is_deterministic": is_deterministic,
            "noiseless": noiseless,
            "rows_are_independent": independent,
        }
        if self.found["is_reproducible"]:
            fresh, drawn = self.draw(num_rows, "fresh"), (theta, action)
            names = getattr(self.simulator, "parameter_names", None)
            names = names or [f"theta_{i + 1}" for i in range(theta.shape[1])]
            idle = self._idle(names, rows.x, drawn, (fresh[0], None))
            self.found["idle_parameters"] = idle
            self.found["idle_actions"] = self._idle(
                self.actions.names, rows.x, drawn, (None, fresh[1])
            )
            self.found["undetermined"] = self._undetermined(names, idle, num_rows)
        self._judge(theta, action, rows)

    def _idle(
        self,
        names: Sequence[str],
        x: Tensor,
        drawn: tuple[Tensor, Tensor],
        fresh: tuple[Tensor | None, Tensor | None],
    ) -> tuple[str, ...]:
        """Return names of columns of theta or action that change nothing."""
        idle = []
        for column, name in enumerate(names):
            changed = [part.clone() for part in drawn]
            for part, other in zip(changed, fresh, strict=True):
                if other is not None:
                    part[:, column] = other[:, column]
            if all(map(torch.equal, changed, drawn)):  # a single action
                continue
            if _same(self.simulate(changed[0], changed[1]).x, x):
                idle.append(name)
        return tuple(idle)

    def _undetermined(
        self, names: Sequence[str], idle: Sequence[str], num_rows: int
    ) -> tuple[Undetermined, ...]:
        """Return parameters that no action tells apart, beside those that are idle."""
        actions, num = self.actions.listed(), None
        if actions is None:
            seed = derive_seed(self.seed, "undetermined")
            actions = self.actions.sample((ProbeSettings().most_actions,), seed=seed)
        else:
            num = len(actions)
            with forked_generators(self.seed, "undetermined"):
                actions = actions[torch.randperm(num)]
        fewest = max(num_rows // 4, 1)  # as many sets of parameters as actions
        try:
            return find_undetermined(
                lambda theta, action, key: self.simulate(theta, action, key).x,
                self.prior,
                actions[:fewest],
                names,
                skip=[i for i, name in enumerate(names) if name in idle],
                num_rows=num_rows,
                num_numbers=math.prod(self.found["x_shape"] or (1,)),
                num_permitted=num,
                seed=self.seed,
            )
        except SimulationError:  # at parameters next to others that it could simulate
            return ()

    def _judge(self, theta: Tensor, action: Tensor, rows: Any) -> None:
        """Add defects and warnings."""
        defects, notes, found = self.defects, self.warnings, self.report()
        lost = len(theta) - found.counts["ok"]
        if lost == len(theta):
            defects.append("SA401 no row has a measurement")
        elif lost > MANY * len(theta):
            notes.append(
                f"SA401 {lost / len(theta):.0%} of the rows have no measurement"
            )
        if found.counts["missing"]:
            text = next(iter(rows.tracebacks.values()), "").strip().splitlines()
            notes.append(
                f"SA301 {found.counts['missing']} rows raise, the first "
                f"{text[-1] if text else 'without a word'}; their outcome is missing; "
                "return NaN where the system gave no measurement"
            )
        if found.is_deterministic:
            try:
                require_noise(rows.x, rows.x)
            except ValueError as error:
                defects.append(str(error))
        model = self.simulator
        declared = isinstance(model, SimulatorModel) and model.noise is not None
        sound = found.counts["missing"] == 0
        if declared and sound and not model.is_deterministic(theta, action):
            notes.append(
                "SA402 fn is random beside declared noise, which so counts twice; "
                "declare noise=None, or remove the random numbers from fn"
            )
        if found.noiseless:
            notes.append(
                f"SA403 numbers {', '.join(map(str, found.noiseless))} of x have no "
                "noise, and so no density; declare the noise of every channel"
            )
        if found.rows_are_independent is False:
            defects.append(
                "SA404 rows permuted with their seeds do not give permuted x; let row "
                "i depend on theta[i], action[i] and seeds[i] alone"
            )
        if not found.is_reproducible:
            notes.append(
                "SA405 one seed gives two different x, so that no run can be repeated; "
                "take seeds, or draw from torch's or NumPy's global generator"
            )
        if len(found.idle_parameters) == theta.shape[1]:
            defects.append("SA303 no parameter changes x")
        elif idle := ", ".join(found.idle_parameters):
            notes.append(f"SA303 changing {idle} leaves x as it is")
        if idle := ", ".join(found.idle_actions):
            notes.append(f"SA303 changing {idle} leaves x as it is")
        notes += [f"SA406 {group}" for group in found.undetermined]


def _told(error: Exception) -> str:
    text = str(error)
    return text if text.startswith("expected ") else f"{type(error).__name__}: {text}"


def _same(x: Tensor, other: Tensor) -> bool:
    return bool(((x == other) | (x.isnan() & other.isnan())).all())


def _close(x: Tensor, other: Tensor) -> bool:
    measured = x[x.isfinite()]
    scale = float(measured.std()) if len(measured) > 1 else 0.0
    near = torch.isclose(x, other, rtol=ROUNDING, atol=ROUNDING * scale * 0.1)
    return bool((near | (x == other) | (x.isnan() & other.isnan())).all())


def _silent(x: Tensor, other: Tensor) -> tuple[bool, tuple[int, ...]]:
    """Return whether two seeds give one x, and else the numbers that they leave."""
    x, other = x.flatten(1), other.flatten(1)
    both = x.isfinite() & other.isfinite()
    known = both.any(0)
    silent = ((x == other) | ~both).all(0) & known
    if bool(known.any()) and bool((silent == known).all()):
        return True, ()
    return False, tuple(torch.nonzero(silent)[:, 0].tolist())
