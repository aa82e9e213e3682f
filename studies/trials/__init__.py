"""Field trials: what a robot is put through outside, as scenarios that are data, and how many robots come through (``docs/guides/trials.md``).

``scenario`` reads and checks one, ``running`` sends robots through it, ``trialling`` does so for policies and scenarios and writes
what came of it, ``page`` shows that.
"""
