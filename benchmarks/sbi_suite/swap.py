"""A pytest plugin: sbi's NPE_C becomes ASBI everywhere before sbi's tests import it."""

from __future__ import annotations

import pkgutil
import sys
from importlib import import_module

import sbi.inference

from sbi_active import ASBI

original = sbi.inference.NPE_C
# sbi's messages carry the name of the class, and some of its tests read them.
swapped = type("NPE_C", (ASBI,), {"__module__": original.__module__})

for module in pkgutil.walk_packages(sbi.inference.__path__, "sbi.inference."):
    import_module(module.name)
for name, module in list(sys.modules.items()):
    if name == "sbi" or name.startswith("sbi."):
        for attribute, value in list(vars(module).items()):
            if value is original and attribute != "__class__":
                setattr(module, attribute, swapped)
assert sbi.inference.NPE_C is swapped
assert sbi.inference.NPE is swapped
