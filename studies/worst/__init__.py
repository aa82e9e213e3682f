"""Search for what breaks a policy: failures within stated ranges, played again, and a bound on their probability."""
