"""The target of a design, and what it takes to estimate its information."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain import (
    InformationGainEstimator,
    LinearGain,
    ModelIndexGain,
    ParameterGain,
    RivalSampler,
)
from sbi_active.information_gain.candidates import CandidateSampler
from sbi_active.information_gain.estimators.automatic import find_estimator
from sbi_active.information_gain.estimators.model_index import RivalPredictive
from sbi_active.simulation.workers.settings import Workers


@dataclass(frozen=True)
class Target:
    """The target of the information.

    Attributes:
        name: "theta", names of parameters, or "model".
        estimator: Estimator of the information, as the designer was given it.
        model: Model that the estimator needs.
        simulator: ``simulator(theta, action)``.
        belief: Distribution of the parameters; None for the target "model".
    """

    name: str | Sequence[str]
    estimator: str | InformationGainEstimator
    model: Any
    simulator: Callable[..., Any] | None
    belief: Distribution | None

    @staticmethod
    def of(
        name: str | Sequence[str],
        estimator: str | InformationGainEstimator,
        model: Any,
        simulator: Callable[..., Any] | None,
        belief: Distribution | None,
        *,
        simulates: bool,
    ) -> Target:
        """Return the target, its belief that of the model where none is given.

        Raises:
            ValueError: If what the target needs is lacking.
        """
        own = ("auto",) if name == "model" else ("auto", "linear")
        if name != "theta" and estimator not in own:
            raise ValueError(
                f"expected estimator={' or '.join(map(repr, own))} for "
                f"target={name!r}; got {estimator!r}; leave out estimator="
            )
        if name == "model":
            if not isinstance(model, Sequence) or not simulates:
                got = type(model).__name__ if simulates else "given simulations"
                raise ValueError(
                    "expected a sequence of rivals for target='model'; got "
                    f"{got}; pass objects with probability and "
                    "predict(action, num_samples, seed)"
                )
            return Target(name, estimator, model, simulator, None)
        if simulator is None and simulates:
            raise ValueError(
                "expected a simulator; got None; pass the one that the belief's "
                "parameters belong to"
            )
        belief = getattr(model, "belief", None) if belief is None else belief
        if belief is None:
            raise ValueError(
                "expected belief=, the distribution of the parameters; got none, and "
                "the model has none; pass the belief of this round"
            )
        return Target(name, estimator, model, simulator, belief)

    def gain(self) -> InformationGainEstimator | None:
        """Return the estimator; None if the simulations are to decide.

        Raises:
            ValueError: If it needs a model and there is none, or a name is unknown.
        """
        if self.name == "model":
            return None
        if self.name != "theta":
            index = _parameters(self.name, self.simulator)
            is_linear = self.estimator == "linear"
            return LinearGain(index) if is_linear else ParameterGain(index)
        estimator = find_estimator(self.estimator)
        if estimator is not None and estimator.needs_model and self.model is None:
            raise ValueError(
                f"expected a model for {type(estimator).__name__}; got None; pass "
                "the trained posterior, or estimator='auto'"
            )
        return estimator

    def sampler(
        self,
        action: Tensor,
        others: Tensor,
        seed: int,
        workers: Workers,
        *,
        most_numbers: float,
    ) -> tuple[CandidateSampler | RivalSampler, InformationGainEstimator | None]:
        """Return the sampler of outcomes of candidates (a, action_dim), and estimator.

        Outcomes with more than so many numbers are summarized where noise allows.

        Raises:
            ValueError: If other outcomes have no place in the target or the estimator.
        """
        if self.name == "model":
            if len(others):
                raise ValueError(
                    "expected one action at a time and none pending for "
                    f"target='model'; got {len(others)} others; ask for them in turn"
                )
            rivals: Sequence[RivalPredictive] = self.model
            sampler = RivalSampler(rivals, action, seed)
            return sampler, ModelIndexGain(sampler.probability)
        assert self.belief is not None
        assert self.simulator is not None
        estimator = self.gain()
        learns = estimator is not None and estimator.needs_model
        if len(others) and learns and not hasattr(self.model, "log_likelihood"):
            raise ValueError(
                "expected an estimator of the joint information of several actions, "
                "by the noise or by a model with log_likelihood; got "
                f"{type(estimator).__name__} on {type(self.model).__name__}, which "
                "knows single outcomes; use estimator='auto', or one action at a "
                "time without pending ones"
            )
        sampler = CandidateSampler(
            *(self.simulator, self.belief, action, seed, workers, others),
            # A model was learned from whole outcomes.
            most_numbers=float("inf") if learns else most_numbers,
        )
        return sampler, estimator


def _parameters(target: str | Sequence[str], simulator: Any) -> list[int]:
    """Return the places of parameters by name."""
    names = getattr(simulator, "parameter_names", None)
    if not names:
        raise ValueError(
            f"expected a simulator with parameter_names for target={target!r}; got "
            "none; build SimulatorModel(fn, parameter_names=[...])"
        )
    wanted = [target] if isinstance(target, str) else list(target)
    unknown = [name for name in wanted if name not in names]
    if unknown or not wanted:
        raise ValueError(
            f"expected target 'theta', 'model' or names among {list(names)}; got "
            f"{target!r}; choose one or more of these"
        )
    return [list(names).index(name) for name in wanted]
