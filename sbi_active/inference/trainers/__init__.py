"""The trainers: sbi's interface with actions, one method a module.

Here lives what users call to append, train and update. What is trained lives in
``networks``, what they return in ``models`` and ``beliefs``.
"""
