"""Beliefs of many parameters, and robust ones."""
