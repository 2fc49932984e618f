"""Parameters that outcomes tell together and not one by one, as formulas.

Outcomes may pin down some directions of the parameters and leave others open
(Gutenkunst et al., PLoS Comput. Biol. 2007; Transtrum et al., J. Chem. Phys. 2015).
This package finds them in a belief's draws or a simulator's derivatives, and turns them
into short formulas. Effects that no action separates are in ``criticism.steps``.
"""
