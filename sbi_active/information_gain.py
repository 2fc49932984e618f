"""Former home of the estimators of an information gain: ``sbi_active.design``."""

from sbi_active.renamed import former_names

__all__: list[str] = []

__getattr__ = former_names(__name__)
