"""Former home of the searches of an action space: ``sbi_active.design``."""

from sbi_active.renamed import former_names

__all__: list[str] = []

__getattr__ = former_names(
    __name__,
    {
        "BayesianOptimization": "sbi_active.design:GradientSearch",
        "Evaluations": "sbi_active.design.search:Evaluations",
        "GradientSearch": "sbi_active.design:GradientSearch",
        "Objective": "sbi_active.design.search:Objective",
        "Search": "sbi_active.design:Search",
    },
)
