"""Train policies: the environment, the algorithms on rsl_rl, and the run directory."""
