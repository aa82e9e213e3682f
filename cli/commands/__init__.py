"""Commands by purpose; each parses its options and calls one function of a module beside this package."""
