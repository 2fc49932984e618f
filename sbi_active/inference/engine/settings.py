"""Settings of the engine."""

from __future__ import annotations

from dataclasses import dataclass, field

from sbi_active.inference.engine.search import SearchSettings


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """Settings of surfaces of the likelihood, and of draws that pass them.

    Chosen on ten compartments (the oracles' truth among five, at another seed), on the
    oracles' banana and on ridges, one value after another; half and twice of what has
    no figure here were not tried.

    Attributes:
        depth: Nats below the best draw beyond which a draw is not fitted to.
        temper: Power of its density that a draw weighs in the fit. Without it surfaces
            are as efficient within ``depth`` (cubic ones .98), and 0 to .8 beyond.
        most_degree: Degree of the polynomials at most; quadratic ones have .4 to .9 of
            the efficiency of cubic ones there.
        most_features: Number of features at most: a cubic surface of eleven parameters,
            or a quadratic one of 26.
        fewest: Draws a feature, below which a degree is not tried.
        plenty: Draws a feature beyond which no more are taken.
        num_folds: Number of parts of the draws, each predicted by the others.
        good: Share of what passes that is expected to be effective, below which there
            is no surface.
        num_components: Components of the proposal that is screened; twice as many took
            as many rows.
        num_effective: Effective draws of the surface's posterior that it is fitted to.
        num_screened: Draws that tell which share passes.
        levels: Quantiles of the weights that are tried as the level.
        even: Share of what passes that is effective where the surface is right; with
            .9 down to .003 of the draws passed, and their computing took longer.
        least_mass: Share of the draws that passes at least.
        unscreened: Share of what passes that passes whatever the surface says. With a
            third of it, the worst of eight bananas had a KL of .10, and not of .06.
    """

    depth: float = 40.0
    temper: float = 0.3
    most_degree: int = 3
    most_features: int = 400
    fewest: int = 2
    plenty: int = 6
    num_folds: int = 5
    good: float = 0.1
    num_components: int = 16
    num_effective: float = 2_000.0
    num_screened: int = 50_000
    levels: tuple[float, ...] = tuple(k / 100 for k in range(100))
    even: float = 0.7
    least_mass: float = 0.02
    unscreened: float = 0.3


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of :func:`.infer`.

    Attributes:
        num_effective: Effective draws that end importance sampling. The log density of
            a belief is off by about their number to the power -1/2, in nats.
        plenty: Times as many are drawn while they are cheap: with half of it heavy
            tails are cut by a tenth.
        divergence: Divergence of a normal fit to the draws, in nats a parameter, that
            is asked while they are cheap, and three times that always. n normal draws
            of d parameters are (d + 3) / 4 n off. Half asks for twice as many from ten
            parameters on; from twice on ``plenty`` decides up to ten.
        num_simulations: Simulated rows to spend, each at one action; None is no bound.
            More of more than ``few`` parameters, in proportion.
        share_of_plenty: Share of these within which draws are cheap, unless the
            likelihood is rough.
        num_draws: Draws of a proposal, more of one that is fitted to more than ``few``
            parameters. Half reaches a narrow posterior in fewer simulations, and fits
            10 parameters three times as badly.
        few: Number of parameters beyond which there are more draws.
        fitted: Draws that a proposal is fitted to, beside those: repeated ones carry
            their weights. A quarter will do where draws are thousands.
        max_rounds: Proposals at most.
        fewest: Effective draws below which the likelihood is tempered.
        few_tempered: Rounds of this beyond which the likelihood is called rough.
        broad: Effective draws that shape the wide share of a proposal.
        share_of_wide: Share of a proposal that is wide.
        share_if_rough: Share of a proposal that is wide where the likelihood is rough.
        num_components: Components of a proposal at least; one a mode.
        efficient: Share of a proposal's draws that are effective, with which it is good
            enough: more is drawn from it in place of fitting another.
        seen: Effective draws from which a proposal's efficiency is believed.
        affordable: Draws that are not worth another fit, in draws of a fit. With eight,
            modes of ten parameters are drawn from to the end, and tails are missed.
        max_fits: Fits to the whole likelihood at most, unless the last is half as
            efficient as the best.
        wider: Factor of the draws' widths in a proposal of one parameter; less of more.
        jitter: Noise of repeated draws that a proposal is fitted to, in deviations.
        freedom: Degrees of freedom of a proposal, or the dimension if that is more:
            tails of 5 in 20 dimensions would take most draws.
        laplace_wider: Factor of the modes' widths in the first proposal, likewise.
        profiled: Distances from a mode, in deviations of the prior, at which widths to
            each side are measured; and in those of its normal approximation. Without
            the first, shelves are missed: six compartments are .06 nats off, not .02.
        profiled_near: The latter.
        valley: Fall of the log density, in nats, beyond which they are not.
        negligible: Nats below the best draw beyond which a draw counts for nothing.
        largest_shape: Largest shape of the weights' tail that is trusted: beyond .7
            their mean hardly settles (Vehtari et al., JMLR 2024).
        most_missed: Share of the posterior, by the draws of all proposals, where those
            that it rests on may be outweighed: .04 to .4 of four to eight modes on
            circles, of which a third is missed, and .000 where all are drawn.
        max_heavy: Times at most that another proposal is fitted for a heavier tail.
        per_parameter: Particles a parameter of sequential Monte Carlo, in effective
            draws.
        fewest_particles: Particles at least.
        passes: Number of likelihoods of each particle that the rows have to suffice
            for, which bounds the number of particles; a quarter of them is tried where
            they did not. With half, forty curved parameters get nowhere at first; twice
            as many leave half of the particles.
        most_cut: Share of the normal guess outside the bounds of the prior, beyond
            which particles are led between them; with .5 more is computed, and with
            .99 SMC begins at a handful.
        hopeless: Such a share with which importance sampling is not tried: of 15
            uniform parameters, told by eight sums, it took 40 s in vain.
        num_ridge: Places along a ridge, beside draws that are known, and draws that
            count as further ones of each proposal. If only the product of two
            parameters is known, to 1e-4, a quarter leaves gaps of 6 % of the evidence,
            half leaves 2 %, and twice as many save no rows.
        num_ridged: Proposals along ridges before others are tried as well; then those
            that were the more efficient go on.
        idle: Share of its part of the draws below which a place is left out. Half and
            twice change rows by a tenth or a third, and no evidence.
        reach: Deviations of the prior that they span.
        returning: Steps that bring them back to the ridge.
        surface: Settings of surfaces of the likelihood.
        search: Settings of the search.
    """

    num_effective: float = 200.0
    plenty: float = 6.0
    divergence: float = 0.002
    num_simulations: int | None = None
    share_of_plenty: float = 0.6
    num_draws: int = 500
    few: int = 4
    fitted: float = 2.0
    max_rounds: int = 40
    fewest: float = 60.0
    few_tempered: int = 5
    broad: float = 150.0
    share_of_wide: float = 0.25
    share_if_rough: float = 0.5
    num_components: int = 8
    efficient: float = 0.3
    seen: float = 8.0
    affordable: float = 3.0
    max_fits: int = 4
    wider: float = 1.4
    jitter: float = 0.1
    freedom: float = 5.0
    laplace_wider: float = 1.4
    profiled: tuple[float, ...] = (0.5, 1.0, 2.0)
    profiled_near: tuple[float, ...] = (1.0, 2.0, 4.0)
    valley: float = 8.0
    negligible: float = 25.0
    largest_shape: float = 0.7
    most_missed: float = 0.03
    max_heavy: int = 3
    per_parameter: float = 0.8
    fewest_particles: int = 400
    passes: float = 60.0
    most_cut: float = 0.9
    hopeless: float = 0.98
    num_ridge: int = 128
    num_ridged: int = 3
    idle: float = 0.1
    reach: float = 4.0
    returning: int = 5
    surface: SurfaceSettings = field(default_factory=lambda: SurfaceSettings())
    search: SearchSettings = field(default_factory=SearchSettings)

    def asked(self, effective: float, divergence: float, *, is_cheap: bool) -> float:
        """Return the effective draws to end with.

        Args:
            effective: Effective draws so far.
            divergence: Divergence of a normal fit to these, in nats a parameter.
            is_cheap: Whether draws are cheap.
        """
        most, times = self.divergence, self.plenty
        if not is_cheap:
            most, times = 3 * most, 1.0
        return max(times * self.num_effective, effective * divergence / most)

    def affords(self, num: float, dim: int) -> bool:
        """Return whether so many draws are not worth another fit."""
        return num <= self.affordable * self.draws_of_fit(dim)

    def num_fitted(self, dim: int) -> int:
        """Return the repeated draws that a proposal is fitted to."""
        return int(self.fitted * self.draws_of_fit(dim))

    def draws_of_fit(self, dim: int) -> int:
        """Return the draws of a proposal for so many parameters."""
        return int(self.num_draws * max(1.0, dim / self.few))

    def budget(self, dim: int) -> float:
        """Return the rows to spend on so many parameters."""
        if self.num_simulations is None:
            return float("inf")
        return self.num_simulations * max(1.0, dim / self.few)


#: Settings of :func:`.infer` where a likelihood is cheap. On four modes and on a peak
#: of six parameters half of the draws, and twice, are as right; twice takes up to 1.5
#: times as long.
CHEAP = Settings(
    plenty=1.0,
    num_draws=2_000,
    fewest=200.0,
    max_fits=6,
    efficient=0.4,
    affordable=0.0,  # a fit takes as long as many draws
    jitter=0.0,
    fitted=0.25,
)
