"""How is a policy learned? The environment, the algorithms on rsl_rl, and the run directory."""
