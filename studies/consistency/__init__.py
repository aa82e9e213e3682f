"""By how much physics engines disagree about the same policy, and where the disagreement starts (``docs/guides/consistency.md``).

Layers: ``models`` compares what the engines hold, ``open_loop`` plays the same joint targets in each, ``closed_loop`` the same
episodes, ``attribution`` switches one option at a time. ``study`` runs them all; ``page`` shows the outcome.
"""
