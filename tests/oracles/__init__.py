"""Problems with a known answer, and every way to a belief or an evidence.

A problem is a function in ``problems``, a way a line in ``ways``. ``reference`` finds
the answers, which are committed in ``answers.json``; ``judging`` compares.
``python -m benchmarks oracles`` runs all ways on all problems.
"""
