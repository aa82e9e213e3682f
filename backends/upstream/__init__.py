"""Repairs of other projects' code. Importing one changes nothing; ``apply()`` does, for the whole process.

``tests/backends/test_upstream.py`` fails when upstream has made a repair needless.
"""
