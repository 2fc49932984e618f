"""Former home of the searches of an action space: ``sbi_active.design``."""

from sbi_active.renamed import former_names

__all__: list[str] = []

__getattr__ = former_names(__name__)
