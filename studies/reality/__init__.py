"""Logs of real robots: read, replayed in an engine, identified, and held against what a policy expects."""
