"""Campaigns with few simulations."""
