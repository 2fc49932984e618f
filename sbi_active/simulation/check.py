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
from sbi_active.simulation.outcomes import MissingRowsWarning, Outcome, SimulationError
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
    try:
        check.look(theta, action)
    except Exception as error:  # whatever the user's code raises is the finding
        try:
            check.look_by_rows(theta, action)
        except (SimulationError, ValueError):
            check.defects.append(_told(error))
    if not check.defects:
        num_runs = RUNS + 3 * theta.shape[1] + action.shape[1] + RUNS
        seconds_row = check.found["seconds_batch"] / MIN_ROWS + 1e-9
        affordable = int(max_seconds / num_runs / seconds_row)
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

    def call(self, theta: Tensor, action: Tensor, seeds: Tensor) -> Any:
        """Call the simulator as it is, whatever it returns."""
        is_model = isinstance(self.simulator, SimulatorModel)
        takes = is_model or takes_seeds(self.simulator)
        given = {"seeds": seeds.clone()} if takes else {}
        with forked_generators(self.seed, "call"):
            return self.simulator(theta.clone(), action.clone(), **given)

    def simulate(self, theta: Tensor, action: Tensor, key: str = "x") -> Any:
        """Return simulations, what raises being missing."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            seed = derive_seed(self.seed, key)
            return simulate(self.simulator, theta, action, seed=seed)

    def look(self, theta: Tensor, action: Tensor) -> None:
        """Call it with several rows and with one; raises what it raises."""
        seeds = row_seeds(self.seed, len(theta))
        outcome_tensor(self.call(theta, action, seeds), len(theta))  # it may load
        start = time.perf_counter()
        raw = self.call(theta, action, seeds)
        middle = time.perf_counter()
        single = outcome_tensor(self.call(theta[:1], action[:1], seeds[:1]), 1)
        end = time.perf_counter()
        x = outcome_tensor(raw, len(theta))
        if single.shape[1:] != x.shape[1:]:
            self.defects.append(
                f"expected x of one shape; got {tuple(x.shape[1:])} a row from "
                f"{len(theta)} rows and {tuple(single.shape[1:])} from one; keep the "
                "rows' axis for a single row"
            )
            return
        dtype = str(getattr(raw, "dtype", type(raw).__name__))
        output = dtype if isinstance(raw, Tensor) else f"{type(raw).__module__}.{dtype}"
        self.found |= {"num_rows": len(theta), "x_shape": (*x.shape[1:],)}
        self.found |= {"output": output, "seconds_batch": middle - start}
        self.found["seconds_row"] = end - middle

    def look_by_rows(self, theta: Tensor, action: Tensor) -> None:
        """Simulate so that only the rows are lost that raise; raises where all do."""
        start = time.perf_counter()
        x = self.simulate(theta, action).x
        seconds = time.perf_counter() - start
        self.found |= {"num_rows": len(theta), "x_shape": (*x.shape[1:],)}
        self.found |= {"output": f"{x.dtype} after conversion"}
        self.found |= {"seconds_batch": seconds, "seconds_row": seconds / len(theta)}

    def compare(self, num_rows: int) -> None:
        """Run so many rows under the same and other seeds, parameters and actions."""
        self.found["num_rows"] = num_rows
        theta, action = self.draw(num_rows)
        seeds = row_seeds(derive_seed(self.seed, "x"), num_rows)
        start = time.perf_counter()
        rows = self.simulate(theta, action)
        seconds = time.perf_counter() - start
        again, other = (self.simulate(theta, action, key) for key in ("x", "other"))
        independent = None
        if self.found["takes_seeds"] and rows.counts["missing"] == 0:
            order = torch.arange(num_rows).flip(0)
            x = outcome_tensor(self.call(theta, action, seeds), num_rows)
            permuted = self.call(theta[order], action[order], seeds[order])
            independent = _close(outcome_tensor(permuted, num_rows), x[order])
        self.found |= {
            "seconds_batch": seconds,
            "counts": rows.counts,
            "lost_by_action": _lost(action, rows.status != Outcome.OK),
            "is_reproducible": _same(rows.x, again.x),
            "is_deterministic": _identical(rows.x, other.x),
            "noiseless": _noiseless(rows.x, other.x),
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


def _lost(action: Tensor, lost: Tensor) -> tuple[tuple[tuple[float, ...], float], ...]:
    """Return the share of lost rows by action, largest first."""
    distinct, inverse = torch.unique(action, dim=0, return_inverse=True)
    if len(distinct) > len(action) / 2:  # a continuous space: too few rows an action
        return ()
    share = torch.zeros(len(distinct)).index_add_(0, inverse, lost.float())
    share /= torch.bincount(inverse)
    order = share.argsort(descending=True, stable=True)
    order = order[share[order] > 0]
    return tuple((tuple(distinct[i].tolist()), float(share[i])) for i in order)


def _same(x: Tensor, other: Tensor) -> bool:
    return bool(((x == other) | (x.isnan() & other.isnan())).all())


def _close(x: Tensor, other: Tensor) -> bool:
    measured = x[x.isfinite()]
    scale = float(measured.std()) if len(measured) > 1 else 0.0
    near = torch.isclose(x, other, rtol=ROUNDING, atol=ROUNDING * scale * 0.1)
    return bool((near | (x == other) | (x.isnan() & other.isnan())).all())


def _identical(x: Tensor, other: Tensor) -> bool:
    """Return whether all numbers that both have are equal, and there are some."""
    both = x.isfinite() & other.isfinite()
    return bool(both.any()) and bool((x[both] == other[both]).all())


def _noiseless(x: Tensor, other: Tensor) -> tuple[int, ...]:
    """Return numbers of x that the seed leaves alone while it changes others."""
    x, other = x.flatten(1), other.flatten(1)
    both = x.isfinite() & other.isfinite()
    silent = ((x == other) | ~both).all(0) & both.any(0)
    return () if bool(silent.all()) else tuple(torch.nonzero(silent)[:, 0].tolist())
