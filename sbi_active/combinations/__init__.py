"""Combinations of parameters that are known while the parameters are not, as formulas.

Outcomes may pin down some directions of the parameters and leave others open
(Gutenkunst et al., PLoS Comput. Biol. 2007; Transtrum et al., J. Chem. Phys. 2015).
This package turns such directions into short formulas. Their sources, a belief's draws
or a simulator's derivatives, are elsewhere.
"""
