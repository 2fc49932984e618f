"""Estimators of the expected information gain, and what they rest on.

This package estimates the worth of a trial of an action from outcomes of it, in nats.
It simulates nothing and chooses no action; ``design`` does.
"""
