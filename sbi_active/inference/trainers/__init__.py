"""The trainers: sbi's interface with actions, one method a module.

This package contains the classes that users call to append, train and update. The
networks that they train are in ``networks``, their results in ``models`` and
``beliefs``.
"""
