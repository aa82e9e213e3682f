"""Let engines of several families judge the same policy on the same episodes: a score by engine, their consensus and spread."""
