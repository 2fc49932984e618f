"""The engine: rows of simulations over processes or a cluster.

This package runs rows, handles lost ones and stores them. It does not know what a row
means.
"""
