"""Field trials: scenarios as data, and how many robots pass them (``docs/guides/trials.md``).

``scenario`` reads and checks one, ``running`` sends robots through it, ``trialling`` does so for policies and scenarios and writes
the results, ``page`` shows them.
"""
