"""Where each message of the library is explained, said in its own text.

A warning that Python shows, and a sentence of ``belief.diagnostics.warnings``, of a
report's or of ``check_simulator``, ends in "(see warnings.html#rows-missing)": a page
of the site, ``docs/howto/warnings.md``, whose headings are the phrases below. So does
an error or warning of a class of this library. Built-in errors about an argument say
what was expected, what was given and what to do, and nothing else.
"""

from __future__ import annotations

import re
import warnings

PAGE = "warnings.html"
#: Words of a message, and the place on the page where it is explained. Of several that
#: occur in a text the first is named.
ANCHORS = {
    # Of a belief.
    "of the network's posterior lies within the": "network-outside-prior",
    "the network has never seen an outcome like": "unseen-outcome",
    "no simulation it was trained on lacks": "unseen-outcome",
    "its density is finite nowhere": "density-nowhere",
    "are left out, at which the network's density": "density-nowhere",
    "the ratios are finite nowhere": "density-nowhere",
    "was not simulated; the": "action-not-simulated",
    "the belief has to be computed again": "belief-again",
    "is computed again": "belief-again",
    "was corrected since": "belief-again",
    "were told or corrected since": "belief-again",
    "is recorded and not in the belief": "budget-used-up",
    "given up, tell it again": "given-up",
    "hold for this process": "options-of-a-load",
    "restored from": "given-up",
    "away from anything simulated": "unlike-simulated",
    "that no simulation from the prior has": "unlike-simulated",
    "unlike anything simulated": "unlike-simulated",
    "fresh simulations do not confirm the belief": "not-confirmed",
    "lies within 1 % of the prior's edge": "prior-edge",
    "is at a bound of its prior": "prior-edge",
    "simulated trials correlate at the same parameters": "trials-correlate",
    "the belief is off by about": "few-simulations",
    "the last stage still changed the belief": "not-settled",
    "the noise is not Gaussian": "not-gaussian",
    "of the particles counted, as with many": "many-modes",
    "have more turns than a cubic": "many-modes",
    "the residuals of the surrogate have": "surrogate-misfit",
    "the belief rests on": "few-draws",
    "few effective draws": "few-draws",
    "effective draws: the posterior is not": "not-linear",
    "particles are effective": "few-draws",
    "few draws outweigh all others": "heavy-tail",
    "of the moves of the particles were accepted": "particles-stuck",
    "the best mode was found by one of": "one-search",
    "differs by": "order-matters",
    "is followed coarsely": "followed-coarsely",
    "had a measurement, or none, where": "no-way-to-fail",
    "the amortized network is": "network-blunt",
    "single trials disagree about": "trials-disagree",
    "times the declared error": "beyond-declared",
    # Of trials and tables.
    "told numbers are infinite and count as": "infinite",
    "x is inf in trial": "infinite",
    "is not in": "action-outside",
    "hold no number": "no-number",
    "check that all are in one unit": "one-unit",
    "is its time in ms": "log-in-ms",
    "as an angle that wraps": "angle-wraps",
    "are these degrees": "angle-degrees",
    "begin up to": "late-starts",
    "have a measurement and no input": "no-input",
    "takes no argument": "argument-not-taken",
    "leave a polynomial of order": "not-polynomial",
    "expected at least 3 repeats to estimate noise": "few-repeats",
    # Of simulations.
    "simulations of the design are": "rows-missing",
    "simulations of the refinement are": "rows-missing",
    "of the refinement are missing": "rows-missing",
    "rows are missing": "rows-missing",
    "simulations without a measurement": "dropped-rows",
    "change nothing that is read in": "idle-parameters",
    "rows of the bank are worth": "bank-far",
    "have density 0 under the proposal": "wrong-label",
    "no workers at": "no-workers",
    # Of check_simulator.
    "rows have no measurement": "rows-without",
    "no row has a measurement": "rows-without",
    "their outcome is missing": "rows-missing",
    "beside declared noise": "noise-twice",
    "of x have no noise": "no-noise",
    "rows permuted with their seeds": "rows-depend",
    "one seed gives two different x": "not-reproducible",
    "leaves x as it is": "idle-parameters",
    "no parameter changes x": "idle-parameters",
    "or permit actions that": "parameters-together",
    # Of a closed loop.
    "noise undeclared": "noise-undeclared",
    "fewer than": "few-trials",
    "drift aliased with the order of actions": "drift-aliased",
    "actions chosen for information and not for": "chosen-actions",
    "is far outside what the verdict's model": "held-out-missed",
    "is far outside what the other trials show": "trial-outlying",
    "outcomes that disagree": "outcomes-disagree",
    "the simulator jumps": "jumps",
    "independent errors forced on a trajectory": "correlated-errors",
    "evidence uncertain of": "evidence-uncertain",
    "the alarm rests on the chi-square alone": "chi-square-alone",
    "explains the most, and not all": "not-all",
    "two estimates of the bare model's evidence": "two-estimates",
    "does not lower the error on trials that": "error-not-lowered",
    "it does not lower the error": "error-not-lowered",
    "and with a wider prior the model": "prior-edge",
    "phi at its prior's edge": "phi-edge",
    "is more than an instrument gets": "instrument",
    "not robust to its prior": "not-robust",
    "no declared effect explains the data": "unexplained",
    "scatter is larger than the declared noise": "scatter",
    "exploratory": "exploratory",
    "does not agree with the others": "outlier",
    "is not named, since": "outlier",
    "without it the Bayes factor": "one-trial-decides",
    "residuals are far smaller than the declared": "noise-too-large",
    "what they leave out was not looked at": "summaries",
    "thin=False uses all": "thinned",
    "the order of the trials is unknown": "order-unknown",
    "linear evidence puts the others behind": "screened",
    "trials that were not fitted draw": "start-states",
    # Names that change.
    "goes in the next version": "renamed",
    "is deprecated; use an attribute": "renamed",
    "learns one ratio for all parameters": "seqbed",
}


def explained(text: str) -> str:
    """Return a message with its place on the page; one that is unknown as it is.

    Example:
        >>> explained("3 of 9 rows are missing: 3 raised")
        '3 of 9 rows are missing: 3 raised (see warnings.html#rows-missing)'
        >>> explained(explained("few effective draws")) == explained(
        ...     "few effective draws"
        ... )
        True
    """
    words = " ".join(text.split())
    for phrase, anchor in ANCHORS.items():
        if phrase in words:
            place = f" (see {PAGE}#{anchor})"
            return text if text.endswith(place) else text + place
    return text


def warn(
    text: str, category: type[Warning] = UserWarning, *, stacklevel: int = 1
) -> None:
    """Warn as :func:`warnings.warn` does, and say where the message is explained.

    Args:
        text: Words of :data:`ANCHORS` among others.
        category: Of the warning.
        stacklevel: 1 for the line that calls this, 2 for who called its function.
    """
    warnings.warn(explained(text), category, stacklevel=stacklevel + 1)


class Explained:
    """An error whose text names its place on the page, by the name of its class.

    Example:
        >>> class OddError(Explained, ValueError):
        ...     pass
        >>> print(OddError("expected an even number; got 3; pass one"))
        expected an even number; got 3; pass one (see warnings.html#odd-error)
    """

    def __str__(self) -> str:
        name = next(c.__name__ for c in type(self).__mro__ if Explained in c.__bases__)
        anchor = re.sub(r"\B(?=[A-Z])", "-", name).lower()
        return f"{super().__str__()} (see {PAGE}#{anchor})"
