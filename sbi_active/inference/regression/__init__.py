"""Regression of outcomes on parameters, where a posterior is.

Here live rows, regions, polynomials and their errors. What is done with them lives in
``refinement``.
"""
