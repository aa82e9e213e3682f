"""Repairs of other projects' code. An import changes nothing; ``apply()`` installs a repair for the whole process.

``tests/backends/test_upstream.py`` fails when upstream has made a repair needless.
"""
